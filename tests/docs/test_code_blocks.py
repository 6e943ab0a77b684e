"""Every code block of README and docs: commands are parsed, Python is run.

A block with `title="my_filters.py"` is a file: it is written into the folder in which the page's
other blocks run. Trainings are cut to two rollouts; the slow part runs them, the fast part checks
their commands and settings with the real parser.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from sauna import cli
from sauna.config.presets import PRESETS, parse_all, resolve
from sauna.config.settings import FIELDS
from sauna.config.zoo import entry_of
from sauna.envs.make import make_env
from sauna.experiments.study.command import chosen_arms, comparison

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)[ ]?([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LANGUAGES = {"bash", "python", "toml", "text"}
# Commands that are parsed but not run: they need games, a cluster, a browser or hours.
NOT_RUN = re.compile(
    r"ALE/|playground/|Flagrun|LunarLander|--distributed|--on ray|^sauna (study|bench|list)|--v"
    r"|^sauna tune|compare (?!InvertedPendulum)|plot runs/ppo|tuned\.json"
)
EXAMPLE_MODULE = """
import gymnasium

def MyEnv(**kwargs):
    return gymnasium.make("Pendulum-v1", **kwargs)
"""
# Cuts a page's trainings to two rollouts of two seeds.
TOY = """
import functools
import sauna

def small(train):
    @functools.wraps(train)
    def trained(*args, **settings):
        if "seeds" in settings and not isinstance(settings["seeds"], list):
            settings["seeds"] = min(settings["seeds"], 2)
        rollout = settings.get("rollout_steps", 2048) * settings.get("envs", 1)
        return train(*args, **{**settings, "steps": 2 * rollout})
    return trained

sauna.train, sauna.compare = small(sauna.train), small(sauna.compare)
"""


class Block(NamedTuple):
    language: str
    title: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    text, found = page.read_text(), []
    for match in FENCE.finditer(text):
        title = re.search(r'title="([^"]+)"', match[2])
        line = text.count("\n", 0, match.start()) + 1
        found.append(Block(match[1], title[1] if title else "", match[3], line))
    return found


def commands(page: Path) -> Iterator[list[str]]:
    for block in blocks(page):
        if block.language == "bash":
            yield from filter(None, map(shlex.split, block.text.splitlines()))


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def write_files(page: Path, folder: Path) -> None:
    (folder / "my_module.py").write_text(EXAMPLE_MODULE)
    for block in blocks(page):
        if block.title:
            (folder / block.title).write_text(block.text)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_blocks_name_their_language(page: Path) -> None:
    for block in blocks(page):
        assert block.language in LANGUAGES, f"{name_of(page)}:{block.line}"


@pytest.mark.parametrize("page", [p for p in PAGES if any(commands(p))], ids=name_of)
def test_commands_are_real(page: Path, folder: Path) -> None:
    write_files(page, folder)
    for command in commands(page):
        check_command(command)


def check_command(command: list[str]) -> None:
    known = {
        "sauna": check_sauna,
        "pip": check_pip,
        "make": check_make,
        "python": check_script,
        "source": check_source,
        "apt-get": lambda arguments: None,
    }
    assert command[0] in known, command
    known[command[0]](command[1:])


def check_sauna(arguments: list[str]) -> None:
    """Parses a command and, of a training, resolves its settings."""
    if arguments == ["--version"]:
        return
    parsed, unknown = cli.make_parser().parse_known_args(arguments)
    assert not unknown, (arguments, unknown)
    settings = {k: v for k, v in vars(parsed).items() if k in FIELDS and v is not None}
    if parsed.command not in ("train", "compare") or vars(parsed).get("config"):
        return
    if parsed.command == "compare":
        settings = {k: v for k, v in settings.items() if k not in ("env", "out", "processes")}
        if len(parsed.env) > 1:  # runs that exist
            return
        rules = tuple(filter(None, parsed.rules.split(",")))
        arms = tuple(parsed.arms.split(","))
        chosen, is_tournament = chosen_arms(arms, rules, parsed.controls, parse_all(settings))
        comparison(parsed.env[0], chosen, parse_all(settings), is_tournament)
        return
    resolve(settings)
    if ":" in settings["env"]:
        make_env(settings["env"], json.loads(settings.get("env_kwargs", "{}"))).close()


def check_pip(arguments: list[str]) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for name in re.findall(r"\[([\w,]+)\]", " ".join(arguments)):
        assert set(name.split(",")) <= set(extras["optional-dependencies"]), arguments


def check_make(arguments: list[str]) -> None:
    for target in arguments:
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target


def check_source(arguments: list[str]) -> None:
    assert arguments == [".venv/bin/activate"]  # which `make setup` and `make demo` make
    assert re.search(r"^VENV .*= \.venv$", (ROOT / "Makefile").read_text(), re.MULTILINE)


def check_script(arguments: list[str]) -> None:
    assert (ROOT / arguments[0]).is_file(), arguments


def python_blocks(page: Path) -> list[Block]:
    return [b for b in blocks(page) if b.language == "python" and not b.title]


def trains(page: Path) -> bool:
    return any(re.search(r"\bsauna\.\w+\(", block.text) for block in python_blocks(page))


@pytest.mark.parametrize("page", [p for p in PAGES if python_blocks(p)], ids=name_of)
def test_python_names_what_exists(page: Path) -> None:
    """Names of the package and settings are real, also in blocks that only the slow part runs."""
    import sauna

    for block in python_blocks(page):
        for node in ast.walk(ast.parse(block.text)):
            if isinstance(node, ast.Attribute) and is_sauna(node.value):
                assert hasattr(sauna, node.attr), f"{name_of(page)}:{block.line}: {node.attr}"
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "sauna.train":
                constants = [k for k in node.keywords if isinstance(k.value, ast.Constant)]
                parse_all({k.arg: ast.literal_eval(k.value) for k in constants})


def is_sauna(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id == "sauna"


@pytest.mark.parametrize(
    "page",
    [p for p in PAGES if any(b.title.endswith(".py") for b in blocks(p))]
    + [p for p in PAGES if python_blocks(p) and not trains(p)],
    ids=name_of,
)
def test_files_and_short_blocks_run(page: Path, folder: Path) -> None:
    write_files(page, folder)
    for block in blocks(page):
        if block.language == "python" and (block.title or not trains(page)):
            exec(compile(block.text, f"{name_of(page)}:{block.line}", "exec"), {"__name__": "page"})


@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(b.title.endswith(".toml") for b in blocks(p))], ids=name_of
)
def test_study_files_are_studies(page: Path, folder: Path) -> None:
    from sauna.experiments.study.spec import load_spec

    write_files(page, folder)
    for block in blocks(page):
        if block.title.endswith(".toml"):
            assert load_spec(block.title).arms


def run(arguments: list[str], folder: Path) -> None:
    environment = {
        **os.environ,
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(folder)]),
    }
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0, f"{arguments}\n{done.stdout[-3000:]}"


def run_python(page: Path, folder: Path) -> None:
    parts = [f"# line {block.line}\n{block.text}" for block in python_blocks(page)]
    (folder / "page.py").write_text("\n".join([TOY, *parts]))
    run(["page.py"], folder)


def toy(arguments: list[str]) -> list[str]:
    """A training's command with two rollouts and at most two seeds."""
    parsed, _ = cli.make_parser().parse_known_args(arguments)
    if parsed.command in ("train", "compare"):
        values = vars(parsed)
        entry = entry_of(values["env"] or "") if parsed.command == "train" else None
        preset = values.get("preset", entry.preset if entry else "mujoco")
        start = {**{n: f.default for n, f in FIELDS.items()}, **PRESETS[preset]}
        rollout = int(values.get("rollout_steps", start["rollout_steps"]))
        rollout *= int(values.get("envs", start["envs"]))
        seeds = [] if "seed" in values else ["--seeds", "2"]
        return [*arguments, "--steps", str(2 * rollout), *seeds]
    if parsed.command == "eval":
        return [a for a in arguments if a != "--video"] + ["--episodes", "1"]
    return arguments


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if any(commands(p)) or trains(p)], ids=name_of)
def test_pages_run(page: Path, folder: Path) -> None:
    write_files(page, folder)
    for command in commands(page):
        if command[0] == "sauna" and not NOT_RUN.search(shlex.join(command)):
            run(["-m", "sauna", *toy(command[1:])], folder)
    if python_blocks(page):
        run_python(page, folder)
