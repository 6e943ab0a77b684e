"""What `sauna list` prints."""

from __future__ import annotations

from sauna.config.presets import PRESETS
from sauna.config.zoo import ENVS
from sauna.experiments.listing import listing


def test_environments_stand_beside_their_preset_steps_and_published_return() -> None:
    lines = listing("envs")
    (walker,) = (line for line in lines if line.startswith("BipedalWalker-v3 "))
    assert walker.split() == [
        "BipedalWalker-v3",
        "bipedal-walker",
        "5,000,000",
        "287.9",
        "+-",
        "2.4",
    ]
    assert "FrozenLake-v1" in lines  # the zoo does not know it
    assert any("sauna-rl[minigrid]" in line for line in lines)


def test_presets_are_followed_by_the_zoo() -> None:
    lines = listing("presets")
    assert [line.split()[0] for line in lines[: len(PRESETS)]] == list(PRESETS)
    assert [line.split()[0] for line in lines[-len(ENVS) :]] == list(ENVS)
