"""Every rule of selection works with every network, a memory, bits, and rows together."""

from __future__ import annotations

import numpy as np
import pytest

from helpers import make_job, train_here
from joined_rules import JOINED, joined
from sauna.config.presets import ARMS as RULES

NETWORKS = {
    "mlp": {
        "env": "small_envs:Scripted",
        "hidden": "6",
        "value_hidden": "5,4",
        "activation": "elu",
        "layer_norm": "yes",
        "stack": 2,
    },
    "small-cnn": {"env": "small_envs:Board", "network": "small-cnn"},
    "impala-cnn": {"env": "small_envs:Board", "network": "impala-cnn", "trunk": "shared"},
    "nature-cnn": {"env": "small_envs:Picture", "network": "nature-cnn"},
    "lstm": {
        "env": "small_envs:Scripted",
        "hidden": "6",
        "recurrent": "lstm",
        "recurrent_width": 4,
        "sequence_length": 8,
    },
    "bits": {"env": "small_envs:Spaced", "env_kwargs": {"action": "multi_binary"}, "hidden": "6"},
    "rows together": {"env": "vector_envs:same", "hidden": "6", "dropped": "mask"},
}
ARMS = [*RULES, "gigaflow+random"]
FAST = [("sauna", "small-cnn")]
PAIRS = [
    *FAST,
    *((arm, "mlp") for arm in ARMS),
    *((arm, network) for network in NETWORKS if network != "mlp" for arm in JOINED),
]
FILTERS = {"sauna", "sauna-paper", "sauna-reference", "random-drop"}


def test_the_joined_arms_hold_every_rule() -> None:
    assert {part for arm in JOINED for part in arm.split("+")} == set(RULES)


@pytest.mark.parametrize(
    "arm, network",
    [pair if pair in FAST else pytest.param(*pair, marks=pytest.mark.slow) for pair in PAIRS],
)
def test_a_rule_learns_with_a_network(arm: str, network: str) -> None:
    settings = {**joined(arm), "rollout_steps": 16, "envs": 2, "epochs": 1, **NETWORKS[network]}
    rules = set(arm.split("+"))
    if "recompute" in rules:
        settings["epochs"] = 2
    if "dropped" in settings and not rules & FILTERS:
        del settings["dropped"]  # which only a filter reads
    found = train_here(make_job(**settings, steps=128))
    assert {row["arm"] for row in found.rows} == {arm} and len(found.rows) > 1
    first, last = (found.states[min(found.states)], found.final)
    assert all(np.isfinite(last[name]).all() for name in last if "/params/" in name)
    assert found.rows[-1]["policy_loss"] != 0.0 and first.keys() == last.keys()
