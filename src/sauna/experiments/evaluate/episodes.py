"""Episodes with a frozen policy and a frozen normaliser, and a video of one."""

from __future__ import annotations

import ctypes.util
import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sauna.envs.make import make_drawn_env, make_env
from sauna.experiments.evaluate.artifact import Artifact, check_spaces, find_member, load_artifact
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError, one_line
from sauna.system.safe_write import own_folder, replacing
from sauna.system.working_folder import kept_folder

if TYPE_CHECKING:
    from sauna.experiments.evaluate.policy import TrainedPolicy


@kept_folder()
def evaluate(
    run: str | Path,
    *,
    member: str | int | None = None,
    episodes: int = 10,
    deterministic: bool = False,
    seed: int = 0,
    env: str | None = None,
    video: bool = False,
    trust: bool = False,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Plays `episodes` episodes with each member.

    All members on the run's own environment are written to `evaluation_MODE.json`; a part of them,
    or another environment, is only returned.

    Args:
      run: the run directory.
      member: only this one; default all.
      deterministic: the distribution's mode; otherwise actions are sampled.
      seed: episodes are reset with seeds `seed`, `seed + 1`, ...
      env: another environment with the same spaces; default the run's.
      video: also films the first member's first episode.
      trust: the code that the run names may run, even if another user named it.
      say: is told of checkpoints that cannot be trusted.

    Returns:
      `{"mode", "env", "seed", "members": {name: {"returns", "lengths", "mean", ...}}}`.

    Raises:
      BadInput: no such run or member, impossible numbers, or `env` has other spaces.
      SaunaError: a video was asked for and the environment cannot render here.
    """
    run = Path.cwd() / run  # an environment may go elsewhere
    if episodes < 1 or seed < 0:
        raise BadInput("episodes: must be at least 1, and seed at least 0")
    artifact = load_artifact(run, say, trust=trust)
    chosen = artifact.members if member is None else [find_member(artifact.members, member)]
    mode = "deterministic" if deterministic else "sampled"
    result: dict[str, Any] = {
        "mode": mode,
        "env": env or artifact.config.env,
        "seed": seed,
        "iteration": artifact.checkpoint.manifest["iteration"],
        "members": {},
    }
    world = make_env(result["env"], _kwargs(artifact, env))
    check_spaces(artifact, world)
    from sauna.experiments.evaluate.policy import TrainedPolicy  # imports JAX, so after the checks

    for name in chosen:
        policy = TrainedPolicy(artifact, name, world)
        played = [play(policy, world, deterministic, seed + i) for i in range(episodes)]
        result["members"][name] = statistics(played)
    world.close()
    if env is None and member is None:
        run_directory.write_json(run / f"evaluation_{mode}.json", result)
    if video:
        result["video"] = str(film(run, artifact, chosen[0], env, deterministic, seed))
    return result


def _kwargs(artifact: Artifact, env: str | None) -> dict[str, Any]:
    return {} if env else json.loads(artifact.config.env_kwargs)


def play(
    policy: TrainedPolicy,
    env: Any,
    deterministic: bool,
    seed: int,
    watch: Callable[[], None] = lambda: None,
) -> tuple[float, int]:
    """One episode; its return (raw rewards) and length in env steps."""
    import jax

    key = jax.random.key(seed)
    observation, _ = env.reset(seed=seed)
    watch()
    return_, length, ended = 0.0, 0, False
    while not ended:
        step_key = None if deterministic else jax.random.fold_in(key, length)
        action = policy(observation, deterministic=deterministic, key=step_key)
        observation, reward, terminated, truncated, _ = env.step(action)
        return_, length, ended = return_ + float(reward), length + 1, terminated or truncated
        watch()
    return return_, length


def statistics(played: list[tuple[float, int]]) -> dict[str, Any]:
    returns, lengths = [r for r, _ in played], [n for _, n in played]
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
        "returns": returns,
        "lengths": lengths,
    }


def film(
    run: Path, artifact: Artifact, name: str, env: str | None, deterministic: bool, seed: int
) -> Path:
    """Films one episode to `videos/MEMBER_MODE.mp4`.

    Raises:
      SaunaError: the environment cannot render on this machine.
    """
    from sauna.experiments.evaluate.policy import TrainedPolicy

    choose_renderer()
    frames: list[np.ndarray] = []
    try:
        world = make_drawn_env(env or artifact.config.env, _kwargs(artifact, env))
        policy = TrainedPolicy(artifact, name, world)
        play(policy, world, deterministic, seed, lambda: frames.append(world.render()))
    except SaunaError:
        raise
    except Exception as error:  # renderers fail in every way there is
        raise SaunaError(f"video: {not_drawn(error)}") from error
    if not frames or frames[0] is None:
        raise SaunaError("video: the environment gives no pictures (render_mode rgb_array)")
    import imageio.v3 as imageio

    mode = "deterministic" if deterministic else "sampled"
    path = run / "videos" / f"{name.replace('/', '-')}_{mode}.mp4"
    own_folder(path.parent)
    rate = int(world.metadata.get("render_fps", 30))
    world.close()
    with warnings.catch_warnings(), replacing(path) as temporary:
        # ffmpeg is started by a fork that executes it at once; JAX warns of forks of any kind.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        imageio.imwrite(temporary, np.stack(frames), fps=rate, macro_block_size=1)
    return path


def not_drawn(error: Exception) -> str:
    """Why an environment cannot be drawn, in a line, and what may help where OpenGL is missing."""
    text = str(error) if isinstance(error, SaunaError) else one_line(error)
    missing = any(word in text for word in ("GL", "Mesa", "isplay"))
    help = "; without a display MuJoCo needs libegl1 or libosmesa6" * missing
    return f"the environment cannot be drawn here: {text}{help}"


def choose_renderer() -> None:
    """Without a display, lets MuJoCo draw with EGL or OSMesa, whichever is installed."""
    if os.environ.get("DISPLAY") or os.environ.get("MUJOCO_GL"):
        return
    for library, name in (("EGL", "egl"), ("OSMesa", "osmesa")):
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = name
            os.environ.setdefault("PYOPENGL_PLATFORM", name)
            return
