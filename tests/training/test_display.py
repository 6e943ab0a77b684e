"""What a run shows: the columns of its table, and the lines where there is no terminal."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from sauna.config.presets import resolve, resolve_run
from sauna.training import display
from sauna.training.display import (
    NotebookDisplay,
    PlainDisplay,
    columns_of,
    counted,
    headline,
    make_display,
    returns,
)


def titles(**settings: object) -> list[str]:
    run = resolve_run({"env": "none", **settings})
    return [title for title, _, _ in columns_of(run.members)]


def test_plain_ppo_shows_no_head_and_no_rule() -> None:
    shown = titles(arm="ppo")
    assert shown[:4] == ["env steps", "episodes", "return", "length"]
    assert {"entropy", "KL", "expl. var."} <= set(shown)
    assert not {"keep rate", "samples used", "Vex mean"} & set(shown)


def test_a_rule_shows_what_it_takes() -> None:
    assert {"keep rate", "Vex mean", "Vex spread"} <= set(titles(arm="sauna"))
    assert "samples used" in titles(arm="gigaflow")


def row(member: str, env_steps: int) -> dict[str, object]:
    return {"member": member, "env_steps": env_steps, "return_mean": 1.5}


def test_plain_lines_name_each_phase_once_and_never_repeat(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """200 seconds of compiling, then an iteration every 5 seconds, for a minute."""
    now = [0.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: now[0])
    run = resolve_run({"env": "none", "arm": "ppo", "seeds": 2, "steps": 20_000})
    shown = PlainDisplay()
    shown.open(run.config, run.members, Path("runs/mine"), [])
    for process in range(2):
        shown.phase(process, "compiling")
    while now[0] < 200:
        now[0] += 1
        shown.refresh()
    waited = capsys.readouterr().out.splitlines()
    assert waited[0].startswith("none: 2 members (ppo x 2 seeds), 20,000 env steps each")
    assert waited[1] == "0:00 compiling"
    assert [line.split()[0] for line in waited[2:]] == ["0:10", "0:30", "1:10", "2:30"]
    for iteration in range(1, 13):
        now[0] += 5
        shown.rows([row(f"ppo/{seed}", 1000 * iteration) for seed in range(2)])
        shown.refresh()
    trained = capsys.readouterr().out.splitlines()
    assert trained[-1] == ("4:15 55%, 400 env steps/s, 0:45 left; return: ppo/0 1.5, ppo/1 1.5")
    assert len(trained) == len(set(trained)) == 6


def test_many_members_are_summed_up_by_arm() -> None:
    latest = {f"{arm}/{seed}": None for arm in ("ppo", "sauna+random") for seed in range(4)}
    assert returns(latest) == "mean return: ppo -, sauna+random -"
    latest |= {f"ppo/{seed}": {"return_mean": 2.0 * seed} for seed in (0, 1)}
    assert returns(latest) == "mean return: ppo 1.0, sauna+random -"
    few = dict(list(latest.items())[:3])
    assert returns(few) == "return: ppo/0 0.0, ppo/1 2.0, ppo/2 -"


def test_a_part_that_was_passed_by_value_trains_in_this_process() -> None:
    config = resolve({"env": "none", "processes": 2})
    assert "2 processes; writing" in headline(config, [], Path("run"))
    config = dataclasses.replace(config, env="sauna.config.local:f_0")
    assert "this process; writing" in headline(config, [], Path("run"))


def test_one_is_singular() -> None:
    assert [counted(n, "task") for n in (0, 1, 2000)] == ["0 tasks", "1 task", "2,000 tasks"]


def kernel(monkeypatch: pytest.MonkeyPatch, shell: Any) -> list[str]:
    """Stands for IPython; the tables that its cell shows, in order."""
    shown: list[str] = []

    def display(html: str, display_id: bool) -> Any:
        assert display_id
        shown.append(html)
        return SimpleNamespace(update=shown.append)

    python, parts = ModuleType("IPython"), ModuleType("IPython.display")
    python.get_ipython = lambda: shell  # type: ignore[attr-defined]
    parts.display, parts.HTML = display, str  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", python)
    monkeypatch.setitem(sys.modules, "IPython.display", parts)
    return shown


def test_a_notebook_shows_a_table_that_is_redrawn(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    shown = kernel(monkeypatch, SimpleNamespace(kernel=object()))
    ours = make_display()
    assert isinstance(ours, NotebookDisplay)
    run = resolve_run({"env": "none", "seeds": 2, "steps": 1e4})
    ours.open(run.config, run.members, Path("run"), [])
    ours.phase(0, "compiling <x>")
    ours.rows([{"member": "ppo/1", "env_steps": 5_000, "kept_steps": 5_000, "kl": 0.0123}])
    monkeypatch.setattr("sauna.training.display.NOTEBOOK_SECONDS", -1.0)
    ours.refresh()
    ours.summary({})
    ours.close()
    assert len(shown) == 3 and shown[1] == shown[2]
    assert "<caption>compiling &lt;x&gt;, 25%</caption>" in shown[1]
    assert "<tr><td>ppo/0</td><td>-</td>" in shown[1]
    assert "<tr><td>ppo/1</td><td>5,000</td>" in shown[1] and "<td>0.0123</td>" in shown[1]
    assert "writing to run" in capsys.readouterr().out


def test_ipython_in_a_terminal_is_no_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel(monkeypatch, SimpleNamespace())
    assert type(make_display()) is PlainDisplay
    kernel(monkeypatch, None)
    assert type(make_display()) is PlainDisplay
