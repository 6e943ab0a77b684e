"""Random samples, and choices as numpy arrays, for tests of rules of selection."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.types import Choice, Sampler, SamplerSetup, Samples

STEPS, ENVS = 20, 3
ROWS = STEPS * ENVS
SETUP = SamplerSetup(STEPS, ENVS, 5, "continuous", (2,))
DISCRETE = SETUP._replace(action_kind="discrete", action_sizes=(4,))


def random_samples(
    seed: int, *, setup: SamplerSetup = SETUP, absent: float = 0.2, rows: int = ROWS
) -> Samples:
    """Rows of which some are absent. Advantages have heavy tails: many are close to 0."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(size=(rows, *shape)), jnp.float32)  # noqa: E731
    present = jnp.asarray(rng.random(rows) >= absent)
    advantage, value, hidden = draw() ** 3, draw(), draw(5)
    return_ = value + draw() * jnp.where(draw() > 0, 0.3, 1.0)
    if setup.action_kind == "continuous":
        size = setup.action_sizes[0]
        log_std = jnp.broadcast_to(draw(size)[:1] * 0.3, (rows, size))
        mean = draw(size)
        action, policy = mean + jnp.exp(log_std) * draw(size), jnp.concatenate([mean, log_std], -1)
        entropy = jnp.sum(log_std, -1) + 0.5 * size * (1.0 + np.log(2.0 * np.pi))
    else:
        sizes = setup.action_sizes
        policy, entropy = draw(sum(sizes)), jnp.abs(draw())
        action = jnp.asarray(np.stack([rng.integers(n, size=rows) for n in sizes], -1), jnp.int32)
    on = np.asarray(advantage)[np.asarray(present)]
    standardized = (advantage - on.mean()) / (on.std() + 1e-8)
    return Samples(
        present,
        draw(3),
        action,
        draw() - 1.5,
        advantage,
        standardized,
        return_,
        value,
        return_ - value,
        draw(),
        0.3 * draw(),
        policy,
        hidden,
        entropy,
    )


def chosen(sampler: Sampler, samples: Samples, state: Any = None, seed: int = 0) -> Choice:
    """What the sampler takes, as numpy arrays."""
    before = sampler.init() if state is None else state
    _, choice = sampler.choose(before, samples, jax.random.key(seed))
    return jax.tree.map(np.asarray, choice)


def of_present(samples: Samples, *names: str) -> list[np.ndarray]:
    """Fields of the rows that are present, in float64."""
    on = np.asarray(samples.present)
    arrays = [np.asarray(getattr(samples, name))[on] for name in names]
    return [x.astype(np.float64) if x.dtype == np.float32 else x for x in arrays]


def spread(samples: Samples, array: np.ndarray) -> np.ndarray:
    """Puts an array of the rows that are present at their places; 0 or False elsewhere."""
    on = np.asarray(samples.present)
    full = np.zeros((len(on), *array.shape[1:]), array.dtype)
    full[on] = array
    return full
