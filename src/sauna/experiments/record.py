"""`sauna record`: episodes of a trained policy as data, for other libraries or for a clone."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from sauna import __version__
from sauna.config.imported_from import names_the_folder
from sauna.config.parsing import what_is_played
from sauna.envs.host.answers import close, one_number
from sauna.envs.host.together import group_size
from sauna.envs.make import make_env
from sauna.envs.shapes import mask_in
from sauna.envs.wrapping import PLAIN, Wrapping, wrapping_of
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.evaluate.episodes import kwargs_of, provided, statistics
from sauna.experiments.evaluate.play import Progress
from sauna.system.errors import BadInput
from sauna.system.working_folder import kept_folder
from sauna.training.artifact import check_spaces, find_member, load_artifact
from sauna.training.data.episodes import MINARI, Add, Recorded
from sauna.training.data.minari_sets import minari_writer
from sauna.training.data.parquet import parquet_writer
from sauna.training.located import locate


@names_the_folder
@kept_folder()
def record(
    run: str | Path,
    to: str | Path,
    *,
    member: str | int | None = None,
    episodes: int = 100,
    deterministic: bool = False,
    seed: int = 0,
    env: Any = None,
    env_kwargs: Mapping[str, Any] | str | None = None,
    checkpoint: int | None = None,
    max_steps: int = MAX_STEPS,
    best: bool = False,
    trust: bool = False,
    say: Callable[[str], None] = print,
    **parts: Any,
) -> dict[str, Any]:
    """Plays `episodes` episodes with a member and writes every env step of them.

    They are those that `evaluate` plays with the same arguments.

    Args:
      run: the run directory; or an exported policy: its folder, `zoo:NAME`, `hf:USER/NAME`.
      to: `minari:NAME` (below `MINARI_DATASETS_PATH`, by default `~/.minari/datasets`),
        `minari:./FOLDER/NAME`, or a file `*.parquet`. Neither may be there already.
      member: name or index; default the first.
      deterministic: the distribution's mode; otherwise actions are sampled.
      seed: episodes are reset with seeds `seed`, `seed + 1`, ...
      env: another environment with the same spaces; default the run's.
      env_kwargs: keyword arguments of the environment: on the run's own, they change the run's.
      checkpoint: the iteration of a kept checkpoint; default the newest good one.
      max_steps: env steps after which an episode that has not ended is cut; it counts as truncated.
      best: the member as it was at its best evaluation during training.
      trust: the code that the run names may run, even if another user named it.
      say: receives a line about checkpoints that cannot be trusted, progress, and episodes that
        were cut.
      **parts: those that were passed by value when the run started (`network`, ...).

    Returns:
      `{"to", "env", "member", "mode", "seed", "iteration", "episodes", "env_steps", "mean", ...}`.

    Raises:
      BadInput: as `evaluate`; or `to` is there already, is no name, or needs a library.
    """
    run, to = locate(run).folder, str(to)  # an environment may go elsewhere
    episodes, seed, max_steps = what_is_played(episodes, seed, max_steps)
    if not to.startswith(MINARI) and Path(to).suffix != ".parquet":
        raise BadInput(f"to: {to!r} is neither minari:NAME nor a file that ends in .parquet")
    to = to if to.startswith(MINARI) else str(Path.cwd() / to)
    artifact = load_artifact(run, say, checkpoint, trust=trust)
    env = provided(run, env, parts)
    name = find_member(artifact.members, 0 if member is None else member)
    kwargs, chosen = kwargs_of(artifact, env, env_kwargs), env or artifact.config.env
    made = make_env(chosen, kwargs, wrapping_of(artifact.config))
    if group_size(made):
        raise BadInput("record: episodes of several agents at once cannot be recorded")
    check_spaces(artifact, made)
    about = {
        "env": chosen,
        "env_kwargs": kwargs,
        "member": name,
        "iteration": artifact.checkpoint.manifest["iteration"],
        "best": best,
        "mode": "deterministic" if deterministic else "sampled",
        "seed": seed,
        "episodes": episodes,
        "max_steps": max_steps,
        "version": __version__,
        "spaces": list(artifact.spaces),
    }
    from sauna.algorithm.rollout.play import play  # imports JAX: after the checks
    from sauna.experiments.evaluate.policy import TrainedPolicy

    policy, played = TrainedPolicy(artifact, name, made, best), []
    progress, listener = Progress(name, episodes, say), _Listener(made)
    with _writer(to, made, about, wrapping_of(artifact.config)) as add:
        for i in range(episodes):
            how = deterministic, seed + i, progress.step, max_steps, policy.policy.hold
            played.append(progress.played(play(policy, listener, *how)))
            add(listener.recorded(seed + i))
    progress.say_cut(max_steps)
    close(made)
    found = statistics(played)
    return {"to": to, **about, **found, "env_steps": sum(found["lengths"])}


def _writer(
    to: str, env: Any, about: Mapping[str, Any], wrapping: Wrapping = PLAIN
) -> AbstractContextManager[Add]:
    if to.startswith(MINARI):
        return minari_writer(to, env, about, wrapping)
    return parquet_writer(Path(to), env, about)


class _Listener:
    """An environment that keeps what it gives and takes during an episode."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._observations: list[Any] = []
        self._steps: list[tuple[Any, float, bool, bool]] = []

    def reset(self, **how: Any) -> Any:
        answer = self._env.reset(**how)
        self._observations, self._steps = [copy.deepcopy(answer[0])], []
        return answer

    def step(self, action: Any) -> Any:
        answer = self._env.step(action)
        observation, reward, terminated, truncated, _ = answer
        self._observations.append(copy.deepcopy(observation))
        step = copy.deepcopy(action), one_number(reward), bool(terminated), bool(truncated)
        self._steps.append(step)
        return answer

    def recorded(self, seed: int) -> Recorded:
        """The episode so far; one that has not ended counts as truncated."""
        actions, rewards, terminated, truncated = zip(*self._steps, strict=True)
        ended, observations, masks = terminated[-1], self._observations, None
        size, space = mask_in(self._env.observation_space)
        if size:
            from sauna.envs.masked import MASK, OBSERVATION

            masks = np.stack([one[MASK] for one in observations])
            observations = [one[OBSERVATION] for one in observations]
        return Recorded(
            seed,
            _stacked(space, observations),
            np.stack([np.asarray(action) for action in actions]),
            np.array(rewards),
            ended,
            truncated[-1] or not ended,
            masks,
        )


def _stacked(space: Any, observations: list[Any]) -> Any:
    """Observations as one, each part of a Dict or Tuple with an axis `[L + 1]` in front."""
    from gymnasium import spaces as gym

    if isinstance(space, gym.Dict):
        return {k: _stacked(p, [one[k] for one in observations]) for k, p in space.spaces.items()}
    if isinstance(space, gym.Tuple):
        parts = enumerate(space.spaces)
        return tuple(_stacked(part, [one[i] for one in observations]) for i, part in parts)
    return np.stack([np.asarray(one, space.dtype).reshape(space.shape) for one in observations])


def report(found: Mapping[str, Any]) -> str:
    """Says in a line what was recorded."""
    last = found["seed"] + found["episodes"] - 1
    return (
        f"{found['member']} on {found['env']}, {found['mode']} actions, seeds {found['seed']} to "
        f"{last}: {found['episodes']:,} episodes, {found['env_steps']:,} env steps, return "
        f"{found['mean']:.2f} +- {found['std']:.2f}\ndata: {found['to']}"
    )
