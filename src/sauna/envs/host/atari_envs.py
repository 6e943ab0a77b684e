"""Atari 2600 games on ale-py's own vector environment: `ALE/Breakout-v5`, `ALE/Pong-v5`, ...

A step is as in Mnih et al. (2015) and OpenAI baselines: an action for four frames, of which the
last two are seen (the larger of each pixel), grey, 84 x 84, behind the three steps before; a game
begins with FIRE, where there is one, and no-ops, up to 30 frames in all. Rewards are the game's
own.

Three things are done here because ale-py (0.12) does them otherwise. A lost life is reported
and the game goes on: ale-py's `episodic_life` begins a new game, so that later lives are never
played, and its `life_loss_info` makes an end of it. The time limit is counted here: where ale-py
truncates, it leaves out the last frame and shows one of the step before instead. And a vector
environment steps all of its games or none, but a filter lets some stand still: so each game is a
vector of one with a thread of its own, and a step is begun in all of them before the first is
waited for.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import gymnasium
import numpy as np

from sauna.envs.host.contract import Step
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs, Slot
from sauna.system.errors import BadInput, nearest

PREFIX = "ALE/"
FRAMES = 4  # per env step
UNLIMITED = 2**31 - 1  # frames; the time limit is ours


def is_atari(env: str) -> bool:
    """Whether an environment's name is that of a game here."""
    return env.startswith(PREFIX)


def names() -> list[str]:
    """All games.

    Raises:
      BadInput: ale-py is not installed.
    """
    if importlib.util.find_spec("ale_py") is None:
        raise BadInput("env: ale-py is not installed; `pip install 'sauna-rl[atari]'`")
    import ale_py  # noqa: F401 - registers them

    return sorted(name for name in gymnasium.registry if is_atari(name))


def known_games() -> list[str]:
    """All games, or none where ale-py is not installed."""
    return names() if importlib.util.find_spec("ale_py") is not None else []


def game_of(env: str) -> str:
    """ale-py's name of a game: `ALE/MsPacman-v5` is `ms_pacman`.

    Raises:
      BadInput: there is no such game (the nearest is named), or ale-py is not installed.
    """
    known = names()
    if env not in known:
        raise BadInput(f"env: unknown environment {env!r}{nearest(env, known)}")
    return str(gymnasium.registry[env].kwargs["game"])


class AtariEnv(gymnasium.Env):
    """One game; what is not a lost life, a reward or the end of it stays inside.

    Args:
      game: ale-py's name.
      repeat_action_probability: of sticky actions (Machado et al. 2018 use 0.25).
      full_action_space: all 18 actions, instead of those that the game knows.
      noop_max: most frames that pass before the first observation, FIRE among them (which passes
        also where this is 0).
      use_fire_reset: whether FIRE is pressed first, in games that wait for it.
      episodic_life: whether `info["life_lost"]` says that a life was lost and the game goes on.
      max_num_frames_per_episode: the time limit, in frames after the first observation.
      render_mode: `rgb_array` for pictures of the game itself, or None.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 60 / FRAMES}  # noqa: RUF012

    def __init__(
        self,
        game: str,
        *,
        repeat_action_probability: float = 0.0,
        full_action_space: bool = False,
        noop_max: int = 30,
        use_fire_reset: bool = True,
        episodic_life: bool = True,
        max_num_frames_per_episode: int = 108_000,
        render_mode: str | None = None,
    ) -> None:
        from ale_py.vector_env import AtariVectorEnv

        if not 0 <= repeat_action_probability < 1:
            raise ValueError("repeat_action_probability must be at least 0 and below 1")
        if noop_max < 0 or max_num_frames_per_episode < FRAMES:
            raise ValueError("noop_max and max_num_frames_per_episode must allow for a step")
        same: dict[str, Any] = {
            "repeat_action_probability": repeat_action_probability,
            "full_action_space": full_action_space,
            "noop_max": noop_max + 1,  # ale-py draws a number below it
            "use_fire_reset": use_fire_reset,
            "frameskip": FRAMES,
            "max_num_frames_per_episode": UNLIMITED,
            "reward_clipping": False,
        }
        self._ale = AtariVectorEnv(game, 1, **same)
        # The same game again for its pictures: from the same seed the same actions lead to them.
        self._filmed = None
        if render_mode == "rgb_array":
            size = {"img_height": 210, "img_width": 160, "stack_num": 1}
            self._filmed = AtariVectorEnv(game, 1, grayscale=False, maxpool=False, **size, **same)
        self.render_mode = render_mode
        self.observation_space = self._ale.single_observation_space  # [4, 84, 84], newest last
        self.action_space = self._ale.single_action_space
        self._episodic_life, self._limit = episodic_life, max_num_frames_per_episode // FRAMES
        self._lives, self._steps = 0, 0
        self._picture = np.zeros((210, 160, 3), np.uint8)

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new game. Without a seed it is drawn from the generator that the last seed began."""
        super().reset(seed=seed)
        drawn = seed if seed is not None else int(self.np_random.integers(2**31))
        seeds = np.array([drawn % 2**31])
        observation, info = self._ale.reset(seed=seeds)
        self._lives, self._steps = int(info["lives"][0]), 0
        if self._filmed is not None:
            self._picture = self._filmed.reset(seed=seeds)[0][0, 0]
        return observation[0], {"frames": int(info["episode_frame_number"][0])}

    def send(self, action: int) -> None:
        """Begins a step; `receive` has to follow."""
        chosen = np.array([action], np.int32)
        self._ale.send(chosen)
        if self._filmed is not None:
            self._picture = self._filmed.step(chosen)[0][0, 0]

    def receive(self) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """What the step that was begun led to."""
        observation, reward, terminated, _, info = self._ale.recv()
        lives, over = int(info["lives"][0]), bool(terminated[0])
        self._steps += 1
        truncated = self._steps >= self._limit and not over
        lost = self._episodic_life and lives < self._lives and not (over or truncated)
        self._lives = lives
        return observation[0], float(reward[0]), over, truncated, {"life_lost": lost}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.send(int(action))
        return self.receive()

    def render(self) -> np.ndarray | None:
        return None if self.render_mode is None else self._picture

    def close(self) -> None:
        self._ale.close()
        if self._filmed is not None:
            self._filmed.close()


class AtariEnvs(GymnasiumEnvs):
    """M games that are stepped at the same time; see `GymnasiumEnvs`."""

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        for index in np.flatnonzero(active).tolist():
            self._slots[index].env.send(self._write(action[index]))
        return super().step(action, active)

    def _take(self, slot: Slot, action: np.ndarray) -> Any:
        return slot.env.receive()
