"""Episodes as one stream of env steps, with frames where the environment can be drawn."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sauna.algorithm.rollout.play import play
from sauna.envs.host.answers import life_lost, one_number
from sauna.envs.host.contract import episode_seed
from sauna.envs.make import make_drawn_env, make_env
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.evaluate.play import Progress
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.evaluate.video import choose_renderer, frames_per_second, not_drawn
from sauna.system.errors import BadInput, SaunaError

SIDE = 192  # pixels of a frame's longer side
MAX_FRAMES = 250  # frames
PER_SECOND = 20  # of the environment's clock: more would not be seen


class Played(NamedTuple):
    """`L` env steps of whole episodes, one after the other."""

    observation: np.ndarray  # [L, *obs] what the network got
    reward: np.ndarray  # [L] float64, raw
    terminated: np.ndarray  # [L] bool
    truncated: np.ndarray  # [L] bool, never together with terminated
    life_lost: np.ndarray  # [L] bool, an end for learning alone
    final: np.ndarray  # [E, *obs] what the network would have got where episode e ended
    returns: list[float]  # [E] of raw rewards
    frames: list[tuple[int, bytes]]  # env step, WebP of the state before it


class Frames:
    """At most `MAX_FRAMES` frames of a play of any length: of more, every second one goes.

    Drawing without a graphics card takes a tenth of a second, so it begins with no more than an
    episode of the environment's time limit lets stay.
    """

    def __init__(self, env: Any, say: Callable[[str], None]) -> None:
        self._env, self._say = env, say
        limit = getattr(getattr(env, "spec", None), "max_episode_steps", None) or 1
        self._every = max(1, -(-limit // MAX_FRAMES), round(frames_per_second(env) / PER_SECOND))
        self._works = True
        self.taken: list[tuple[int, bytes]] = []

    def take(self, row: int) -> None:
        """Draws the environment as it is before step `row`, if that step is one of the chosen."""
        if not self._works or row % self._every:
            return
        try:
            drawn = self._env.render()
            if drawn is None:
                raise SaunaError("it gives no frame (render_mode rgb_array)")
            self.taken.append((row, _encoded(drawn)))
        except Exception as error:  # renderers fail in every way there is
            self._say(f"no frames: {not_drawn(error)}")
            self._works, self.taken = False, []
        if len(self.taken) > MAX_FRAMES:
            self.taken, self._every = self.taken[::2], 2 * self._every


def _encoded(drawn: Any) -> bytes:
    """Encodes a frame `[H, W, 3]` uint8, made small, as WebP."""
    from PIL import Image

    image, data = Image.fromarray(np.asarray(drawn, np.uint8)), io.BytesIO()
    image.thumbnail((SIDE, SIDE))
    image.save(data, "WEBP", quality=55)
    return data.getvalue()


class Recorder:
    """An environment that notes what it is asked and what it answers.

    It truncates an episode of `max_steps` env steps that has not ended.
    """

    def __init__(
        self,
        env: Any,
        policy: TrainedPolicy,
        frames: Frames | None,
        max_steps: int = MAX_STEPS,
    ) -> None:
        self._env, self._see, self._frames = env, policy.see, frames
        self._max_steps, self._steps = max_steps, 0
        self._now: Any = None
        self.observation: list[np.ndarray] = []
        self.final: list[np.ndarray] = []
        self.transitions: list[tuple[float, bool, bool, bool]] = []

    def reset(self, *, seed: int) -> tuple[Any, dict[str, Any]]:
        observation, info = self._env.reset(seed=seed)
        self._steps = 0
        self._now = self._see(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._frames:
            self._frames.take(len(self.transitions))
        observation, reward, terminated, truncated, info = self._env.step(action)
        self.observation.append(self._now)
        self._steps += 1
        truncated = bool((truncated or self._steps == self._max_steps) and not terminated)
        self.transitions.append((one_number(reward), bool(terminated), truncated, life_lost(info)))
        self._now = self._see(observation)
        if terminated or truncated:
            self.final.append(self._now)
        return observation, reward, terminated, truncated, info


def open_env(
    env: str, kwargs: dict[str, Any], frames: bool, say: Callable[[str], None]
) -> tuple[Any, Frames | None]:
    """Returns the environment, and what draws it; where it cannot be drawn, one line says so.

    Raises:
      BadInput: it cannot be made.
    """
    if frames:
        chosen = dict(os.environ)
        choose_renderer()
        try:
            env = make_drawn_env(env, kwargs)
            return env, Frames(env, say)
        except BadInput as error:
            os.environ.clear()
            os.environ.update(chosen)  # a renderer that fails may also fail the plain environment
            say(f"no frames: {not_drawn(error)}")
    return make_env(env, kwargs), None


def play_episodes(
    policy: TrainedPolicy,
    env: Any,
    episodes: int,
    deterministic: bool,
    seed: int,
    frames: Frames | None,
    max_steps: int = MAX_STEPS,
    say: Callable[[str], None] = print,
) -> Played:
    """Returns the episodes that `evaluate` plays with this seed."""
    recorder = Recorder(env, policy, frames, max_steps)
    progress, returns = Progress(policy.name, episodes, say), []
    for i in range(episodes):
        episode = play(policy, recorder, deterministic, seed + i, progress.step, max_steps)
        returns.append(progress.played(episode).return_)
    progress.say_cut(max_steps)
    return _played(recorder, returns, frames)


def play_steps(
    policy: TrainedPolicy, env: Any, steps: int, deterministic: bool, seed: int, number: int
) -> np.ndarray:
    """Returns what the network gets in `steps` env steps of environment `number`, `[L, *obs]`."""
    recorder, episode = Recorder(env, policy, None, steps), 0
    while len(recorder.transitions) < steps:
        play(
            policy,
            recorder,
            deterministic,
            episode_seed(seed, number, episode),
            max_steps=steps,
        )
        episode += 1
    return np.stack(recorder.observation[:steps])


def _played(recorder: Recorder, returns: list[float], frames: Frames | None) -> Played:
    columns = (np.array(x) for x in zip(*recorder.transitions, strict=True))
    reward, terminated, truncated, life_lost = columns
    return Played(
        np.stack(recorder.observation),
        reward,
        terminated,
        truncated,
        life_lost,
        np.stack(recorder.final),
        returns,
        frames.taken if frames else [],
    )
