"""Parts passed by value belong to their run; what cannot be had is said in a line."""

from __future__ import annotations

import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from helpers import SMALL, environment
from sauna import cli
from sauna.config import local
from sauna.config.plugins import import_name, name_of
from sauna.config.settings import parse
from sauna.system import supported
from sauna.system.errors import BadInput, Interrupted, SaunaError
from small_envs import Finite, Scripted

SETTINGS = {**SMALL, "processes": 1, "arm": "ppo", "steps": 64}


class Pays(Finite):
    """`pay` at each of its five steps."""

    def __init__(self, pay: float) -> None:
        self.pay = pay

    def reward(self, action: Any) -> float:
        return self.pay


def test_two_runs_with_parts_of_one_name_keep_their_own(tmp_path: Path) -> None:
    one = sauna.train(lambda: Pays(1.0), quiet=True, out=tmp_path / "one", **SETTINGS)
    other = sauna.train(lambda: Pays(100.0), quiet=True, out=tmp_path / "other", **SETTINGS)
    means = [sauna.evaluate(r.path, episodes=2)["members"]["ppo/0"]["mean"] for r in (one, other)]
    assert means == [5.0, 500.0]


def test_two_threads_train_on_their_own_parts(tmp_path: Path) -> None:
    """Also on their own networks, here of other widths."""
    from own_networks import Wide

    def train(k: int) -> None:
        settings = {name: value for name, value in SETTINGS.items() if name != "hidden"}
        out, network = tmp_path / str(k), Wide(width=k)
        sauna.train(lambda: Pays(float(k)), quiet=True, out=out, network=network, **settings)

    threads = [threading.Thread(target=train, args=(k,)) for k in (2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k in (2, 3):
        result = sauna.api.Result(tmp_path / str(k))
        returns = {r for row in result.metrics for r in row["episode_returns"]}
        assert returns == {5.0 * k}
        from sauna.training.artifact import load_artifact

        arrays = load_artifact(result.path).checkpoint.arrays
        assert arrays["ppo/0/params/policy_trunk/Dense_0/kernel"].shape[-1] == k


def test_a_name_is_never_given_twice_and_importable_things_keep_theirs() -> None:
    same = lambda: None  # noqa: E731
    assert name_of(same) != name_of(same)
    assert import_name("env", name_of(same)) is same
    assert name_of(Scripted) == "small_envs:Scripted"


def test_a_process_without_the_part_says_so(tmp_path: Path) -> None:
    out = tmp_path / "run"
    sauna.train(lambda: Pays(2.0), quiet=True, out=out, **SETTINGS)
    code = (
        "import sauna, sauna.cli\n"
        "from small_envs import Finite\n"
        f"try: sauna.cli.main(['eval', {str(out)!r}])\n"
        "except SystemExit as end: print(end.code)\n"
        "class Pays(Finite):\n"
        "    def reward(self, action): return 7.0\n"
        f"found = sauna.evaluate({str(out)!r}, episodes=1, env=lambda: Pays())\n"
        "print(found['members']['ppo/0']['mean'])\n"
        f"print(sauna.evaluate({str(out)!r}, episodes=1)['members']['ppo/0']['mean'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment()
    )
    assert done.stdout.split() == ["2", "35.0", "35.0"], done.stderr
    assert "env: was passed by value; pass it again as env=" in done.stderr
    assert done.stderr.count("\n") == 1


def test_older_runs_whose_names_may_meet_need_their_parts_again(tmp_path: Path) -> None:
    """Their parts were named `_lambda_` alone: another run's may be held under that name."""
    out = tmp_path / "run"
    sauna.train(lambda: Pays(2.0), quiet=True, out=out, **SETTINGS)
    for path in out.rglob("*.json"):
        text = path.read_text()
        found = text.find("sauna.config.local:")
        if found >= 0 and path.name == "config.json":
            name = text[found:].split('"')[0]
            path.write_text(text.replace(name, "sauna.local:_lambda_"))
    local._lambda_ = Finite  # type: ignore[attr-defined]
    with pytest.raises(BadInput, match="pass it again as env="):
        sauna.load(out)


def test_numpy_values_among_the_arguments_are_numbers() -> None:
    given = {"a": np.float32(0.5), "b": np.int64(3), "c": np.arange(2), "d": [np.bool_(True)]}
    assert parse("env_kwargs", given) == '{"a": 0.5, "b": 3, "c": [0, 1], "d": [true]}'
    with pytest.raises(BadInput, match="a function is no JSON value; pass env as a function"):
        parse("env_kwargs", {"reward": lambda: 0})
    with pytest.raises(BadInput, match="JSON has no infinity"):
        parse("env_kwargs", {"a": np.float64("inf")})


def test_a_stop_ends_a_loop_over_runs() -> None:
    """`except Exception` of a sweep does not take it for a run that failed."""
    seen = []
    with pytest.raises(KeyboardInterrupt):
        for k in range(3):
            try:
                seen.append(k)
                raise Interrupted(2, "stopped by SIGINT")
            except Exception:
                continue
    assert seen == [0]


def test_an_unsupported_system_is_named_in_a_line(monkeypatch, capsys) -> None:
    monkeypatch.setattr(supported.os, "name", "nt")
    monkeypatch.setattr(supported.platform, "system", lambda: "Windows")
    try:
        with pytest.raises(SystemExit) as exit:
            cli.main(["list", "arms"])
        with pytest.raises(SaunaError, match="inside WSL"):
            sauna.__getattr__("train")
    finally:
        monkeypatch.undo()
    said = capsys.readouterr().err
    assert exit.value.code == 1 and said.count("\n") == 1
    assert "Windows is not supported: SAUNA runs on Linux and macOS" in said


def test_the_packages_page_names_the_supported_systems() -> None:
    project = Path(__file__).parents[2] / "pyproject.toml"
    named = tomllib.loads(project.read_text())["project"]["classifiers"]
    systems = [name for name in named if name.startswith("Operating System")]
    assert systems == ["Operating System :: MacOS", "Operating System :: POSIX :: Linux"]
