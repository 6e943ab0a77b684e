"""Settings of a file, and what is typed over them."""

from __future__ import annotations

from typing import Any

import pytest

from sauna.config.accepted import over, translate


@pytest.mark.parametrize(
    ("stored", "typed", "expected"),
    [
        ({"seeds": [0, 1]}, {"seed": "5"}, {"seed": "5"}),
        ({"seed": 5}, {"seeds": "0,1"}, {"seeds": "0,1"}),
        ({"batch_size": 64}, {"minibatches": "2"}, {"minibatches": "2"}),
        ({"target_kl": 0.02}, {"stop": "none"}, {"stop": "none"}),
        (
            {"stop": "target-kl", "stop_kwargs": {"limit": 0.01}},
            {"stop": "espo"},
            {"stop": "espo"},
        ),
        (
            {"stop": "target-kl", "stop_kwargs": {"limit": 0.01}},
            {"target_kl": "0.03"},
            {"target_kl": "0.03"},
        ),
        (  # the same rule keeps its arguments
            {"sampler": "pods", "sampler_kwargs": {"share": 0.5}},
            {"sampler": "pods"},
            {"sampler": "pods", "sampler_kwargs": {"share": 0.5}},
        ),
        (
            {"optimizer": "adamw", "optimizer_kwargs": {"weight_decay": 0.1}, "gamma": 0.9},
            {"optimizer": "sgd", "optimizer_kwargs": "{}"},
            {"gamma": 0.9, "optimizer": "sgd", "optimizer_kwargs": "{}"},
        ),
        ({"env": "a", "env_kwargs": {"n": 1}}, {"env": "b"}, {"env": "b"}),
        ({"env": "a", "env_kwargs": {"n": 1}}, {"steps": 9}, None),
        (  # what nothing reads any more
            {"eval_every": 9, "eval_episodes": 2, "stop_at": 5.0, "gamma": 0.9},
            {"eval_every": "0"},
            {"eval_every": "0", "gamma": 0.9},
        ),
        ({"arm": ["sauna"], "threshold": 0.8}, {"arm": "ppo"}, {"arm": "ppo"}),
        ({"arm": ["vex-head"], "vex_coef": 0.25}, {"arm": "ppo"}, {"arm": "ppo"}),
        (  # and what was read for its sake alone
            {"stop": "target-kl", "stop_kwargs": {"limit": 0.01}},
            {"algorithm": "a2c"},
            {"algorithm": "a2c"},
        ),
        ({"eval_episodes": 2}, {"gamma": "0.9"}, None),  # which nothing read before: it is refused
        ({"eval_episodes": 2}, {"eval_every": "0", "eval_episodes": "3"}, None),
    ],
)
def test_what_is_typed_goes_over_what_a_file_says(
    stored: dict[str, Any], typed: dict[str, Any], expected: dict[str, Any] | None
) -> None:
    found = over(stored, typed)
    assert found == ({**stored, **typed} if expected is None else expected)
    translate({"env": "CartPole-v1", **found})  # none of them is given twice
