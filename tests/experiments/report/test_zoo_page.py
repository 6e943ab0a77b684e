"""The page of the zoo: each environment beside RL Zoo's return, and what is below it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from zoo import BY_SPACES, LEFT_OUT, TRAINED, is_done, plan_of, settings_of, stored
from zoo_page import WORDS, draw_zoo, is_split, needs_word, zoo_page

from sauna.config.zoo import ENVS, entry_of
from sauna.training.pick import pick


def unit(*returns: float) -> dict[str, Any]:
    names = [f"ppo/{seed}" for seed in range(len(returns))]
    curve = {"env_steps": [100, 200], "return": [0.0, 1.0]}
    return {
        "preset": "lunar-lander",
        "steps": 1_000_000,
        "returns": dict(zip(names, returns, strict=True)),
        "cpu_seconds": 90.0,
        "curves": dict.fromkeys(names, curve),
    }


def below(units: dict[str, Any]) -> str:
    return zoo_page(units).partition("## Low returns")[2].partition("\n## ")[0]


def test_a_row_holds_the_seeds_their_mean_and_the_published_return() -> None:
    page = zoo_page({"LunarLander-v3": unit(240.0, 250.0, 260.0)})
    row = next(line for line in page.splitlines() if line.startswith("| `LunarLander-v3`"))
    assert row.endswith("| 240.0, 250.0, 260.0 | 250.0 ± 10.0 | 242.1 ± 31.8 | 1.5 |")
    assert page.index("Not trained here yet") < page.index("| `LunarLanderContinuous-v3`")


def test_below_is_a_mean_lower_than_the_published_one_by_more_than_the_published_spread() -> None:
    assert "None so far." in below({"LunarLander-v3": unit(211.0, 211.0, 211.0)})
    assert "not explained yet" in below({"LunarLander-v3": unit(209.0, 209.0, 209.0)})
    assert "not explained yet" in below({"LunarLander-v3": unit(209.0, 109.0, 309.0)})
    assert "shows contact forces" in below({"Ant-v5": unit(100.0, 101.0, 102.0)})
    assert "returns 1.000, 1.000." in below({"MiniGrid-Unlock-v0": unit(0.9, 0.8)})  # sampled
    assert "None so far." in below({"Humanoid-v5": unit(1.0, 1.0, 1.0)})  # nothing is published


def test_seeds_that_differ_by_half_are_named() -> None:
    assert is_split(unit(8000.0, 3999.0)) and not is_split(unit(8000.0, 4001.0))
    assert is_split(unit(1.0, -1.0)) and not is_split(unit(-100.0, -500.0))
    assert "not explained yet" in below({"Humanoid-v5": unit(500.0, 100.0)})


def test_each_stored_return_below_the_published_one_has_a_word() -> None:
    """If this fails, say in `WORDS` of `results/zoo_page.py` why these are below."""
    without = [
        env for env, found in stored().items() if needs_word(env, found) and env not in WORDS
    ]
    assert without == []
    assert set(WORDS) <= {*ENVS, *BY_SPACES}


def test_each_environment_waits_for_its_turn_or_is_left_out_for_a_reason() -> None:
    left_out = [env for env in ENVS if plan_of(env) in LEFT_OUT.values()]
    assert set(left_out) == set(ENVS) - set(TRAINED) and len(TRAINED) == len(set(TRAINED))
    assert {plan_of(env) for env in TRAINED} == {"waits for its turn"}
    presets = {entry.preset for env in TRAINED if (entry := entry_of(env))}
    assert "minigrid-long" in presets


@pytest.mark.parametrize("env", BY_SPACES)
def test_an_environment_that_the_zoo_does_not_know_gets_a_preset_by_its_spaces(env: str) -> None:
    assert entry_of(env) is None and pick({"env": env}).overrides["preset"] == BY_SPACES[env][0]


def test_a_figure_has_a_panel_for_each_environment(tmp_path: Path) -> None:
    units = {"LunarLander-v3": unit(1.0, 2.0, 3.0), "Humanoid-v5": unit(1.0, 2.0, 3.0)}
    text = draw_zoo(units, tmp_path / "zoo.svg").read_text()
    assert "LunarLander-v3" in text and "Humanoid-v5" in text and "CartPole" not in text


def test_a_unit_is_done_only_with_todays_settings(monkeypatch, tmp_path: Path) -> None:
    entry = entry_of("LunarLander-v3")
    assert entry is not None and set(TRAINED) <= set(ENVS)
    file = tmp_path / "zoo.json"
    monkeypatch.setattr("zoo.FILE", file)
    assert not is_done("LunarLander-v3", entry)
    for settings, done in ((settings_of(entry), True), ({"steps": 1}, False)):
        units = {"LunarLander-v3": {**unit(1.0), "settings": settings}}
        file.write_text(json.dumps({"units": units}))
        assert is_done("LunarLander-v3", entry) is done


def test_the_page_is_that_of_the_result_file() -> None:
    """If this fails, run `python results/make.py`."""
    root = Path(__file__).parents[3]
    assert (root / "docs" / "results" / "zoo.md").read_text() == zoo_page(stored())
