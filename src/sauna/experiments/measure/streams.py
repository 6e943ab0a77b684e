"""Fresh experience of a member as it was at one of its checkpoints.

A stream is what the member's next rollouts could have been: its policy, value and Vex head and its
normaliser at that time, its own filter deciding, but episodes and action noise of their own. It
begins at a random moment of an episode, as rollouts in training do. Every rollout of a stream
starts from the checkpoint's normaliser; nothing is learned in between. Streams of one checkpoint
are independent and alike, which is what the statistics rest on; steps within a stream are not.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sauna.algorithm.learner.samples import advantages_over_all
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import Program, make_program
from sauna.algorithm.types import Array, Hypers, Rollout, member_keys
from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.config.stored import read_stored
from sauna.config.trust import check_trusted
from sauna.envs.make import in_process_envs
from sauna.envs.spaces import Spaces, read_spaces
from sauna.envs.wrapping import wrapping_of
from sauna.system import run_directory
from sauna.system.checkpoint import BadCheckpoint, load_checkpoint, under
from sauna.training.loop.budget import hypers_now
from sauna.training.loop.member_state import Counters, fitting, flat_params, moments_of

WARM_UP = 2048  # env steps at most that are thrown away, so that no stream begins with a reset
FRESH = 0x5A07A  # sets the seeds of streams apart from those of training


class MemberSnapshot(NamedTuple):
    """A member as it was at a checkpoint."""

    run: Path
    config: Config
    spaces: Spaces
    member: Member
    iteration: int
    program: Program
    params: Array  # [D]
    hypers: Hypers
    arrays: dict[str, np.ndarray]  # the member's, named as in the checkpoint
    env_steps: int


class Stream(NamedTuple):
    """The `n` env steps of one stream: rollout after rollout, in each of them env after env."""

    observation: np.ndarray  # [n, *obs] normalised
    action: np.ndarray  # [n, A]
    advantage: np.ndarray  # [n] over the full stream, dropped steps included
    keep: np.ndarray  # [n] bool, the filter's decisions
    shifted: np.ndarray  # [n] bool, the same decisions moved in time by a random offset per env
    seen: np.ndarray  # [n, *obs] what the environment showed, not normalised


class Fresh(NamedTuple):
    """Independent streams, and the env steps that were thrown away before they began."""

    streams: list[Stream]
    thrown_away: int

    @property
    def counts(self) -> dict[str, int]:
        """Returns every env step that was taken."""
        used = sum(len(stream.keep) for stream in self.streams)
        return {"env_steps_used": used, "env_steps_thrown_away": self.thrown_away}


def load_snapshot(run: Path, name: str, iteration: int) -> MemberSnapshot:
    """Loads the member `name` of a host run as it was at its checkpoint `iteration`.

    Raises:
      BadCheckpoint: the checkpoint cannot be trusted or read.
    """
    stored = run_directory.read_config(run)
    loaded = load_checkpoint(run / "checkpoints" / f"{iteration:08d}")
    check_trusted(loaded.manifest, str(loaded.path), stored.get("seal"), trust=False)
    settings = read_stored(loaded.manifest)
    spaces = read_spaces(loaded.manifest["spaces"])
    config = settings.config
    member = next((one for one in settings.members if one.name == name), None)
    if member is None:
        raise BadCheckpoint(f"{loaded.path}: its config has no member {name!r}")
    arrays = under(name + "/", loaded.arrays)
    program = make_program(config, spaces)
    example = program.policy.init(jax.random.key(0))
    params = flat_params(program.policy, example, under("params/", arrays))
    counters = Counters.from_arrays(arrays)
    hypers = hypers_now(member.config, counters)
    return MemberSnapshot(
        run,
        config,
        spaces,
        member,
        iteration,
        program,
        params,
        hypers,
        arrays,
        counters.env_steps,
    )


def fresh_streams(
    snapshot: MemberSnapshot, number: int, rollouts: int, limit: int | None = None
) -> Fresh:
    """Returns `number` independent streams of `rollouts` rollouts; the same for the same
    checkpoint.

    Args:
      limit: env steps that each env tries in a rollout at most; by default as in training.
    """
    config = snapshot.config
    roots = np.random.SeedSequence([FRESH, snapshot.member.seed, snapshot.iteration])
    random = np.random.default_rng(roots)
    seeds = [int(seed) for seed in roots.generate_state(number)]
    pairs = [(seed, n) for seed in seeds for n in range(config.envs)]
    how = config.backend, config.rescale_actions, wrapping_of(config)
    made = in_process_envs(config.env, json.loads(config.env_kwargs), pairs, *how)
    envs = _Recorded(made)
    try:
        collector = HostCollector(
            snapshot.program, snapshot.spaces, envs, [member_keys(seed) for seed in seeds]
        )
        collector.start()
        params = np.tile(np.asarray(snapshot.params), (number, 1))
        hypers = [snapshot.hypers] * number
        _put_moments(collector, snapshot)
        before = random.integers(WARM_UP, size=number)
        first = _warm_up(collector, params, hypers, before, config.rollout_steps)
        parts: list[list[Stream]] = [[] for _ in seeds]
        decisions: list[list[list[np.ndarray]]] = [[] for _ in seeds]
        whole = np.full(number, limit or capacity(config))
        advantages = jax.jit(
            partial(advantages_over_all, bootstrap_truncated=config.truncation == "bootstrap")
        )
        for i in range(rollouts):
            _put_moments(collector, snapshot)
            envs.begin(collector.state.observation)
            collected = collector.collect(params, hypers, first + i, whole)
            seen = envs.seen()
            for p, own in enumerate(collected):
                assert own.rollout is not None
                advantage = np.asarray(advantages(own.rollout, snapshot.hypers))
                parts[p].append(_flat(own.rollout, advantage, seen[:, p]))
                decisions[p].append([x.copy() for x in _of_envs(own.rollout.keep, own.rollout)])
    finally:
        envs.close()
    streams = [
        Stream(*map(np.concatenate, zip(*own, strict=True)))._replace(
            shifted=moved_in_time(of_rollouts, random)
        )
        for own, of_rollouts in zip(parts, decisions, strict=True)
    ]
    return Fresh(streams, int(before.sum()) * config.envs)


def _warm_up(
    collector: HostCollector,
    params: np.ndarray,
    hypers: list[Hypers],
    left: np.ndarray,
    steps: int,
) -> int:
    """Acts for `left` `[P]` env steps, `steps` at a time; how many rollouts that took."""
    rollouts = 0
    while left.any():
        now = np.minimum(left, steps)
        collector.collect(params, hypers, rollouts, now)
        left, rollouts = left - now, rollouts + 1
    return rollouts


def _put_moments(collector: HostCollector, snapshot: MemberSnapshot) -> None:
    """The checkpoint's normaliser in every stream."""
    for p in range(len(collector.state.observation)):
        for key, place in moments_of(collector, p).items():
            place[...] = fitting(snapshot.arrays, key, place)


def moved_in_time(decisions: list[list[np.ndarray]], random: np.random.Generator) -> np.ndarray:
    """Returns a stream's decisions, each env's moved round its whole time line by one random
    offset.

    Moved within a rollout, those of A2C's short ones would hardly move.

    Args:
      decisions: of each rollout, of each env, `[steps]`; steps may differ.

    Returns:
      `[n]` in the order of a stream.
    """
    moved = []
    for rollouts in zip(*decisions, strict=True):
        whole = np.concatenate(rollouts)
        ends = np.cumsum([len(part) for part in rollouts])[:-1]
        moved.append(np.split(np.roll(whole, random.integers(len(whole))), ends))
    return np.concatenate([part for envs in zip(*moved, strict=True) for part in envs])


def _of_envs(x: Any, rollout: Rollout) -> list[np.ndarray]:
    """The valid steps of `x` `[<= S, N, ...]`, for each env: `[steps, ...]`.

    Rows behind the last step of any env may be missing in `x`.
    """
    x = np.asarray(x)
    return [x[acted[: len(x)], n] for n, acted in enumerate(np.asarray(rollout.valid).T)]


def _flat(rollout: Rollout, advantage: np.ndarray, seen: np.ndarray) -> Stream:
    """The valid steps of a rollout `[S, N]`, env after env, copied; nothing is moved yet."""
    observation, action, advantage, keep, seen = (
        np.concatenate(_of_envs(x, rollout))
        for x in (rollout.observation, rollout.action, advantage, rollout.keep, seen)
    )
    return Stream(observation, action, advantage, keep, keep, seen)


class _Recorded:
    """Host environments that note what they show."""

    def __init__(self, envs: Any) -> None:
        self._envs = envs
        self._shown: list[np.ndarray] = []
        self._shape: tuple[int, ...] = ()

    def begin(self, observation: np.ndarray) -> None:
        """Forgets what was shown; `observation` `[P, N, *obs]` is what is seen now."""
        self._shape = observation.shape
        self._shown = [observation.copy()]

    def seen(self) -> np.ndarray:
        """Returns `[S, P, N, *obs]`: the observation at each env step since `begin`."""
        return np.stack(self._shown[:-1])

    def step(self, action: np.ndarray, active: np.ndarray) -> Any:
        step = self._envs.step(action, active)
        if self._shape:
            self._shown.append(step.observation.reshape(self._shape).copy())
        return step

    def __getattr__(self, name: str) -> Any:
        return getattr(self._envs, name)
