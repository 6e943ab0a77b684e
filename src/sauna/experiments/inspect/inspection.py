"""Episodes of a trained policy, with all that training computes of such steps."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sauna.algorithm.policy.normalize import Moments, scale_rewards
from sauna.algorithm.types import Hypers, Rollout, ScoredStep, member_keys
from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.envs.host.answers import close
from sauna.envs.make import make_env
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.evaluate.video import frames_per_second
from sauna.experiments.inspect.decisions import Decisions, advantages, decide, environments
from sauna.experiments.inspect.recording import Played, open_env, play_episodes, play_steps
from sauna.system import run_directory
from sauna.system.checkpoint import BadCheckpoint
from sauna.training.artifact import Artifact
from sauna.training.loop.budget import hypers_now
from sauna.training.loop.member_state import Counters, under

LARGEST = 10_000_000  # numbers in the matrix whose principal components are computed


class Inspection(NamedTuple):
    """All that the page shows; every array is `[L]` over env steps unless it says otherwise."""

    member: Member
    iteration: int  # of the checkpoint
    env_steps: int  # that the member had been trained for
    mode: str  # sampled or deterministic
    seed: int
    played: Played
    steps_per_second: float  # of the environment's own clock
    decisions: Decisions
    environments: int  # that each decision looked at
    head: bool  # whether a Vex head was trained
    hypers: Hypers
    trained_keep_rate: float | None  # of the last iteration before the checkpoint
    reward: np.ndarray  # in the units of `value`
    value: np.ndarray
    advantage: np.ndarray  # NaN where the run computes none
    points: np.ndarray | None  # [L, 2] principal components of the observations
    shares: list[float]  # of their variance, along both


def examine(
    run: Path,
    artifact: Artifact,
    name: str,
    episodes: int,
    deterministic: bool,
    seed: int,
    frames: bool,
    say: Callable[[str], None],
    max_steps: int = MAX_STEPS,
) -> Inspection:
    """Plays, and computes what the page shows."""
    manifest = artifact.checkpoint.manifest
    everyone = artifact.run.members
    member = next((one for one in everyone if one.name == name), None)
    if member is None:
        raise BadCheckpoint(f"{artifact.checkpoint.path}: its config has no member {name!r}")
    config, iteration = member.config, int(manifest["iteration"])
    kwargs = json.loads(config.env_kwargs)
    env, drawer = open_env(config.env, kwargs, frames, say)
    policy = TrainedPolicy(artifact, name, env)
    played = play_episodes(policy, env, episodes, deterministic, seed, drawer, max_steps, say)
    steps_per_second = frames_per_second(env)
    close(env)
    own = under(name + "/", artifact.checkpoint.arrays)
    rows = [
        row
        for row in run_directory.rows(run)
        if row["member"] == name and row["iteration"] < iteration
    ]
    trained_keep_rate = rows[-1]["keep_rate"] if rows else None
    hypers = hypers_of(config, own, trained_keep_rate)
    steps, number = len(played.reward), environments(config)
    seen = [played.observation]
    for n in range(1, number):
        env = make_env(config.env, kwargs)
        seen.append(play_steps(policy, env, steps, deterministic, seed, n))
        close(env)
    value, own_vex = policy.heads(played.observation)
    vex = np.stack([own_vex, *(policy.heads(x)[1] for x in seen[1:])], 1)
    key = jax.random.fold_in(member_keys(member.seed).filter, iteration)
    none: Any = np.zeros(vex.shape, np.float32)
    observed: Any = np.stack(seen, 1)
    scored = ScoredStep(observed, none[..., None], none, none, vex)
    decisions = decide(config, scored, key, hypers)
    reward = scaled(config, own, played.reward)
    stream = _stream(policy, played, reward, value, decisions.keep)
    points, shares = principal_components(played.observation)
    return Inspection(
        member=member,
        iteration=iteration,
        env_steps=int(own["counters/env_steps"]),
        mode="deterministic" if deterministic else "sampled",
        seed=seed,
        played=played,
        steps_per_second=steps_per_second,
        decisions=decisions,
        environments=number,
        head=config.vex_coef > 0,
        hypers=hypers,
        trained_keep_rate=trained_keep_rate,
        reward=reward,
        value=value,
        advantage=advantages(config, stream, decisions.rollouts, hypers),
        points=points,
        shares=shares,
    )


def hypers_of(
    config: Config, own: Mapping[str, np.ndarray], trained_keep_rate: float | None
) -> Hypers:
    """Returns the member's traced settings, at the checkpoint's iteration; `own` are its arrays.

    A random-drop run without a rate is one of 0.1.0 that repeated the rates of another run: its
    rate is what it dropped in the iteration before.
    """
    hypers = hypers_now(config, Counters.from_arrays(own))
    if config.filter == "random-drop" and not config.drop_rate and trained_keep_rate is not None:
        return hypers._replace(drop_rate=np.float32(1.0 - trained_keep_rate))  # type: ignore[arg-type]
    return hypers


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


def _stream(
    policy: TrainedPolicy, played: Played, reward: np.ndarray, value: np.ndarray, keep: np.ndarray
) -> Rollout:
    """The episodes as the collector would hand them on, `[L, 1]`."""
    ends = np.flatnonzero(played.terminated | played.truncated)
    next_value = np.append(value[1:], 0.0).astype(np.float32)
    next_value[ends] = np.where(played.truncated[ends], policy.heads(played.final)[0], 0.0)
    column: Any = {
        "reward": reward.astype(np.float32),
        "value": value,
        "next_value": next_value,
        "terminated": played.terminated | played.life_lost,
        "truncated": played.truncated,
        "valid": np.ones(len(value), bool),
        "keep": keep,
    }
    nothing = np.zeros(len(value), np.float32)  # what GAE does not read
    fields = [column.get(field, nothing)[:, None] for field in Rollout._fields]
    return Rollout(*fields)


def pixel_stride(observation: np.ndarray) -> int:
    """Returns n for images `[L, H, W, C]` whose components are taken of each n-th row and
    column."""
    if observation.ndim < 4:
        return 1
    return max(1, math.ceil(math.sqrt(observation.size / LARGEST)))


def principal_components(
    observation: np.ndarray,
) -> tuple[np.ndarray | None, list[float]]:
    """Returns the first two principal components `[L, 2]` of `[L, *obs]`, and their shares of
    variance.

    Of each component the sign is such that its largest loading is positive. Of frames only so
    many pixels are looked at that the matrix stays small; None where it is too large all the same.
    """
    every = pixel_stride(observation)
    observation = observation[:, ::every, ::every] if every > 1 else observation
    if observation.size > LARGEST:
        return None, []
    flat = observation.reshape(len(observation), -1).astype(np.float64)
    left, scale, loadings = np.linalg.svd(flat - flat.mean(0), full_matrices=False)
    largest = np.abs(loadings).argmax(1)
    scores = left * scale * np.sign(loadings[np.arange(len(loadings)), largest])
    points = np.zeros((len(flat), 2))
    points[:, : min(2, len(scale))] = scores[:, :2]
    total = float((scale**2).sum()) or 1.0
    return points, [float(s) ** 2 / total for s in scale[:2]]
