"""One row of `metrics.jsonl`: a member's iteration in numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from sauna.config.presets import Member
from sauna.config.settings import Config
from sauna.envs.info import info_key

if TYPE_CHECKING:
    from sauna.algorithm.learner.metrics import UpdateMetrics
    from sauna.algorithm.rollout.collected import Collected
    from sauna.algorithm.types import Hypers
    from sauna.training.loop.member_state import Counters


def metrics_row(
    member: Member,
    config: Config,
    iteration: int,
    collected: Collected,
    counters: Counters,
    learned: UpdateMetrics,
    hypers: Hypers,
) -> dict[str, Any]:
    """A row; what cannot be computed (a mean of no episode, a NaN) is left out.

    `env_steps`, `kept_steps` and `episodes` count from the start of training; `keep_rate` is this
    iteration's.
    """
    row: dict[str, Any] = {
        "member": member.name,
        "arm": member.arm,
        "seed": member.seed,
        "iteration": iteration,
        "env_steps": counters.env_steps,
        "kept_steps": counters.kept_steps,
        "keep_rate": collected.kept_steps / collected.env_steps,
        "episodes": counters.episodes,
        "episode_returns": [episode.return_ for episode in collected.episodes],
        "episode_lengths": [episode.length for episode in collected.episodes],
        "episode_truncated": [episode.truncated for episode in collected.episodes],
    }
    if collected.ended:
        row["episode_return_mean"] = collected.return_mean
        row["episode_length_mean"] = collected.length_mean
    if counters.recent_returns:
        row["return_mean"] = float(np.mean(counters.recent_returns))
    if config.gae_over == "kept" and counters.reported_returns:
        # The released code logs only episodes whose last step was kept.
        row["return_mean_reported"] = float(np.mean(counters.reported_returns))
    for name, number in collected.info.items():
        row[info_key(name)] = number
    scalars = learned._asdict() | learned.work._asdict()
    for name, value in scalars.items():
        if name not in ("finite", "work") and math.isfinite(value):
            row[name] = float(value)
    if not float(hypers.vex_coef):  # nothing learns them in this arm
        row.pop("vex_loss", None)
        row.pop("vex_target", None)
    row.setdefault("learning_rate", float(hypers.learning_rate))
    for name in ("clip_range", "entropy_coef"):
        if getattr(config, f"{name}_schedule") != "constant":
            row[name] = float(getattr(hypers, name))
    return row
