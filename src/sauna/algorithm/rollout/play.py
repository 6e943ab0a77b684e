"""Whole episodes with a frozen policy: one by one on the host, all at once on the device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout import MAX_STEPS
from sauna.algorithm.types import Array
from sauna.config.settings import Config
from sauna.envs.device.contract import JaxEnv
from sauna.envs.host.answers import one_number, reset_with

_RESET = 2**31  # apart from the numbers of env steps, whose keys draw the actions


class Episode(NamedTuple):
    """One episode as it was played."""

    return_: float  # of raw rewards
    length: int  # env steps
    cut: bool  # whether it had not ended


def play(
    policy: FrozenPolicy,
    env: Any,
    deterministic: bool,
    seed: int,
    watch: Callable[[], None] = lambda: None,
    max_steps: int = MAX_STEPS,
) -> Episode:
    """Plays one episode, cut after `max_steps` env steps.

    Args:
      watch: called after the reset and after each env step.
    """
    key = jax.random.key(seed)
    observation = reset_with(env, seed)
    watch()
    return_, length, ended = 0.0, 0, False
    while not ended and length < max_steps:
        step_key = None if deterministic else jax.random.fold_in(key, length)
        action = policy(observation, deterministic=deterministic, key=step_key)
        observation, reward, terminated, truncated, _ = env.step(action)
        return_, length = return_ + one_number(reward), length + 1
        ended = bool(terminated or truncated)
        watch()
    return Episode(return_, length, not ended)


class Played(NamedTuple):
    """E episodes that were played on the device."""

    return_: Array  # [E] float32, of raw rewards
    length: Array  # [E] int32
    cut: Array  # [E] bool, whether it had not ended


class _Now(NamedTuple):
    t: Array
    state: Any
    observation: Array
    return_: Array
    length: Array
    ended: Array


def play_on_device(
    params: Array,
    moments: Moments | None,
    keys: Array,
    *,
    config: Config,
    env: JaxEnv,
    policy: Policy,
    deterministic: bool,
    max_steps: int = MAX_STEPS,
) -> Played:
    """Plays an episode for each of `keys` `[E]`, cut after `max_steps` env steps.

    Args:
      params: `[D]`; moments: of `[obs]`, None if nothing is normalised.
      env: flat.
    """
    distribution = policy.distribution

    def act(now: _Now) -> Array:
        seen = now.observation
        if moments is not None:
            seen = normalize(moments, seen, config.clip_observations)
        parameters = policy.apply(params, seen).policy
        if deterministic:
            return distribution.mode(parameters)
        own = jax.vmap(jax.random.fold_in, (0, None))(keys, now.t)
        noise = jax.vmap(lambda key: distribution.draw(key, ()))(own)
        return distribution.sample(parameters, noise)

    def step(now: _Now) -> _Now:
        transition = jax.vmap(env.step)(now.state, act(now))
        running = ~now.ended
        return _Now(
            now.t + 1,
            transition.state,
            transition.observation,
            now.return_ + jnp.where(running, transition.reward, 0.0),
            now.length + running,
            now.ended | transition.terminated | transition.truncated,
        )

    state, observation = jax.vmap(lambda key: env.reset(jax.random.fold_in(key, _RESET)))(keys)
    zeros = jnp.zeros(len(keys), jnp.float32)
    first = _Now(
        jnp.int32(0), state, observation, zeros, zeros.astype(jnp.int32), zeros.astype(bool)
    )
    last = jax.lax.while_loop(lambda now: (now.t < max_steps) & ~jnp.all(now.ended), step, first)
    return Played(last.return_, last.length, ~last.ended)
