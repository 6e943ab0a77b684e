"""Rules of a user's own, written as the documentation says, and with the mistakes users make."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna import (
    Choice,
    Hypers,
    LossTerms,
    LossWeight,
    Sampler,
    SamplerSetup,
    Samples,
    ScoredStep,
    StepFilter,
    StopRule,
)

nothing = StepFilter(
    lambda num_envs, capacity: (), lambda state, step, key, hypers: (state, step.vex > jnp.inf)
)


def likely(least: float = -3.0) -> StepFilter:
    """Keeps the steps whose action was not too unlikely."""

    def keep(
        state: tuple[()], step: ScoredStep, key: jax.Array, hypers: Hypers
    ) -> tuple[tuple[()], jax.Array]:
        return state, step.log_prob >= least

    return StepFilter(lambda num_envs, capacity: (), keep)


def newest(setup: SamplerSetup, share: float = 0.5) -> Sampler:
    """Keeps the last steps of each rollout."""
    first = setup.rows - int(share * setup.rows)

    def choose(count: jax.Array, samples: Samples, key: jax.Array) -> tuple[jax.Array, Choice]:
        late = jnp.arange(setup.rows) >= first
        return count + 1, Choice(keep=late & samples.present, score=late.astype(jnp.float32))

    return Sampler(lambda: 0, choose, share=share, reads_policy=True)


def no_rule(setup: SamplerSetup) -> int:
    return 3


def _by(choose: object) -> Sampler:
    return Sampler(lambda: (), choose)  # type: ignore[arg-type]


scoreless = _by(lambda state, s, key: (state, Choice(keep=s.present)))
too_short = _by(lambda state, s, key: (state, Choice(keep=s.present[1:])))
by_number = _by(lambda state, s, key: (state, Choice(keep=s.advantage)))
both = _by(lambda state, s, key: (state, Choice(keep=s.present, probability=s.advantage)))
neither = _by(lambda state, s, key: (state, Choice(score=s.advantage)))
mask_alone = _by(lambda state, s, key: (state, s.present))
unpaired = _by(lambda state, s, key: Choice(keep=s.present))
misspelt = _by(lambda state, s, key: (state, Choice(keep=s.advantages > 0)))
growing = Sampler(
    lambda: jnp.zeros(2), lambda state, s, key: (jnp.zeros(3), Choice(keep=s.present))
)
of_nothing = _by(scoreless.choose)._replace(share=0.0)


def softened(power: float = 1.0) -> LossWeight:
    """Weakens terms whose ratio is far from 1."""

    def weight(terms: LossTerms) -> tuple[jax.Array, jax.Array]:
        return terms.present, jnp.exp(-power * jnp.abs(terms.log_ratio))

    return LossWeight(weight)


single = LossWeight(lambda terms: terms.present)  # type: ignore[arg-type, return-value]
summed = LossWeight(lambda terms: (terms.present, jnp.sum(terms.log_ratio)))


def far(limit: float = 0.5) -> StopRule:
    return StopRule(lambda log_ratio, weight: jnp.max(jnp.abs(log_ratio) * weight) > limit)


each = StopRule(lambda log_ratio, weight: log_ratio > 0.5)
amount = StopRule(lambda log_ratio, weight: jnp.max(log_ratio))


def robust(error: jax.Array, weight: jax.Array) -> jax.Array:
    """The mean of `log cosh` of the errors: large ones count as their size."""
    loss = jnp.logaddexp(error, -error) - jnp.log(2.0)
    return jnp.sum(loss * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def one_sided(log_ratio: jax.Array, advantage: jax.Array, clip_range: jax.Array) -> jax.Array:
    """PPO's term with the clip above alone."""
    ratio = jnp.exp(log_ratio)
    return -advantage * jnp.minimum(ratio, 1.0 + clip_range)


def each_error(error: jax.Array, weight: jax.Array) -> jax.Array:
    return error**2 * weight


def averaged(log_ratio: jax.Array, advantage: jax.Array, clip_range: jax.Array) -> jax.Array:
    return -jnp.mean(advantage * jnp.exp(log_ratio))
