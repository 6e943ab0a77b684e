"""What the live table shows: what one looks for with PPO, and what a rule or a head has."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from sauna.config.presets import resolve_run
from sauna.training.display import NotebookDisplay, PlainDisplay, columns_of, make_display


def titles(**settings: object) -> list[str]:
    run = resolve_run({"env": "none", **settings})
    return [title for title, _, _ in columns_of(run.members)]


def test_plain_ppo_shows_no_head_and_no_rule() -> None:
    shown = titles(arm="ppo")
    assert shown[:4] == ["env steps", "episodes", "return", "length"]
    assert {"entropy", "KL", "expl. var."} <= set(shown)
    assert not {"keep rate", "sample rate", "Vex mean"} & set(shown)


def test_a_rule_shows_what_it_takes() -> None:
    assert {"keep rate", "Vex mean", "Vex spread"} <= set(titles(arm="sauna"))
    assert "sample rate" in titles(arm="gigaflow")


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
    display = make_display()
    assert isinstance(display, NotebookDisplay)
    run = resolve_run({"env": "none", "seeds": 2, "steps": 1e4})
    display.open(run.config, run.members, Path("run"), [])
    display.phase(0, "compiling <x>")
    display.rows([{"member": "ppo/1", "env_steps": 5_000, "kept_steps": 5_000, "kl": 0.0123}])
    monkeypatch.setattr("sauna.training.display.NOTEBOOK_SECONDS", -1.0)
    display.refresh()
    display.summary({})
    display.close()
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
