"""Small environments with known answers. Importable by name, so that workers can make them."""

from __future__ import annotations

import itertools
import os
import signal
import time
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from sauna.envs.host.contract import episode_seed

BOX = spaces.Box(-np.inf, np.inf, (1,), np.float64)


class SmallEnv(gymnasium.Env):
    """One observation, one reward, as the subclass says."""

    observation_space: spaces.Space = BOX
    action_space: spaces.Space = spaces.Discrete(2)
    length = 1

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.t = 0
        self.seen = self.observe()
        return self.seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        reward = self.reward(action)
        self.t += 1
        self.seen = self.observe()
        return self.seen, reward, self.terminated(), self.truncated(), {}

    def observe(self) -> np.ndarray:
        return np.zeros(1)

    def reward(self, action: Any) -> float:
        return 1.0

    def terminated(self) -> bool:
        return self.t >= self.length

    def truncated(self) -> bool:
        return False


class ConstantReward(SmallEnv):
    """V = 1 at its only state."""


class ObservedReward(SmallEnv):
    """The reward is the observation, +1 or -1: V(o) = o."""

    def observe(self) -> np.ndarray:
        return np.array([self.np_random.choice([-1.0, 1.0])])

    def reward(self, action: Any) -> float:
        return float(self.seen[0])


class TwoSteps(SmallEnv):
    """Reward 1 after the second step: V(0) = gamma, V(1) = 1."""

    length = 2

    def observe(self) -> np.ndarray:
        return np.array([float(self.t)])

    def reward(self, action: Any) -> float:
        return float(self.t == 1)


class GoodAction(SmallEnv):
    """Action 1 earns 1, action 0 earns -1."""

    def reward(self, action: Any) -> float:
        return 1.0 if int(action) == 1 else -1.0


class MatchingAction(ObservedReward):
    """The action has to match the sign of the observation."""

    def reward(self, action: Any) -> float:
        return 1.0 if (int(action) == 1) == (self.seen[0] > 0) else -1.0


class Endless(SmallEnv):
    """Reward 1 for ever, cut off after 5 steps: V = 1 / (1 - gamma)."""

    def terminated(self) -> bool:
        return False

    def truncated(self) -> bool:
        return self.t >= 5


class Finite(Endless):
    """The same, but really over after 5 steps; the observation says how far it is."""

    def observe(self) -> np.ndarray:
        return np.array([float(self.t)])

    def terminated(self) -> bool:
        return self.t >= 5

    def truncated(self) -> bool:
        return False


class Scripted(SmallEnv):
    """Continuous; observations wander with the seed, every step has another reward, odd ends."""

    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.counter = itertools.count(0 if seed is None else seed % 1000)
        gymnasium.Env.reset(self, seed=seed)
        self.end = int(self.np_random.integers(2, 12))
        self.cut = bool(self.np_random.integers(2))
        self.t = 0
        return self.observe(), {}

    def observe(self) -> np.ndarray:
        return self.np_random.normal(size=3) * (1 + self.t)

    def reward(self, action: Any) -> float:
        return float(next(self.counter) % 17) + float(np.sum(action))

    def terminated(self) -> bool:
        return not self.cut and self.t >= self.end

    def truncated(self) -> bool:
        return self.cut and self.t >= self.end


class Pushed(Scripted):
    """The same, with the spaces of `jax_envs.walk`."""

    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def observe(self) -> np.ndarray:
        return super().observe()[:2].astype(np.float32)


class Boxed(Scripted):
    """Actions in a box that is not [-1, 1]; notes what it gets."""

    action_space = spaces.Box(-3.0, 1.0, (2,), np.float32)
    seen_actions: ClassVar[list[np.ndarray]] = []

    def reward(self, action: Any) -> float:
        self.seen_actions.append(np.array(action))
        return super().reward(action)


class Unbounded(Scripted):
    """Actions with one bound missing."""

    action_space = spaces.Box(np.array([-1.0, -1.0]), np.array([1.0, np.inf]), dtype=np.float64)


class Informative(Scripted):
    """Says of every step how far the episode is, and whether that is an even number."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        *step, _ = super().step(action)
        info = {"is_success": self.t % 2 == 0, "length": np.int64(self.t), "goal": "north"}
        return *step, {**info, "never": np.nan, "many": np.zeros(2), "nested": {"x": 1.0}}  # type: ignore[return-value]


class Drawn(Scripted):
    """The same, and its picture is as bright as its step."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def render(self) -> np.ndarray | None:
        return np.full((40, 60, 3), 20 * self.t, np.uint8) if self.render_mode else None


class Unlucky(Scripted):
    """Raises in the fourth episode of the member with seed 1, and only there."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        if seed == episode_seed(1, 0, 3):
            raise RuntimeError("out of luck")
        return super().reset(seed=seed, options=options)


class Forgetful(Scripted):
    """Not a function of its seed: cannot be restored by replaying."""

    def observe(self) -> np.ndarray:
        return np.random.default_rng().normal(size=3)


class Lingering(Scripted):
    """Repeats itself only until its first reset: state survives."""

    played = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.played += 1
        return super().reset(seed=seed)

    def observe(self) -> np.ndarray:
        return super().observe() + self.played


class NotANumber(Scripted):
    """A NaN in the second observation of the third episode."""

    episodes = 0

    def __init__(self, first: int = 3, step: int = 1) -> None:
        self.first, self.bad_step = first, step

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.episodes += 1
        return super().reset(seed=seed)

    def observe(self) -> np.ndarray:
        seen = super().observe()
        if self.episodes == self.first and self.t == self.bad_step:
            seen[1] = np.nan
        return seen


class Misshapen(Scripted):
    """Gives `size` numbers instead of the three it says, from episode `first` on."""

    def __init__(self, size: int = 1, first: int = 0) -> None:
        self.size, self.first, self.episode = size, first, -1

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.episode += 1
        return super().reset(seed=seed)

    def observe(self) -> np.ndarray:
        seen = super().observe()
        return np.resize(seen, self.size) if self.episode >= self.first else seen


class Poisoned(Scripted):
    """One number that is none, in one place of one episode.

    Args:
      field: `first`, `observation`, `final` (of an episode's end) or `reward`.
      value: `nan`, `inf` or `-inf`.
      component: of the observation.
      episode: counted by this environment's resets, from 1.
      step: of that episode, from 1; not read where `field` says when.
    """

    episodes = 0

    def __init__(
        self, field: str, value: str, component: int = 1, episode: int = 3, step: int = 1
    ) -> None:
        self.field, self.value, self.component = field, float(value), component
        self.bad = (episode, step)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.episodes += 1
        return super().reset(seed=seed)

    def observe(self) -> np.ndarray:
        seen = super().observe()
        when = {
            "first": self.t == 0,
            "observation": self.t == self.bad[1],
            "final": self.t >= self.end,
        }
        if self.episodes == self.bad[0] and when.get(self.field):
            seen[self.component] = self.value
        return seen

    def reward(self, action: Any) -> float:
        reward = super().reward(action)
        bad = self.field == "reward" and (self.episodes, self.t + 1) == self.bad
        return self.value if bad else reward


class Dying(Scripted):
    """Its process ends in the middle of an episode."""

    def reward(self, action: Any) -> float:
        os._exit(7)


class Failing(Scripted):
    """Fails in one of many ways at a reset or a step of one episode.

    Args:
      what: `exit`, `abort`, `kill`, `raise`, `hang`, or `stop` (the process stops itself).
      where: `reset` or `step`.
      episode: counted by this environment's resets, from 1.
      seed: only an environment whose episode was reset with this seed does, or any.
    """

    episodes = 0

    def __init__(self, what: str, where: str, episode: int, seed: int | None = None) -> None:
        self.what, self.bad, self.only = what, (where, episode), seed

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.episodes += 1
        self.fails = self.only in (None, seed)
        self.fail("reset")
        return super().reset(seed=seed)

    def reward(self, action: Any) -> float:
        self.fail("step")
        return super().reward(action)

    def fail(self, where: str) -> None:
        if (where, self.episodes) != self.bad or not self.fails:
            return
        if self.what == "raise":
            raise ValueError("the motor is on fire")
        if self.what == "exit":
            os._exit(7)
        if self.what == "hang":
            time.sleep(3600)
        number = {"abort": signal.SIGABRT, "kill": signal.SIGKILL, "stop": signal.SIGSTOP}
        os.kill(os.getpid(), number[self.what])


class Hanging(Scripted):
    """A step that never comes back."""

    def reward(self, action: Any) -> float:
        time.sleep(3600)
        return 0.0


class Broken(Scripted):
    """A beginner's environment."""

    def __init__(self, broken: str) -> None:
        self.broken = broken

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        if self.broken == "reset":
            raise TypeError("two\nlines")
        return super().reset(seed=seed)

    def reward(self, action: Any) -> float:
        raise TypeError("two\nlines")


class Raising(Scripted):
    def reward(self, action: Any) -> float:
        raise ValueError("the motor is on fire")


class Picture(SmallEnv):
    """A 40 x 40 image whose brightness is the step; also renders it."""

    observation_space = spaces.Box(0, 255, (2, 40, 40), np.uint8)
    action_space = spaces.Discrete(3, start=5)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    length = 4

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def observe(self) -> np.ndarray:
        image = np.full((2, 40, 40), self.t * 20, np.uint8)
        image[1] += 1
        return image

    def reward(self, action: Any) -> float:
        assert 5 <= action < 8
        return float(action - 6)

    def render(self) -> np.ndarray | None:
        if self.render_mode is None:
            return None
        return np.repeat(self.observe()[0][..., None], 3, -1)


class Spaced(SmallEnv):
    """Any spaces: observations are samples, actions must belong."""

    length = 6

    def __init__(self, observation: str = "box", action: str = "box") -> None:
        self.observation_space = {
            "box": spaces.Box(-1.0, 1.0, (2, 3), np.float32),
            "discrete": spaces.Discrete(4, start=2),
            "dict": spaces.Dict({"a": spaces.Box(0, 1, (2,)), "b": spaces.Discrete(3)}),
            "text": spaces.Text(4),
        }[observation]
        self.action_space = {
            "box": spaces.Box(-0.5, 0.5, (2, 2), np.float64),
            "discrete": spaces.Discrete(3, start=-1),
            "multi_discrete": spaces.MultiDiscrete([2, 3], start=[1, 4]),
            "multi_binary": spaces.MultiBinary(4),
            "tuple": spaces.Tuple([spaces.Discrete(2)]),
        }[action]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.observation_space.seed(seed)
        return super().reset(seed=seed)

    def observe(self) -> Any:
        return self.observation_space.sample()

    def reward(self, action: Any) -> float:
        assert self.action_space.contains(action), action
        return 1.0


class Lives(SmallEnv):
    """Three lives of two steps each, one game; rewards 5 and -3 in turn."""

    length = 6

    def reward(self, action: Any) -> float:
        return 5.0 if self.t % 2 == 0 else -3.0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        result = super().step(action)
        return *result[:4], {"life_lost": self.t in (2, 4)}


class Answering(Scripted):
    """Its reward and its info are those given."""

    def __init__(self, reward: Any = 1.0, info: Any = None) -> None:
        self.given = np.array(reward), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, Any]:
        answer = super().step(action)
        return answer[0], self.given[0], *answer[2:4], self.given[1]


class SignedSeed(SmallEnv):
    """Observes its seed, which must fit a signed int; some say so in another way."""

    def __init__(self, error: str = "ValueError") -> None:
        self.error = error

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.t = 0
        if seed is not None and seed >= 2**31:
            if self.error == "fire":
                raise ValueError("the motor is on fire")
            raise {"ValueError": ValueError, "OverflowError": OverflowError}[self.error](
                "seed too large" if self.error == "ValueError" else "cannot convert to C int"
            )
        return np.array([float(seed or 0)]), {}


class Unclosable(Scripted):
    """Cannot be closed; with `raises`, it cannot be played either."""

    def __init__(self, error: str = "RuntimeError", raises: bool = False) -> None:
        self.error, self.raises = error, raises

    def reward(self, action: Any) -> float:
        if self.raises:
            raise ValueError("the motor is on fire")
        return super().reward(action)

    def close(self) -> None:
        raise {"RuntimeError": RuntimeError, "SystemExit": SystemExit}[self.error]("stuck")


class Never(SmallEnv):
    """An episode without an end; its pictures have odd sides, and nobody knows their rate."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": None}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, size: int = 41, breaks: int = 0) -> None:
        self.render_mode, self.size, self.breaks = render_mode, size, breaks

    def terminated(self) -> bool:
        return False

    def render(self) -> np.ndarray | None:
        if self.breaks and self.t >= self.breaks:
            raise RuntimeError("the lamp is broken")
        picture = np.full((self.size, self.size + 4, 3), 20 * (self.t % 10), np.uint8)
        return picture if self.render_mode == "rgb_array" else None


class Board(SmallEnv):
    """A 5 x 5 board of bytes up to 3."""

    observation_space = spaces.Box(0, 3, (5, 5), np.uint8)
    length = 4

    def observe(self) -> np.ndarray:
        return np.full((5, 5), self.t % 4, np.uint8)


class Wide(SmallEnv):
    """The reward is higher the nearer the action is to 750 of [0, 1000]."""

    action_space = spaces.Box(0.0, 1000.0, (1,), np.float32)

    def reward(self, action: Any) -> float:
        assert self.action_space.contains(action)
        return -abs(float(action[0]) - 750.0) / 1000.0


class Parts(SmallEnv):
    """Several parts, nested, as one observation."""

    observation_space = spaces.Dict(
        {
            "hand": spaces.Tuple((spaces.Discrete(5, start=1), spaces.MultiBinary(2))),
            "speed": spaces.Box(-1, 1, (2,), np.float32),
        }
    )
    length = 4

    def observe(self) -> Any:
        hand = (1 + self.t % 5, np.array([1, 0], np.int8))
        return {"hand": hand, "speed": np.array([0.5, -0.5], np.float32)}


class Camera(SmallEnv):
    """A picture beside two numbers."""

    observation_space = spaces.Dict(
        {
            "picture": spaces.Box(0, 255, (36, 36, 1), np.uint8),
            "speed": spaces.Box(-1, 1, (2,), np.float32),
        }
    )
    length = 4

    def observe(self) -> Any:
        picture = np.full((36, 36, 1), 40 * self.t, np.uint8)
        return {"picture": picture, "speed": np.array([0.5, 0.1 * self.t], np.float32)}


class Choosy(SmallEnv):
    """Takes valid actions alone, and raises at any other; which are valid changes at random.

    Args:
      several: an action has two components, of 3 and 2 choices; else one of 5.
      by: how the mask is said, `method` or `info`.
      wrong: at the third step of an episode the mask is this.
    """

    observation_space = spaces.Box(-1, 1, (3,), np.float32)
    length = 6

    def __init__(self, several: bool = False, by: str = "info", wrong: Any = "") -> None:
        self.sizes = (3, 2) if several else (5,)
        self.action_space = spaces.MultiDiscrete((3, 2)) if several else spaces.Discrete(5, start=1)
        self.several, self.wrong = several, wrong
        if by == "method":
            self.action_masks = lambda: self.valid

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        seen, _ = super().reset(seed=seed)
        return seen, {"action_mask": self.valid}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        taken = action if self.several else [action - 1]
        starts = np.cumsum((0, *self.sizes))[:-1]
        assert self.valid[starts + taken].all(), f"{action} is not valid"
        *step, _ = super().step(action)
        mask = None if self.wrong == "missing" and self.t == 3 else self.valid
        return *step, {"action_mask": mask}  # type: ignore[return-value]

    def observe(self) -> np.ndarray:
        parts = []
        for size in self.sizes:
            part = self.np_random.integers(0, 2, size)
            part[self.np_random.integers(size)] = 1
            parts.append(part)
        self.valid = np.concatenate(parts).astype(np.int8)
        if self.wrong == "empty" and self.t == 3:
            self.valid[: self.sizes[0]] = 0
        return self.np_random.uniform(-1, 1, 3).astype(np.float32)


def make_vector(number: int = 2) -> Any:
    """Not one environment, but several."""
    return gymnasium.make_vec("CartPole-v1", num_envs=number)


INSTANCE = Scripted()


class Colours(SmallEnv):
    """Pictures `[96, 128, 3]`, red above and blue below, whose brightness is the step."""

    observation_space = spaces.Box(0, 255, (96, 128, 3), np.uint8)
    action_space = spaces.Discrete(2)
    length = 5

    def observe(self) -> np.ndarray:
        picture = np.zeros((96, 128, 3), np.uint8)
        picture[:48, :, 0] = picture[48:, :, 2] = 10 * self.t
        return picture

    def reward(self, action: int) -> float:
        return float(self.t)
