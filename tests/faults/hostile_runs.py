"""Run directories, studies and configs that somebody made to do harm, by name.

Each case is made from a harmless run of InvertedPendulum, and is opened by one of the commands.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faults.make_golden import GOLDEN
from sauna.config.trust import seal
from sauna.system.checkpoint import _digest
from sauna.system.logs import NAMES

ENV = "InvertedPendulum-v5"
SPACES = ["vector", [4], "continuous", [1], ["Box", 4], ["Box", 1]]
TRAP = "from pathlib import Path\nPath({file!r}).touch()\n"  # of a module that was imported
EVIL = "evil_of_somebody:thing"
HTML = "<script>alert(1)</script>"
Case = tuple[str, Callable[[Path], object]]  # how it is opened, and how the harmless run is changed


def make_good(run: Path) -> None:
    """The harmless run: of the oldest format, but for its environment."""
    shutil.copytree(GOLDEN / "format-1-host", run)
    config = json.loads((run / "config.json").read_text())
    _write(run, _retold(config))
    for path in (run / "checkpoints").iterdir():
        change_manifest(run, lambda manifest: _retold(manifest), path.name)


def _retold(stored: dict[str, Any]) -> dict[str, Any]:
    for table in ("config", "given"):
        stored[table]["env"] = ENV
    return {**stored, "spaces": SPACES}


def _write(run: Path, stored: Any) -> None:
    (run / "config.json").write_text(json.dumps(stored))


def change_manifest(run: Path, change: Callable[[dict], dict], number: str = "00000004") -> None:
    """With the right digest: an attacker can count, too."""
    path = run / "checkpoints" / number / "manifest.json"
    manifest = change(json.loads(path.read_text()))
    manifest["manifest_sha256"] = _digest(manifest)
    path.write_text(json.dumps(manifest))


def cases() -> dict[str, Case]:
    """All of them."""
    return {**_configs(), **_names_of_code(), **_files(), **_artifacts(), **_studies()}


def _put(*path: str, value: Any) -> Callable[[Path], None]:
    """Sets an entry of config.json."""

    def change(run: Path) -> None:
        stored = json.loads((run / "config.json").read_text())
        place = stored
        for name in path[:-1]:
            place = place[name]
        place[path[-1]] = value
        _write(run, stored)

    return change


def _without(name: str) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        stored = json.loads((run / "config.json").read_text())
        del stored[name]
        _write(run, stored)

    return change


def _configs() -> dict[str, Case]:
    found: dict[str, Case] = {}
    for name in ("config", "spaces"):
        found[f"config.json without {name}"] = ("resume", _without(name))
    for name in ("config", "spaces", "given", "drop_rates", "code"):
        for what in (None, 3, HTML, {} if name in ("spaces", "drop_rates") else []):
            found[f"{name} is {what!r}"] = ("resume", _put(name, value=what))
    settings: dict[str, Any] = {
        "env": ["no-such-v0", "x" * 10**6, "a\0b", "\x1b[2J", ["x"], 3, None, "../../etc/passwd"],
        "arm": [[], [HTML], ["ppo"] * 100_000, "ppo,ppo", {}],
        "seeds": [[], [-1], [0] * 600_000, [2**64], "x"],
        "hidden": [[], [0], ["64"] * 2 + [None], {}],
        "rollout_steps": [-1, "nan", 10**400, 0.5, [1]],
        "env_kwargs": [[1], "[", 3, {"no_such": 1}],
        "env_processes": [10**9],
        "preset": [HTML],
        "network": ["os:system", "no-such"],
        "keep_checkpoints": [0],
        "no_such_setting": [1],
    }
    for name, values in settings.items():
        for number, value in enumerate(values):
            found[f"setting {name}, {number}"] = ("resume", _put("config", name, value=value))
    odd = {"shape of 2**40": [2**40], "negative": [-1], "text": "4", "bool": [True], "deep": [[4]]}
    for what, shape in odd.items():
        spaces = [SPACES[0], shape, *SPACES[2:]]
        found[f"spaces: {what}"] = ("resume", _put("spaces", value=spaces))
    return found


def _names_of_code() -> dict[str, Case]:
    names = {
        "a module beside it": EVIL,
        "a module's environment": "evil_of_somebody:Env-v0",
        "a library's helper": "matplotlib.testing:subprocess_run_for_testing",
        "the command line itself": "sauna.cli:main",
        "os.system": "os:system",
        "a wrapper of gym's": "GymV26Environment-v0",
    }
    found: dict[str, Case] = {}
    for what, name in names.items():
        found[f"env is {what}"] = ("resume", _put("config", "env", value=name))
    for field in ("network", "filter", "vex_target"):
        found[f"{field} is named"] = ("resume", _put("config", field, value=EVIL))
        found[f"{field} was given"] = ("resume", _put("given", field, value=EVIL))
        found[f"{field} of an artifact"] = ("eval", _of_manifest("config", field, EVIL))
    found["env of an artifact"] = ("eval", _of_manifest("config", "env", EVIL))
    found["a part that was passed by value"] = (
        "eval",
        _of_manifest("config", "env", "sauna.config.local:__class__"),
    )
    found["a seal of another run's"] = ("resume", _sealed)
    found["settings for a new run"] = ("train", _put("config", "network", value=EVIL))
    return found


def _sealed(run: Path) -> None:
    """This user's own seal, of other code than is named."""
    _put("seal", value=seal({"env": "mine:Env"}))(run)
    _put("config", "env", value=EVIL)(run)


def _of_manifest(table: str, name: str, value: Any) -> Callable[[Path], None]:
    def change(manifest: dict[str, Any]) -> dict[str, Any]:
        changed = copy.deepcopy(manifest)
        changed[table][name] = value
        return changed

    return lambda run: [change_manifest(run, change, n) for n in ("00000002", "00000004")]


def _files() -> dict[str, Case]:
    plants: dict[str, Callable[[Path], object]] = {
        "linked to /etc/passwd": lambda path: path.symlink_to("/etc/passwd"),
        "linked to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
        "linked to itself": lambda path: path.symlink_to(path.name),
        "a FIFO": os.mkfifo,
        "a folder": Path.mkdir,
        "a socket": _socket,
    }
    found: dict[str, Case] = {}
    for name in (*NAMES, ".lock", "config.json", "summary.json"):
        for what, plant in plants.items():
            found[f"{name} is {what}"] = ("resume", _planted(name, plant))
    found["checkpoints linked outside"] = ("resume", _linked_checkpoints)
    found["checkpoints is a FIFO"] = ("resume", _planted("checkpoints", os.mkfifo))
    rows: dict[str, bytes] = {
        "rows are lists": b"[1]\n" * 100,
        "rows are deep": b"[" * 100_000 + b"\n",
        "a line without an end": b"x" * 2**25,
        "a row was deleted": b"",
        "rows of NaN": b'{"member": NaN}\n' * 100,
    }
    for what, data in rows.items():
        found[what] = ("resume", lambda run, data=data: _spoil(run / NAMES[0], data))
    found["rows of 1 TB without blocks"] = ("resume", lambda run: _sparse(run / NAMES[0]))
    return found


def _planted(name: str, plant: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        path = run / name
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        plant(path)

    return change


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        here = os.getcwd()
        os.chdir(path.parent)  # names of sockets are short
        server.bind(path.name)
        os.chdir(here)


def _linked_checkpoints(run: Path) -> None:
    (run / "checkpoints").rename(run.with_suffix(".elsewhere"))
    (run / "checkpoints").symlink_to(run.with_suffix(".elsewhere"))


def _spoil(path: Path, data: bytes) -> None:
    """Puts other bytes in the place of the first row, and keeps the length if they are short."""
    lines = path.read_bytes().splitlines(True)
    path.write_bytes(data + b"".join(lines[1:]) + bytes(max(0, len(lines[0]) - len(data))))


def _sparse(path: Path) -> None:
    """With a manifest that counts on it."""
    path.write_bytes(b"")
    os.truncate(path, 2**40)
    for number in ("00000002", "00000004"):
        change = {"logs": {path.name: 2**40}}
        change_manifest(path.parent, lambda m, change=change: {**m, **change}, number)


def _artifacts() -> dict[str, Case]:
    found: dict[str, Case] = {}
    for what, members in {
        "tables": [{}],
        "numbers": [0],
        "none": [],
        "one twice": ["ppo/0", "ppo/0"],
        "of another run": ["../../etc/passwd"],
        "HTML": [HTML],
    }.items():
        change = {"members": members}
        found[f"members are {what}"] = ("eval", _changed(change))
    for what, hidden in {
        "a layer of 2**31": [2**31 - 1],
        "two wide layers": [2**20, 2**20],
        "200,000 layers": [1] * 200_000,
    }.items():
        found[f"an artifact with {what}"] = ("eval", _of_manifest("config", "hidden", hidden))
    for what, spaces in {
        "none": [],
        "too few": SPACES[:3],
        "huge": [SPACES[0], [2**40], *SPACES[2:]],
        "of another kind": ["image", [4, 4, 4], *SPACES[2:]],
        "tables": [{}, {}, {}, {}, {}, {}],
    }.items():
        found[f"spaces of an artifact: {what}"] = ("eval", _changed({"spaces": spaces}))
    return found


def _changed(change: dict[str, Any]) -> Callable[[Path], None]:
    numbers = ("00000002", "00000004")
    return lambda run: [change_manifest(run, lambda m: {**m, **change}, n) for n in numbers]


def _studies() -> dict[str, Case]:
    head, arm = f'tasks = ["{ENV}"]\n', '[[arms]]\nlabel = "sauna"\n'
    texts: dict[str, str | bytes] = {
        "a network at the top": f'network = "{EVIL}"\n{head}{arm}',
        "a filter in an arm": f'{head}{arm}filter = "{EVIL}"\n',
        "a target in an arm": f'{head}{arm}vex_target = "{EVIL}"\n',
        "a task": f'tasks = ["{EVIL}"]\n{arm}',
        "a task of an arm": f'{head}{arm}tasks = ["{EVIL}"]\n',
        "a measurement": f'measure = "{EVIL}"\n{head}{arm}',
        "a name that leads away": f'name = "../../elsewhere"\n{head}{arm}',
        "a name of HTML": f'name = "{HTML}"\n{head}{arm}',
        "no text": b"\xff\xfe\x00",
        "deep lists": "x = " + "[" * 100_000,
        "8 MB": "# " + "x" * 8_000_000 + f"\n{head}{arm}",
        "numbers for arms": f"arms = [1, 2]\n{head}",
        "a thousand million seeds": f"seeds = 1_000_000_000\n{head}{arm}",
        "a date for a name": f"name = 1979-05-27\n{head}{arm}",
        "a table of tasks": f"{arm}[tasks]\nx = 1\n",
    }
    found: dict[str, Case] = {}
    for what, text in texts.items():
        data = text if isinstance(text, bytes) else text.encode()
        found[f"study: {what}"] = (
            "study",
            lambda run, data=data: (run / "study.toml").write_bytes(data),
        )
    found["study: a FIFO"] = ("study", lambda run: os.mkfifo(run / "study.toml"))
    found["study: linked to /dev/zero"] = (
        "study",
        lambda run: (run / "study.toml").symlink_to("/dev/zero"),
    )
    found["config: deep"] = (
        "train",
        lambda run: (run / "config.json").write_bytes(b"[" * 200_000),
    )
    return found
