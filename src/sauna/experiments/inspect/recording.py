"""Episodes as one stream of env steps, with frames where the environment can be drawn."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sauna.algorithm.rollout.play import play
from sauna.envs.host.answers import close, life_lost, one_number
from sauna.envs.host.contract import episode_seed
from sauna.envs.host.parallel_envs import AgentsAsOne
from sauna.envs.make import make_drawn_env, make_env
from sauna.envs.wrapping import Wrapping
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.evaluate.play import Progress
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.evaluate.video import choose_renderer, frames_per_second, not_drawn
from sauna.system.errors import BadInput, SaunaError

SIDE = 192  # pixels of a frame's longer side
MAX_FRAMES = 250  # frames
PER_SECOND = 20  # of the environment's clock: more would not be seen


class Played(NamedTuple):
    """`L` env steps, episode after episode; the last one may have been left before its end."""

    observation: np.ndarray  # [L, *obs] what the network got
    action: np.ndarray  # [L, A] what the network chose, as a rollout holds it
    reward: np.ndarray  # [L] float64, raw
    terminated: np.ndarray  # [L] bool
    truncated: np.ndarray  # [L] bool, never together with terminated
    life_lost: np.ndarray  # [L] bool, an end for learning alone
    final: (
        np.ndarray
    )  # [E, *obs] what the network would have got where episode e ended, or was left
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
    """An environment that notes what it is asked and what it answers, and whom it asks.

    It truncates an episode of `max_steps` env steps that has not ended.
    """

    def __init__(
        self,
        env: Any,
        policy: TrainedPolicy,
        frames: Frames | None,
        max_steps: int = MAX_STEPS,
    ) -> None:
        self._env, self._policy, self._frames = env, policy, frames
        self._see = policy.see
        self._max_steps, self._steps = max_steps, 0
        self._now: Any = None
        self.observation: list[np.ndarray] = []
        self.action: list[np.ndarray] = []
        self.final: list[np.ndarray] = []
        self.transitions: list[tuple[float, bool, bool, bool]] = []

    def act(self, observation: Any, *, deterministic: bool, key: Any) -> Any:
        """The policy's action for one raw observation, as the environment wants it."""
        self.action.append(self._policy.act(observation, deterministic=deterministic, key=key))
        return self._policy.write(self.action[-1])

    def leave(self) -> None:
        """Notes where an episode was left that has not ended."""
        if self.transitions and not (self.transitions[-1][1] or self.transitions[-1][2]):
            self.final.append(self._now)

    def reset(self, *, seed: int) -> tuple[Any, dict[str, Any]]:
        observation, info = self._env.reset(seed=seed)
        self._policy.reset()
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
    env: str,
    kwargs: dict[str, Any],
    wrapping: Wrapping,
    frames: bool,
    say: Callable[[str], None],
) -> tuple[Any, Frames | None]:
    """Returns the environment, and what draws it; where it cannot be drawn, one line says so.

    Raises:
      BadInput: it cannot be made, or is one of several agents.
    """
    made, failed = None, ""
    if frames:
        chosen = dict(os.environ)
        choose_renderer()
        try:
            made = make_drawn_env(env, kwargs, wrapping)
        except BadInput as error:
            os.environ.clear()
            os.environ.update(chosen)  # a renderer that fails may also fail the plain environment
            failed = f"no frames: {not_drawn(error)}"
    is_drawn = made is not None
    made = made if is_drawn else make_env(env, kwargs, wrapping)
    if isinstance(made, AgentsAsOne):
        close(made)
        raise BadInput("inspect: a page shows one agent; an environment of several cannot be shown")
    if failed:
        say(failed)
    return made, Frames(made, say) if is_drawn else None


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
        watch, hold = progress.step, policy.policy.hold
        episode = play(recorder.act, recorder, deterministic, seed + i, watch, max_steps, hold)
        returns.append(progress.played(episode).return_)
    progress.say_cut(max_steps)
    return _played(recorder, returns, frames)


def play_steps(
    policy: TrainedPolicy,
    env: Any,
    steps: int,
    deterministic: bool,
    seed: int,
    number: int,
    first: int = 0,
    max_steps: int = MAX_STEPS,
) -> Played:
    """Returns `steps` env steps of environment `number`, from its episode `first` on."""
    recorder, episode = Recorder(env, policy, None, max_steps), first
    while (left := steps - len(recorder.transitions)) > 0:
        own_seed = episode_seed(seed, number, episode)
        most, hold = min(left, max_steps), policy.policy.hold
        play(recorder.act, recorder, deterministic, own_seed, max_steps=most, hold=hold)
        episode += 1
    recorder.leave()
    return _played(recorder, [], None)


def joined(first: Played, second: Played) -> Played:
    """One play behind another; returns and frames are the first's."""
    both: Any = {
        name: np.concatenate([array, getattr(second, name)])
        for name, array in first._asdict().items()
        if isinstance(array, np.ndarray)
    }
    return first._replace(**both)


def _played(recorder: Recorder, returns: list[float], frames: Frames | None) -> Played:
    columns = (np.array(x) for x in zip(*recorder.transitions, strict=True))
    reward, terminated, truncated, life_lost = columns
    return Played(
        np.stack(recorder.observation),
        np.stack(recorder.action),
        reward,
        terminated,
        truncated,
        life_lost,
        np.stack(recorder.final),
        returns,
        frames.taken if frames else [],
    )
