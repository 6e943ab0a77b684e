"""Whether a HalfCheetah runs on its feet or slides on its back, with the policy of a checkpoint.

The torso's pitch is the angle of the joint `rooty`, which nothing wraps: a cheetah that has turned
over twice is upright again. It is upright where the cosine of the pitch is positive.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from sauna.algorithm.rollout.play import play
from sauna.envs.host.answers import close
from sauna.envs.make import make_drawn_env, make_env
from sauna.envs.wrapping import wrapping_of
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.evaluate.video import choose_renderer, not_drawn
from sauna.experiments.measure.streams import MemberSnapshot
from sauna.training.artifact import Artifact, load_artifact

EPISODES = 5
SEED = 0  # of the first episode: the same ones for every member
FRAMES = (0, 20, 50, 100, 200, 400, 600, 900)  # env steps of the episode that is shown
SIDE = 160  # pixels of a frame


def pitch(env: Any) -> float:
    """Returns the torso's angle about its side axis in radians, -pi to pi; 0 is on its feet,
    level."""
    return math.remainder(float(env.unwrapped.data.joint("rooty").qpos[0]), math.tau)


def compute(snapshot: MemberSnapshot, scale: None, file: Path) -> dict[str, Any]:
    """Plays `EPISODES` episodes with sampled actions and the frozen normaliser.

    A picture beside `file` shows one episode at `FRAMES`, side by side: the clearest in the posture
    of most states. Where nothing can be drawn it is not written, and the result says why.

    Returns:
      of each episode its return, its length and the share of states in which the torso is
      `upright`; that share over all states; the index of the episode that is `shown`, the env
      steps of its `frames` and the `picture` of them, or why they are `not_drawn`.
    """
    artifact = load_artifact(snapshot.run, iteration=snapshot.iteration)
    name, picture = snapshot.member.name, file.with_suffix(".png")
    kwargs, around = json.loads(artifact.config.env_kwargs), wrapping_of(artifact.config)
    env = make_env(artifact.config.env, kwargs, around)
    policy = TrainedPolicy(artifact, name, env)
    episodes, seen = [], np.zeros(0, bool)
    for i in range(EPISODES):
        pitches: list[float] = []
        watch, hold = lambda: pitches.append(pitch(env)), policy.policy.hold  # noqa: B023
        played = play(policy, env, False, SEED + i, watch, hold=hold)
        upright = np.cos(pitches) > 0
        seen = np.concatenate([seen, upright])
        episodes.append(
            {"return": played[0], "length": played[1], "upright": float(upright.mean())}
        )
    close(env)
    share = float(seen.mean())
    shown = clearest([episode["upright"] for episode in episodes], share)
    return {
        "mode": "sampled",
        "episodes": episodes,
        "upright": share,
        **_draw(artifact, name, kwargs, shown, picture),
    }


def clearest(upright: list[float], share: float) -> int:
    """Returns the episode that is the most on its feet where most states (`share`) are, or on its
    back."""
    return int(np.argmax(upright) if share > 0.5 else np.argmin(upright))


def _draw(
    artifact: Artifact, name: str, kwargs: dict[str, Any], shown: int, path: Path
) -> dict[str, Any]:
    """Plays an episode once more and writes its frames."""
    from PIL import Image

    choose_renderer()
    pictures: dict[int, Any] = {}
    step = -1

    def look() -> None:
        nonlocal step
        step += 1
        if step in FRAMES:
            pictures[step] = Image.fromarray(env.render()).resize((SIDE, SIDE))

    try:
        env = make_drawn_env(artifact.config.env, kwargs, wrapping_of(artifact.config))
        policy = TrainedPolicy(artifact, name, env)
        play(policy, env, False, SEED + shown, look, hold=policy.policy.hold)
    except Exception as error:  # renderers fail in every way there is
        return {"frames": [], "not_drawn": not_drawn(error)}
    strip = Image.new("RGB", (SIDE * len(pictures), SIDE))
    for place, picture in enumerate(pictures.values()):
        strip.paste(picture, (SIDE * place, 0))
    strip.save(path, "PNG")
    return {"shown": shown, "frames": [*pictures], "picture": path.name}
