"""Episodes of a trained policy, with all that training computes of such steps."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sauna.algorithm.learner.program import make_learner
from sauna.algorithm.types import Hypers, Rollout, ScoredStep, TrainState, member_keys
from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.envs.wrapping import wrapping_of
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.evaluate.video import frames_per_second
from sauna.experiments.inspect.decisions import Decisions, advantages, decide, until
from sauna.experiments.inspect.learned import Learned, learned, reads_rollouts
from sauna.experiments.inspect.recording import Played, open_env, play_episodes
from sauna.experiments.inspect.streams import more_plays, scaled, stacked, stream_of
from sauna.system import run_directory
from sauna.system.checkpoint import BadCheckpoint, under
from sauna.system.errors import BadInput
from sauna.training.artifact import Artifact
from sauna.training.loop.budget import hypers_now
from sauna.training.loop.member_state import Counters, unpack_learner

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
    learned: Learned | None  # what the learner's rules take; None: they take no subset
    environments: int  # that each decision looked at
    head: bool  # whether a Vex head was trained
    hypers: Hypers
    last: dict[str, Any]  # the metrics of the last iteration before the checkpoint, if it is there
    reward: np.ndarray  # in the units of `value`
    value: np.ndarray
    advantage: np.ndarray  # NaN where the run computes none
    points: np.ndarray | None  # [L, 2] principal components of the observations
    shares: list[float]  # of their variance, along both

    @property
    def taken(self) -> np.ndarray:
        """Whether each step is learned from `[L]`, as far as filter and sampler decide that."""
        return self.decisions.keep if self.learned is None else self.learned.taken


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
    kwargs, around = json.loads(config.env_kwargs), wrapping_of(config)
    env, drawer = open_env(config.env, kwargs, around, frames, say)
    policy = TrainedPolicy(artifact, name, env)
    played = play_episodes(policy, env, episodes, deterministic, seed, drawer, max_steps, say)
    steps, steps_per_second = len(played.reward), frames_per_second(env)
    own = under(name + "/", artifact.checkpoint.arrays)
    plays = more_plays(config, policy, env, played, deterministic, seed, max_steps, say)
    streams = stacked([stream_of(policy, config, own, one) for one in plays])
    last = last_row(run, name, iteration)
    hypers = hypers_of(config, own, last.get("keep_rate"))
    key = jax.random.fold_in(member_keys(member.seed).filter, iteration)
    scored = ScoredStep(*(getattr(streams, field) for field in ScoredStep._fields))
    decisions = decide(config, scored, key, hypers, steps)
    found = None
    if reads_rollouts(config):
        if config.replay_rollouts:
            raise BadInput("inspect: what a rule takes of replayed rollouts is not shown")
        state = member_state(config, policy, artifact, own)
        parts = config, policy.policy, artifact.spaces, state, streams, decisions.spans
        found = until(learned(*parts, hypers, member.seed, iteration), steps)
    end = len(decisions.keep)
    kept: Any = decisions.keep[:, None]
    alone: Rollout = jax.tree.map(lambda x: x[:end, :1], streams)._replace(keep=kept)
    points, shares = principal_components(played.observation)
    return Inspection(
        member=member,
        iteration=iteration,
        env_steps=int(own["counters/env_steps"]),
        mode="deterministic" if deterministic else "sampled",
        seed=seed,
        played=played,
        steps_per_second=steps_per_second,
        decisions=until(decisions, steps),
        learned=found,
        environments=len(plays),
        head=config.vex_coef > 0,
        hypers=hypers,
        last=last,
        reward=scaled(config, own, played.reward),
        value=np.asarray(streams.value)[:steps, 0],
        advantage=advantages(config, alone, decisions.rollouts, hypers)[:steps],
        points=points,
        shares=shares,
    )


def last_row(run: Path, name: str, iteration: int) -> dict[str, Any]:
    """The metrics of a member's last iteration before a checkpoint; empty if there are none."""
    rows = run_directory.rows(run)
    own = [row for row in rows if row["member"] == name and row["iteration"] < iteration]
    return own[-1] if own else {}


def member_state(
    config: Config, policy: TrainedPolicy, artifact: Artifact, own: Mapping[str, np.ndarray]
) -> TrainState:
    """A member's learning state as its checkpoint has it."""
    example = make_learner(config, policy.policy, artifact.spaces).init(jax.random.key(0))
    return unpack_learner(policy.policy, own, example)


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
