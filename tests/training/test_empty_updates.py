"""A rule that keeps nothing is named at once, and ends the run if it goes on."""

from __future__ import annotations

import pytest

import sauna
from helpers import SMALL
from sauna.config.checks import cautions
from sauna.config.presets import resolve
from sauna.system.errors import BadInput, SaunaError
from sauna.training.empty_updates import MAX_EMPTY, EmptyUpdates


def row(keep_rate: float, steps: int = 4, iteration: int = 0) -> dict[str, object]:
    return {
        "member": "sauna/0",
        "keep_rate": keep_rate,
        "gradient_steps": steps,
        "iteration": iteration,
    }


def test_one_warning_and_an_end_after_ten_in_a_row() -> None:
    updates = EmptyUpdates()
    assert updates.see([row(0.5)]) == []
    assert "kept no sample of iteration 3" in updates.see([row(0.0, iteration=3)])[0]
    assert updates.see([row(0.5, steps=0)]) == []
    updates.see([row(0.5)])  # a row that learns begins the count anew
    for _ in range(MAX_EMPTY - 1):
        assert updates.see([row(0.0)]) == []
    with pytest.raises(SaunaError, match="in 10 iterations in a row"):
        updates.see([row(0.0)])


def test_a_run_that_learns_nothing_fails(tmp_path, capsys) -> None:
    settings = {**SMALL, "steps": 32 * 12, "threshold": 1e30, "dropped": "mask"}
    with pytest.raises(SaunaError, match="kept no sample in 10 iterations"):
        sauna.train(
            "small_envs:Scripted",
            arm="sauna",
            filter="own_rules:nothing",
            out=tmp_path / "r",
            **settings,
        )
    said = capsys.readouterr().out
    assert "warning: sauna+own_rules.nothing/0: the rule kept no sample of iteration 0" in said


@pytest.mark.parametrize(
    "rule",
    [
        {"sampler": "gigaflow", "sampler_kwargs": {"threshold": 2.0}},
        {"stop": "espo", "stop_kwargs": {"limit": 0.0}, "clip_range": 0.2},
    ],
)
def test_a_run_without_the_head_that_learns_nothing_fails(rule, tmp_path, capsys) -> None:
    settings = {**SMALL, "steps": 32 * 12, **rule}
    with pytest.raises(SaunaError, match="in 10 iterations in a row"):
        sauna.train("small_envs:Scripted", out=tmp_path / "r", **settings)
    assert "or stopped its update at once" in capsys.readouterr().out


def test_a_minibatch_of_one_sample_is_refused() -> None:
    with pytest.raises(BadInput, match="minibatches: 32 of 32 samples leave 1 each"):
        sauna.train("small_envs:Scripted", **{**SMALL, "minibatches": 32})


def test_a_small_minibatch_is_named_and_trained_with() -> None:
    def said(**settings: object) -> list[str]:
        return cautions(resolve({"env": "x", **SMALL, **settings}))

    assert said(minibatches=4) == [
        "warning: minibatches of 8 samples: their advantages are standardised alone"
    ]
    assert said(minibatches=2) == [], "16 samples are enough"
    assert said(minibatches=4, normalize_advantages=False) == [], "nothing is standardised"
