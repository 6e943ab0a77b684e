"""What the live table shows: what one looks for with PPO, and what a rule or a head has."""

from __future__ import annotations

from sauna.config.presets import resolve_run
from sauna.training.display import columns_of


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
