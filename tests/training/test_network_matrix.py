"""Every rule of selection works with the MLP, and rules of each kind with other networks."""

from __future__ import annotations

import numpy as np
import pytest

from helpers import make_job, train_here

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
    "rows together": {"env": "vector_envs:same", "hidden": "6", "dropped": "mask"},
}
# Those whose interface to a network differs: a filter, the head's gradient, a head of its own,
# values anew, a weight of the loss.
KINDS = ["sauna", "gradient-norm", "merl", "recompute", "delight"]
ARMS = [
    *KINDS,
    *("sauna-paper", "sauna-reference", "vex-head", "random-drop", "gigaflow", "top-advantage"),
    *("prioritized", "kondo", "pods", "vex-oracle", "positive", "sample-dropout", "espo"),
    *("target-kl", "spo", "avec", "gigaflow+random"),
]
PAIRS = [
    *((arm, "mlp") for arm in ARMS),
    *((arm, "rows together") for arm in KINDS),
    *((arm, "small-cnn") for arm in ("sauna", "gradient-norm", "merl")),
    *((arm, "impala-cnn") for arm in ("sauna", "gradient-norm")),
]
FAST = [("sauna", "small-cnn")]


@pytest.mark.parametrize(
    "arm, network",
    [pair if pair in FAST else pytest.param(*pair, marks=pytest.mark.slow) for pair in PAIRS],
)
def test_a_rule_learns_with_a_network(arm: str, network: str) -> None:
    settings = {"arm": arm, "rollout_steps": 16, "envs": 2, "epochs": 1, **NETWORKS[network]}
    if arm == "recompute":
        settings["epochs"] = 2
    if arm == "random-drop":
        settings["drop_rate"] = 0.3
    if "dropped" in settings and arm not in ("sauna", "sauna-paper", "random-drop"):
        del settings["dropped"]  # which only a filter reads
    found = train_here(make_job(**settings, steps=128))
    assert {row["arm"] for row in found.rows} == {arm} and len(found.rows) > 1
    first, last = (found.states[min(found.states)], found.final)
    assert all(np.isfinite(last[name]).all() for name in last if "/params/" in name)
    assert found.rows[-1]["policy_loss"] != 0.0 and first.keys() == last.keys()
