"""Random rollouts and minibatches, and hyperparameters, for tests of the learner.

What tests call often is one program: else each of its operations is compiled by itself.
"""

from __future__ import annotations

from functools import partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.learner.losses import Losses, Minibatch
from sauna.algorithm.learner.samples import make_batch
from sauna.algorithm.learner.update import Parts, minibatch_losses, plain_minibatch
from sauna.algorithm.learner.vex_targets import TARGETS
from sauna.algorithm.policy.distributions import Distribution
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.selection.registry import Rules
from sauna.algorithm.types import Batch, Hypers, PolicyOutput, Rollout, ScoredStep
from sauna.config.settings import Config
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


def parts_of(config: Config, policy: Policy, target: str = "sample", **rules: Any) -> Parts:
    return Parts(config, policy, TARGETS[target], Rules(**rules))


batch_of = jax.jit(make_batch, static_argnames=("config", "target"))


@partial(jax.jit, static_argnames="parts")
def losses_on(params: Any, batch: Batch, h: Hypers, parts: Parts) -> Losses:
    """The objective on a batch as one minibatch."""
    return minibatch_losses(params, plain_minibatch(batch, parts), h, parts=parts)


def losses_of_terms(
    objective: ModuleType,
    h: Hypers,
    config: Config,
    *,
    log_ratio: Any,
    advantage: Any,
    value: Any,
    old: Any,
    return_: Any,
    vex: Any,
    vex_target: Any,
    entropy: Any,
    weight: Any,
    **rules: Any,
) -> Losses:
    """An objective on rows `[B]` whose log-probabilities and entropies are given, not computed."""
    weight = jnp.asarray(weight)
    zero = jnp.zeros(len(weight))
    output = PolicyOutput(
        jnp.stack([jnp.asarray(log_ratio), jnp.asarray(entropy)], -1),
        jnp.asarray(value),
        jnp.asarray(vex),
        zero[:, None],
        None,
    )
    rows = Batch(
        zero,
        zero,
        zero,
        jnp.asarray(advantage),
        jnp.asarray(return_),
        jnp.asarray(old),
        jnp.asarray(vex_target),
        weight,
    )
    nothing: Any = None
    as_given = Distribution(
        1, False, nothing, nothing, lambda p, a: p[..., 0], lambda p: p[..., 1], nothing
    )
    minibatch = Minibatch(rows, rows, rows.advantage, rows.vex_target, weight, None, weight, None)
    return objective.losses(
        output, output, minibatch, h, config=config, distribution=as_given, rules=Rules(**rules)
    )


def no_key() -> Any:
    """A key for what draws nothing."""
    return jax.random.key(0)


def unscored(observation: Any, vex: Any) -> ScoredStep:
    """Steps of which only observation and Vex are looked at; the rest is NaN."""
    nan = jnp.full(jnp.shape(vex), jnp.nan)
    return ScoredStep(observation, nan[..., None], nan, nan, vex)
