"""Streams of env steps as the learner would get them, of as many environments as it needs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from sauna.algorithm.policy.normalize import Moments, scale_rewards
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.types import Memory, Rollout
from sauna.config.settings import Config
from sauna.envs.host.answers import close
from sauna.envs.make import make_env
from sauna.envs.wrapping import wrapping_of
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.inspect.decisions import environments
from sauna.experiments.inspect.learned import reads_rollouts
from sauna.experiments.inspect.recording import Played, joined, play_steps

MANY = 20_000  # env steps beside those that are shown, of which a line tells


def more_plays(
    config: Config,
    policy: TrainedPolicy,
    env: Any,
    played: Played,
    deterministic: bool,
    seed: int,
    max_steps: int,
    say: Callable[[str], None],
) -> list[Played]:
    """The play that is shown, and what else the run's rules look at; closes `env`.

    A rule that looks at several environments needs them all. One that looks at a whole rollout
    needs the steps, behind those that are shown, that fill the last one.
    """
    steps, number = len(played.reward), environments(config)
    if reads_rollouts(config):
        number = config.envs
        needed = -(-steps // config.rollout_steps) * capacity(config)
        if needed * number - steps > MANY:
            say(f"{policy.name}: its rule looks at whole rollouts: {needed * number:,} env steps")
        if needed > steps:
            first = len(played.returns)
            rest = needed - steps
            more = play_steps(policy, env, rest, deterministic, seed, 0, first, max_steps)
            played = joined(played, more)
    close(env)
    plays = [played]
    for n in range(1, number):
        env = make_env(config.env, json.loads(config.env_kwargs), wrapping_of(config))
        length = len(played.reward)
        plays.append(play_steps(policy, env, length, deterministic, seed, n, max_steps=max_steps))
        close(env)
    return plays


def stream_of(
    policy: TrainedPolicy, config: Config, own: Mapping[str, np.ndarray], played: Played
) -> Rollout:
    """A play as the collector would hand it on, `[L]`; `own` are the member's arrays."""
    ends = np.flatnonzero(played.terminated | played.truncated)
    if len(played.final) > len(ends):
        ends = np.append(ends, len(played.reward) - 1)  # the episode was left there
    memory = None
    if policy.policy.state_size:
        scores, after, memory = remembered(policy, played, ends)
        log_prob, value, vex = scores.T
    else:
        value, vex = policy.heads(played.observation)
        log_prob = policy.log_prob(played.observation, played.action)
        after = policy.heads(played.final)[0]
    next_value = np.append(value[1:], 0.0).astype(np.float32)
    next_value[ends] = np.where(played.terminated[ends], 0.0, after)
    columns: dict[str, Any] = {
        "observation": played.observation,
        "action": played.action,
        "log_prob": log_prob,
        "reward": scaled(config, own, played.reward).astype(np.float32),
        "value": value,
        "next_value": next_value,
        "vex": vex,
        "terminated": played.terminated | played.life_lost,
        "truncated": played.truncated,
        "valid": np.ones(len(value), bool),
        "keep": np.ones(len(value), bool),
        "memory": memory,
    }
    return Rollout(**columns)


def remembered(
    policy: TrainedPolicy, played: Played, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Memory]:
    """What a recurrent policy gives for a play, whose episodes end (or are left) at rows `ends`.

    Returns:
      log-probability, value and Vex `[L, 3]`; the value where each episode ended `[E]`, which the
      policy sees after its last row; where episodes start `[L]`, and the state before every row
      `[L, H]`.
    """
    behind = ends + 1  # the final observations stand there, each before a start
    start = np.isin(np.arange(len(played.reward)), [0, *behind])
    scores, state = policy.scores(
        np.insert(played.observation, behind, played.final, 0),
        np.insert(played.action, behind, 0, 0),
        np.insert(start, behind, False),
    )
    final = behind + np.arange(len(behind))
    own = np.delete(np.arange(len(scores)), final)
    return scores[own], scores[final, 1], Memory(start, state[own])


def stacked(streams: list[Rollout]) -> Rollout:
    """Streams `[L]` of N environments as one `[L, N]`."""
    together: Rollout = jax.tree.map(lambda *parts: np.stack(parts, 1), *streams)
    return together


def scaled(config: Config, own: Mapping[str, np.ndarray], reward: np.ndarray) -> np.ndarray:
    """Returns raw rewards `[L]` as the value function learns them, with the frozen reward
    normaliser."""
    if config.sign_rewards:
        reward = np.sign(reward)
    if not config.normalize_rewards:
        return reward
    on_host = "reward_moments/variance" in own  # the device keeps it with what it collects
    place = "reward_moments" if on_host else "collect/reward_moments"
    moments = Moments(*(np.float64(own[f"{place}/{part}"]) for part in Moments._fields))
    return scale_rewards(moments, reward[:, None], config.clip_rewards)[:, 0]
