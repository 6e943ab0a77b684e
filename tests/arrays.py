"""Random rollouts and minibatches, and hyperparameters, for tests of the learner."""

from __future__ import annotations

import numpy as np

from sauna.algorithm.types import Batch, Hypers, Rollout
from sauna.envs.spaces import Spaces


def random_rollout(seed: int, steps: int = 40, envs: int = 3, keep_rate: float = 1.0) -> Rollout:
    rng = np.random.default_rng(seed)
    shape = (steps, envs)
    terminated = rng.random(shape) < 0.1
    truncated = (rng.random(shape) < 0.1) & ~terminated
    value = rng.normal(size=shape)
    next_value = np.where(terminated | truncated, rng.normal(size=shape), np.roll(value, -1, 0))
    next_value[-1] = rng.normal(size=envs)
    return Rollout(
        observation=rng.normal(size=(*shape, 2)),
        action=rng.normal(size=(*shape, 1)),
        log_prob=rng.normal(size=shape),
        reward=rng.normal(size=shape),
        value=value,
        next_value=next_value,
        vex=rng.normal(size=shape),
        terminated=terminated,
        truncated=truncated,
        valid=np.ones(shape, bool),
        keep=rng.random(shape) < keep_rate,
    )


VECTOR = Spaces("vector", (3,), "continuous", (2,), "", "")


def hypers(**values: float) -> Hypers:
    start = {
        "learning_rate": 0.01,
        "clip_range": 0.2,
        "gamma": 0.9,
        "gae_lambda": 0.8,
        "entropy_coef": 0.01,
        "value_coef": 0.5,
        "vex_coef": 0.3,
        "max_grad_norm": 0.5,
        "threshold": 0.3,
        "drop_rate": 0.0,
    }
    return Hypers(**{k: np.float64(v) for k, v in {**start, **values}.items()})


def random_batch(number: int = 24, seed: int = 0) -> Batch:
    rng = np.random.default_rng(seed)
    weight = (rng.random(number) < 0.8).astype(float)
    draw = lambda *shape: rng.normal(size=(number, *shape))  # noqa: E731
    return Batch(draw(3), draw(2), draw() - 2.5, draw(), draw(), draw(), draw(), weight)
