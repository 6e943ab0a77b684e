"""A video of an episode, written frame by frame."""

from __future__ import annotations

import contextlib
import ctypes.util
import math
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sauna.envs.host.answers import close
from sauna.envs.make import make_drawn_env, make_env
from sauna.envs.wrapping import wrapping_of
from sauna.system.errors import BadInput, SaunaError, one_line
from sauna.system.safe_write import own_folder, replacing
from sauna.training.artifact import Artifact

NEEDED = "video: a video needs an environment that takes render_mode='rgb_array' and has render()"


def check_drawn(env: str, env_kwargs: dict[str, Any]) -> None:
    """Refuses an environment that has no pictures, before anything is played.

    Whether this machine can draw them is not asked.

    Raises:
      BadInput: it does not take `render_mode`, or has no `render()` of its own.
    """
    try:
        made = make_drawn_env(env, env_kwargs)
    except BadInput as error:
        if not isinstance(error.__cause__, TypeError):
            return  # said when it is drawn
        close(make_env(env, env_kwargs))  # or it is not for the keyword
        raise BadInput(NEEDED) from error
    own = getattr(made, "unwrapped", made)
    is_drawn = has_render(own)
    close(made)
    if not is_drawn:
        raise BadInput(NEEDED)


def has_render(env: Any) -> bool:
    """Whether an environment has a `render()` beside Gymnasium's, which raises."""
    import gymnasium

    own = getattr(env, "is_drawn", True)  # of an environment on the device
    return own and getattr(type(env), "render", gymnasium.Env.render) is not gymnasium.Env.render


def record_video(
    path: Path,
    artifact: Artifact,
    member: str,
    env: str,
    env_kwargs: dict[str, Any],
    deterministic: bool,
    seed: int,
    max_steps: int,
    best: bool = False,
) -> None:
    """Records one episode to an mp4 file; without an episode there is no file.

    Raises:
      SaunaError: the environment cannot render on this machine, or gives no pictures.
    """
    from sauna.algorithm.rollout.play import play
    from sauna.experiments.evaluate.policy import TrainedPolicy

    choose_renderer()
    own_folder(path.parent)
    try:
        with replacing(path) as part:
            drawn = make_drawn_env(env, env_kwargs, wrapping_of(artifact.config))
            try:
                policy = TrainedPolicy(artifact, member, drawn, best)
                with video(part, frames_per_second(drawn)) as add:
                    watch, hold = lambda: add(drawn.render()), policy.policy.hold
                    play(policy, drawn, deterministic, seed, watch, max_steps, hold)
            finally:
                close(drawn)
    except SaunaError:
        raise
    except Exception as error:  # renderers and encoders fail in every way there is
        raise SaunaError(f"video: {not_drawn(error)}") from error


@contextlib.contextmanager
def video(path: Path, rate: float) -> Iterator[Any]:
    """A function that adds a frame to an mp4 file of `rate` frames per second."""
    import imageio.v2 as imageio

    with warnings.catch_warnings():
        # ffmpeg is started by a fork that executes it at once; JAX warns of forks of any kind.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        chosen: dict[str, Any] = {"format": "FFMPEG", "fps": rate, "macro_block_size": 1}
        writer: Any = imageio.get_writer(path, **chosen)
        with writer:
            yield lambda drawn: writer.append_data(frame(drawn))


def frame(drawn: Any) -> np.ndarray:
    """A picture as `[H, W, 3]` uint8 with even sides, which the encoder needs.

    The last row or column of an odd side is there twice.

    Raises:
      SaunaError: it is no picture.
    """
    if drawn is None:
        raise SaunaError("video: the environment gives no pictures (render_mode rgb_array)")
    picture = np.asarray(drawn)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, -1)
    if picture.ndim != 3 or picture.shape[-1] not in (3, 4) or 0 in picture.shape:
        raise SaunaError(f"video: the environment's picture is of shape {np.shape(drawn)}")
    if picture.dtype != np.uint8:
        raise SaunaError(f"video: the environment's picture is of {picture.dtype}, not uint8")
    height, width = picture.shape[:2]
    return np.pad(picture[..., :3], ((0, height % 2), (0, width % 2), (0, 0)), "edge")


def frames_per_second(env: Any) -> float:
    """Env steps in a second of the environment's own time; 30 where it does not say."""
    metadata = getattr(env, "metadata", None) or {}
    try:
        rate = float(metadata.get("render_fps") or 30)
    except (TypeError, ValueError):
        return 30.0
    return rate if math.isfinite(rate) and rate > 0 else 30.0


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
