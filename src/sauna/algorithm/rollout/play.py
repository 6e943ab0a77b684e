"""Whole episodes with a frozen policy: one by one on the host, all at once on the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.policy.bounded import to_env
from sauna.algorithm.policy.normalize import Moments, normalize
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout import MAX_STEPS
from sauna.algorithm.types import Array
from sauna.config.settings import Config
from sauna.envs.device.contract import JaxEnv
from sauna.envs.host.answers import one_number, reset_with
from sauna.envs.info import IS_SUCCESS, SUCCESS_RATE, numbers_of

_fold_in = jax.jit(jax.random.fold_in)  # compiled: a key is drawn at every env step
_RESET = 2**31  # apart from the numbers of env steps, whose keys draw the actions


class Episode(NamedTuple):
    """One episode as it was played."""

    return_: float  # of raw rewards
    length: int  # env steps
    cut: bool  # whether it had not ended
    success: float | None = None  # `is_success` of the last `info`; None if that does not say


def play(
    policy: Callable[..., Any],
    env: Any,
    deterministic: bool,
    seed: int,
    watch: Callable[[], None] = lambda: None,
    max_steps: int = MAX_STEPS,
    hold: int = 1,
) -> Episode:
    """Plays one episode, cut after `max_steps` env steps.

    Args:
      policy: `policy(observation, deterministic=..., key=...)` gives what the environment takes;
        its `reset()` is called first, if it has one.
      watch: called after the reset and after each env step.
      hold: env steps for which sampled actions have one key; see `Policy.hold`.
    """
    key = jax.random.key(seed)
    getattr(policy, "reset", lambda: None)()
    observation = reset_with(env, seed)
    watch()
    return_, length, ended, info = 0.0, 0, False, None
    while not ended and length < max_steps:
        step_key = None if deterministic else _fold_in(key, length // hold)
        action = policy(observation, deterministic=deterministic, key=step_key)
        observation, reward, terminated, truncated, info = env.step(action)
        return_, length = return_ + one_number(reward), length + 1
        ended = bool(terminated or truncated)
        watch()
    success = numbers_of(info).get(IS_SUCCESS) if ended else None
    return Episode(return_, length, not ended, success)


def success_rate(episodes: Sequence[Episode]) -> dict[str, float]:
    """The mean over those that say whether they were a success, by its name; {} if none does."""
    known = [episode.success for episode in episodes if episode.success is not None]
    return {SUCCESS_RATE: sum(known) / len(known)} if known else {}


class Played(NamedTuple):
    """E episodes that were played on the device."""

    return_: Array  # [E] float32, of raw rewards
    length: Array  # [E] int32
    cut: Array  # [E] bool, whether it had not ended
    success: Array  # [E] float32; NaN if that is not known


class _Now(NamedTuple):
    t: Array
    state: Any
    observation: Array
    return_: Array
    length: Array
    ended: Array
    success: Array
    memory: Any  # [E, H] of a recurrent policy, else ()


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

    def act(now: _Now) -> tuple[Array, Any]:
        seen = now.observation
        if moments is not None:
            seen = normalize(moments, seen, config.clip_observations)
        output, memory = policy.step(params, seen, now.memory)
        if deterministic:
            return to_env(distribution, distribution.mode(output.policy)), memory
        own = jax.vmap(jax.random.fold_in, (0, None))(keys, now.t // policy.hold)
        noise = jax.vmap(lambda key: distribution.draw(key, ()))(own)
        return to_env(distribution, policy.sample(params, output, noise)), memory

    def step(now: _Now) -> _Now:
        action, memory = act(now)
        transition = jax.vmap(env.step)(now.state, action)
        running = ~now.ended
        success = dict(transition.info).get(IS_SUCCESS, jnp.nan)
        return _Now(
            now.t + 1,
            transition.state,
            transition.observation,
            now.return_ + jnp.where(running, transition.reward, 0.0),
            now.length + running,
            now.ended | transition.terminated | transition.truncated,
            jnp.where(running, success, now.success),
            memory,
        )

    state, observation = jax.vmap(lambda key: env.reset(jax.random.fold_in(key, _RESET)))(keys)
    zeros = jnp.zeros(len(keys), jnp.float32)
    first = _Now(
        jnp.int32(0),
        state,
        observation,
        zeros,
        zeros.astype(jnp.int32),
        zeros.astype(bool),
        zeros + jnp.nan,
        policy.initial_state(len(keys)),
    )
    last = jax.lax.while_loop(lambda now: (now.t < max_steps) & ~jnp.all(now.ended), step, first)
    success = jnp.where(last.ended, last.success, jnp.nan)
    return Played(last.return_, last.length, ~last.ended, success)
