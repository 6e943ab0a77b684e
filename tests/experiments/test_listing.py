"""What `sauna list` prints."""

from __future__ import annotations

import inspect

import pytest

from sauna import cli
from sauna.config.arms import SHARES
from sauna.config.choices import LISTS
from sauna.config.presets import PRESETS
from sauna.config.settings import NATIVE
from sauna.config.zoo import ENVS
from sauna.experiments.listing import listing
from sauna.experiments.study.spec import built_in


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


def test_without_a_name_each_list_is_named_in_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["list"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:3] for line in lines] == [["sauna", "list", name] for name in LISTS]
    assert set(NATIVE) < set(LISTS)


def test_rules_stand_beside_the_share_that_their_sampler_has() -> None:
    from sauna.algorithm.selection.registry import SAMPLERS

    shares = {
        name: inspect.signature(make).parameters.get("share") for name, make in SAMPLERS.items()
    }
    defaults = {name: share.default for name, share in shares.items() if share}
    assert {name: share for name, share in defaults.items() if share is not None} == SHARES
    (kondo,) = (line for line in listing("rules") if line.startswith("kondo"))
    assert kondo.split()[:3] == ["kondo", "rollout", "0.3"]


def test_studies_are_listed_by_a_sentence_each() -> None:
    lines = listing("studies")
    assert [line.split()[0] for line in lines] == list(built_in())
    starts = {len(line) - len(line.split(maxsplit=1)[1]) for line in lines}
    assert len(starts) == 1 and all(line.endswith((".", "?")) for line in lines)
    (fig2,) = (line for line in lines if line.startswith("fig2 "))
    assert fig2.endswith("  The paper's Fig. 2: the learning curves of Table 1.")
