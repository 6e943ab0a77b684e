"""EnvPool's environments as vector environments of Gymnasium."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from sauna.system.errors import BadInput, nearest

OF_THE_POOL = ("env_id", "elapsed_step", "players")


def make_envpool(name: str) -> Callable[..., Any]:
    """A function `(num_envs, **kwargs) -> EnvPool` of an environment's id.

    Raises:
      BadInput: EnvPool has no such environment.
    """
    import envpool

    known = envpool.list_all_envs()
    if name not in known:
        raise BadInput(f"env: EnvPool has no {name!r}{nearest(name, known)}")
    return lambda num_envs, **kwargs: EnvPool(name, num_envs, kwargs)


class EnvPool:
    """A pool, which takes its seed when it is made: to reset it with one makes it anew.

    Of an episode that ended the next step is void, as in Gymnasium's mode `NEXT_STEP`.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, name: str, num_envs: int, kwargs: dict[str, Any]) -> None:
        self._name, self.num_envs, self._kwargs = name, num_envs, kwargs
        self._pool = self._made(0)
        self.single_observation_space = self._pool.observation_space
        self.single_action_space = self._pool.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _made(self, seed: int) -> Any:
        import envpool

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on the precision of its boxes
            return envpool.make_gymnasium(
                self._name, num_envs=self.num_envs, seed=seed, **self._kwargs
            )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begins new episodes in all rows."""
        if seed is not None:
            self._pool.close()
            self._pool = self._made(seed % 2**31)  # which it keeps as a signed int
        return self._pool.reset()

    def step(self, action: Any) -> Any:
        """One step of all rows; what its info says of the pool itself is left out."""
        *answer, info = self._pool.step(action)
        return *answer, {name: value for name, value in info.items() if name not in OF_THE_POOL}

    def close(self) -> None:
        """Frees the pool's threads."""
        self._pool.close()
