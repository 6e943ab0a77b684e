"""A rule of the user's own is an arm of a comparison, with a control of its own."""

from __future__ import annotations

import pytest

from sauna.config.presets import COMPARED
from sauna.experiments.study.cells import Cell, is_control_among
from sauna.experiments.study.command import (
    chosen_arms,
    compare_command,
    comparison,
    study_command,
)
from sauna.experiments.study.own_arms import stage_of
from sauna.experiments.study.rounds import controls_of
from sauna.experiments.study.spec import Spec, check
from sauna.experiments.study.units import units_of
from sauna.experiments.study.verdicts import is_random_control
from sauna.system.errors import BadInput

NEWEST, LIKELY = "own_rules:newest", "own_rules:likely"
SEEDS = {"seeds": (0, 1)}


def _spec(*arms: str, rules: tuple[str, ...] = (), **settings: object) -> Spec:
    chosen, is_tournament = chosen_arms(arms or COMPARED, rules, True, settings)
    seeds = {} if is_tournament else SEEDS
    return comparison("Hopper-v5", chosen, {**seeds, **settings}, is_tournament)


@pytest.mark.parametrize(
    ("name", "stage"), [(NEWEST, "sampler"), (LIKELY, "filter"), ("own_rules:nothing", "filter")]
)
def test_a_rule_is_known_by_what_it_is_or_makes(name: str, stage: str) -> None:
    assert stage_of(name, {}) == stage
    assert stage_of(f"{name}+random", {}) == stage


def test_an_arm_of_ones_own_has_its_rule_and_its_control() -> None:
    spec = _spec("ppo", NEWEST)
    assert [arm.label for arm in spec.arms] == ["ppo", NEWEST, f"{NEWEST}+random"]
    ppo, rule, control = (check(arm, "Hopper-v5") for arm in spec.arms)
    assert (ppo.sampler, rule.sampler, control.sampler) == ("none", NEWEST, NEWEST)
    assert (rule.control, control.control) == ("none", "random")
    assert (ppo.normalize_over, rule.normalize_over) == ("minibatch", "rollout")
    assert controls_of(spec.arms) == {NEWEST: f"{NEWEST}+random"}


def test_a_filter_of_ones_own_is_an_arm_with_the_head() -> None:
    _, rule, control = _spec("ppo", LIKELY).arms
    config = check(rule, "Hopper-v5")
    assert config.filter == LIKELY and config.vex_coef > 0 and config.sampler == "none"
    assert check(control, "Hopper-v5").control == "random"


def test_verdicts_know_the_control_of_a_rule_of_ones_own() -> None:
    spec = _spec("ppo", NEWEST, "top-advantage")
    cells = {
        arm.label: Cell("t", arm.label, arm.arm, arm.baseline, [], 0, 0, 0, None, vars_of(arm))
        for arm in spec.arms
    }
    pairs = {(o, c) for o in cells for c in cells if is_random_control(cells[o], cells[c])}
    assert pairs == {(f"{rule}+random", rule) for rule in (NEWEST, "top-advantage")}
    controls = [label for label, c in cells.items() if is_control_among(c, [*cells.values()])]
    assert controls == [f"{NEWEST}+random", "top-advantage+random"]


def vars_of(arm: object) -> dict[str, object]:
    return vars(check(arm, "Hopper-v5"))  # type: ignore[arg-type]


def test_arguments_go_to_the_rule_of_ones_own_alone() -> None:
    spec = _spec("ppo", NEWEST, "gigaflow", sampler_kwargs='{"share": 0.25}')
    kwargs = {arm.label: check(arm, "Hopper-v5").sampler_kwargs for arm in spec.arms}
    own = {label for label, text in kwargs.items() if text != "{}"}
    assert own == {NEWEST, f"{NEWEST}+random"}


def test_a_rule_of_ones_own_plays_a_tournament() -> None:
    spec = _spec(rules=(NEWEST, "gigaflow"))
    assert spec.looks and NEWEST in controls_of(spec.arms)
    typed = compare_command("Hopper-v5", COMPARED, {}, "runs", (NEWEST, "gigaflow"))
    assert typed.endswith(f"--rules {NEWEST},gigaflow")


@pytest.mark.parametrize("setting", [("sampler", NEWEST), ("loss_weight", "delight")])
def test_a_rule_under_the_name_of_another_arm_is_refused(setting: tuple[str, str]) -> None:
    with pytest.raises(BadInput, match=f"write --arms ppo,{setting[1]}"):
        chosen_arms(("ppo",), (), True, dict([setting]))


@pytest.mark.parametrize("name", ["own_rules:no_rule", "own_rules:jax"])
def test_what_is_no_rule_is_no_arm(name: str) -> None:
    if name.endswith("no_rule"):  # takes `setup`: only making it tells
        assert stage_of(name, {}) == "sampler"
        return
    with pytest.raises(BadInput, match="is no Sampler, StepFilter"):
        stage_of(name, {})


def test_units_are_called_by_the_rule_without_what_folders_cannot_hold() -> None:
    arms = ("ppo", NEWEST, f"{NEWEST}+random", LIKELY)
    spec = comparison("Hopper-v5", arms, {"seeds": (0, 1)})
    names = [unit.name.rsplit("_", 2)[0] for unit in units_of(spec, 2)]
    assert names == [
        "Hopper-v5_ppo",
        "Hopper-v5_ppo+own_rules.newest",
        "Hopper-v5_ppo+own_rules.newest+random",
        "Hopper-v5_sauna+own_rules.likely",
    ]


def test_the_command_of_a_study_that_names_code_says_trust() -> None:
    text = {"tasks": ["Hopper-v5"], "arms": [{"label": "x", "arm": "ppo", "sampler": NEWEST}]}
    assert study_command("mine.toml", "runs", text) == "sauna study mine.toml --trust"
    assert study_command("table1", "runs", {"tasks": ["A-v0"]}) == "sauna study table1"
