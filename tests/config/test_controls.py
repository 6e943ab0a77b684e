"""Which arms get a matched random control, and which have one already."""

from __future__ import annotations

import pytest

from sauna.config.controls import control_of, rule_of, with_controls
from sauna.config.presets import ARMS, resolve


@pytest.mark.parametrize("arm", ["gigaflow", "sauna", "delight", "sauna+avec", "kondo"])
def test_an_arm_that_chooses_samples_has_a_control_that_can_be_trained(arm: str) -> None:
    control = control_of(arm)
    assert control == f"{arm}+random" and rule_of(control) == arm
    assert resolve({"env": "A-v0", "arm": control}).control == "random"


WITHOUT = "ppo vex-head random-drop espo target-kl spo positive recompute avec merl sauna-reference"


@pytest.mark.parametrize("arm", [*WITHOUT.split(), "gigaflow+random", "gigaflow+stride"])
def test_other_arms_have_none(arm: str) -> None:
    assert control_of(arm) is None


def test_an_arm_that_is_not_known_is_left_to_the_one_who_reads_it() -> None:
    assert control_of("gigaflwo") is None and rule_of("random") is None


def test_no_control_if_the_settings_allow_none() -> None:
    assert control_of("sauna", {"gae_over": "kept", "truncation": "terminate"}) is None
    assert control_of("gigaflow", {"control": "stride"}) is None


def test_each_rule_is_followed_by_its_control() -> None:
    assert with_controls(("ppo", "gigaflow", "spo"), {}) == (
        "ppo",
        "gigaflow",
        "gigaflow+random",
        "spo",
    )


@pytest.mark.parametrize("named", ["gigaflow+random", "gigaflow+stride"])
def test_a_control_that_is_named_is_the_only_one(named: str) -> None:
    assert with_controls(("ppo", "gigaflow", named), {}) == ("ppo", "gigaflow", named)


def test_random_drop_is_the_control_of_a_filter_alone() -> None:
    arms = ("ppo", "random-drop", "sauna", "pods")
    assert with_controls(arms, {}) == (*arms, "pods+random")


def test_every_arm_that_has_a_sampler_a_filter_or_a_weight_has_a_control() -> None:
    for arm, settings in ARMS.items():
        chooses = any(settings.get(n, "none") != "none" for n in ("filter", "sampler"))
        chooses |= "loss_weight" in settings
        without = arm in ("random-drop", "sauna-reference")  # a control, and GAE over kept steps
        assert (control_of(arm) is not None) == (chooses and not without), arm
