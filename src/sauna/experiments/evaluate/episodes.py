"""Episodes with a frozen policy and a frozen normaliser."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sauna.config.imported_from import names_the_folder
from sauna.config.parsing import what_is_played
from sauna.config.plugins import is_local, name_of, provide
from sauna.config.settings import fields_with, parse
from sauna.envs.host.answers import close
from sauna.envs.make import make_env, one_name
from sauna.envs.wrapping import wrapping_of
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.evaluate.play import Progress
from sauna.experiments.evaluate.video import check_drawn, record_video
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.system.safe_write import own_folder
from sauna.system.working_folder import kept_folder
from sauna.training.artifact import (
    Artifact,
    best_steps,
    check_spaces,
    find_member,
    load_artifact,
)
from sauna.training.located import locate

if TYPE_CHECKING:
    from sauna.algorithm.rollout.play import Episode


class VideoFailure(SaunaError):
    """No video could be made; `result` holds what was played before."""

    def __init__(self, message: str, result: dict[str, Any]) -> None:
        super().__init__(message)
        self.result = result


@names_the_folder
@kept_folder()
def evaluate(
    run: str | Path,
    *,
    member: str | int | None = None,
    episodes: int = 10,
    deterministic: bool = False,
    seed: int = 0,
    env: Any = None,
    env_kwargs: Mapping[str, Any] | str | None = None,
    checkpoint: int | None = None,
    max_steps: int = MAX_STEPS,
    video: bool = False,
    best: bool = False,
    trust: bool = False,
    say: Callable[[str], None] = print,
    **parts: Any,
) -> dict[str, Any]:
    """Plays `episodes` episodes with each member.

    All members at the newest checkpoint, on the run's own environment, are written to
    `evaluation_MODE.json`; anything else is only returned.

    Args:
      run: the run directory; or an exported policy: its folder, `zoo:NAME`, `hf:USER/NAME`.
      member: only this one; default all.
      deterministic: the distribution's mode; otherwise actions are sampled.
      seed: episodes are reset with seeds `seed`, `seed + 1`, ...
      env: another environment with the same spaces; default the run's.
      env_kwargs: keyword arguments of the environment: on the run's own, they change the run's.
      checkpoint: the iteration of a kept checkpoint; default the newest good one.
      max_steps: env steps after which an episode that has not ended is cut.
      video: also records the first member's first episode.
      best: each member as it was at its best evaluation during training.
      trust: the code that the run names may run, even if another user named it.
      say: is called with a line about checkpoints that cannot be trusted, progress, and episodes
        that were cut.
      **parts: those that were passed by value when the run started (`network`, ...).

    Returns:
      `{"mode", "env", "seed", "members": {name: {"returns", "lengths", "mean", ...}}}`.

    Raises:
      BadInput: no such run, member or checkpoint, impossible numbers, `env` has other spaces; with
        `best`, a member was not evaluated during training; with `video`, `env` has no pictures.
      VideoFailure: a video was asked for and the environment cannot render here.
    """
    run, written = locate(run)
    episodes, seed, max_steps = what_is_played(episodes, seed, max_steps)
    artifact = load_artifact(run, say, checkpoint, trust=trust)
    env = provided(run, env, parts)
    chosen = artifact.members if member is None else [find_member(artifact.members, member)]
    own = artifact.config.env
    mode = "deterministic" if deterministic else "sampled"
    result: dict[str, Any] = {
        "mode": mode,
        "env": env or own,
        "seed": seed,
        "iteration": artifact.checkpoint.manifest["iteration"],
        **({"best": best_steps(artifact, chosen)} if best else {}),
        "members": {},
    }
    kwargs = kwargs_of(artifact, env, env_kwargs)
    if env_kwargs:
        result["env_kwargs"] = kwargs
    if video:
        check_drawn(result["env"], kwargs)
    made = make_env(result["env"], kwargs, wrapping_of(artifact.config))
    check_spaces(artifact, made)
    from sauna.algorithm.rollout.play import play, success_rate  # imports JAX: after the checks
    from sauna.experiments.evaluate.policy import TrainedPolicy

    for name in chosen:
        policy = TrainedPolicy(artifact, name, made, best)
        progress = Progress(name, episodes, say)
        watch, hold = progress.step, policy.policy.hold
        played = [
            progress.played(play(policy, made, deterministic, seed + i, watch, max_steps, hold))
            for i in range(episodes)
        ]
        result["members"][name] = statistics(played) | success_rate(played)
        progress.say_cut(max_steps)
    close(made)
    if env is None and member is None and checkpoint is None and not env_kwargs:
        if written != run:  # which may be a link that the user gave
            own_folder(written)
        run_directory.write_json(written / f"evaluation_{'best_' * best}{mode}.json", result)
    if video:
        label = f"{chosen[0].replace('/', '-')}_{'best_' * best}{mode}" + f"_{checkpoint}" * (
            checkpoint is not None
        )
        path = written / "videos" / f"{label}.mp4"
        how = deterministic, seed, max_steps, best
        say(f"{chosen[0]}: recording one episode, which can take minutes")
        try:
            record_video(path, artifact, chosen[0], result["env"], kwargs, *how)
        except SaunaError as error:
            raise VideoFailure(str(error), result) from error
        result["video"] = str(path)
    return result


def provided(run: Path, env: Any, parts: Mapping[str, Any]) -> str | None:
    """The name of another environment, if one is asked for; parts of the run are put in place."""
    if env is not None and not isinstance(env, str):
        if is_local(
            str(run_directory.read_config(run, exported=True).get("config", {}).get("env"))
        ):
            parts, env = {**parts, "env": env}, None
        else:
            env = name_of(env)
    rest = provide(run, parts, fields_with("plugin"))
    if rest:
        raise BadInput(f"unknown argument {next(iter(rest))!r}")
    return env


def kwargs_of(
    artifact: Artifact, env: str | None, given: Mapping[str, Any] | str | None
) -> dict[str, Any]:
    """The keyword arguments of an environment: on the run's own, the run's and those given."""
    own = env is None or one_name(env) == one_name(artifact.config.env)
    changes = json.loads(parse("env_kwargs", given or {}))
    return {**(json.loads(artifact.config.env_kwargs) if own else {}), **changes}


def statistics(played: list[Episode]) -> dict[str, Any]:
    returns, lengths = [e.return_ for e in played], [e.length for e in played]
    return {
        "episodes": len(played),
        "mean": float(np.mean(returns)),
        "std": float(np.std(returns)),
        "median": float(np.median(returns)),
        "min": min(returns),
        "max": max(returns),
        "length_mean": float(np.mean(lengths)),
        "length_min": min(lengths),
        "length_max": max(lengths),
        "cut": sum(e.cut for e in played),
        "returns": returns,
        "lengths": lengths,
    }


def report(result: dict[str, Any]) -> list[str]:
    """Says an evaluation in lines."""
    lines = [
        f"{result['env']}, {result['mode']} actions, frozen normaliser, "
        f"checkpoint of iteration {result['iteration']}"
    ]
    for name, row in result["members"].items():
        best = result.get("best", {})
        at = f" (best, after {best[name]:,} env steps)" if best else ""
        lines.append(
            f"{name}{at}: return {row['mean']:.2f} +- {row['std']:.2f} "
            f"(min {row['min']:.2f}, median {row['median']:.2f}, max {row['max']:.2f}), "
            f"length {row['length_mean']:.1f} ({row['length_min']} to {row['length_max']}), "
            f"{row['episodes']} episodes"
            + (f", success {row['success_rate']:.0%}" if "success_rate" in row else "")
        )
    return lines
