"""What is put around every environment of a run, wherever one is made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.system.errors import BadInput, one_line


class Wrapping(NamedTuple):
    """The settings that change what an environment shows or takes, the innermost first."""

    wrap: tuple[str, ...] = ()
    stack: int = 1
    action_mask: bool = False


PLAIN = Wrapping()


def wrapping_of(config: Config) -> Wrapping:
    """The wrapping that a run's settings ask for."""
    return Wrapping(config.wrap, config.stack, config.action_mask)


def read_wrapping(values: Mapping[str, Any]) -> Wrapping:
    """A wrapping back from its JSON form, in which tuples have become lists."""
    return Wrapping(**{**values, "wrap": tuple(values["wrap"])})


def wrapped_space(env: Any, wrapping: Wrapping) -> Any:
    """The observation space that an environment has, or will have once it is wrapped.

    What a user's own wrappers do to it cannot be known: they have been put around it already.

    Raises:
      BadInput: a wrapper does not fit it.
    """
    space = env.observation_space
    if getattr(space, "mask_size", 0):  # the outermost is there
        return space
    if wrapping.stack > 1:
        from sauna.envs.stacked import stacked_space

        space = stacked_space(space, env.action_space, wrapping.stack)
    if wrapping.action_mask:
        from sauna.envs.masked import masked_space

        space = masked_space(space, env.action_space)
    return space


def wrapped(env: Any, wrapping: Wrapping) -> Any:
    """Puts the wrappers around a Gymnasium environment.

    Raises:
      BadInput: one does not fit it.
    """
    for path in wrapping.wrap:
        env = _with_own(env, path)
    if wrapping.stack > 1:
        from sauna.envs.stacked import StackedEnv

        env = StackedEnv(env, wrapping.stack)
    if wrapping.action_mask:
        from sauna.envs.masked import MaskedEnv

        env = MaskedEnv(env)
    return env


def _with_own(env: Any, path: str) -> Any:
    """Puts the wrapper `module:function` of a user's around an environment.

    Raises:
      BadInput: it raises, or gives no environment.
    """
    wrapper = import_name("wrap", path)
    try:
        made = wrapper(env)
    except Exception as error:  # whatever a user's wrapper raises
        raise BadInput(f"wrap: {path} cannot wrap the environment: {one_line(error)}") from error
    if not all(hasattr(made, name) for name in ("reset", "step", "observation_space")):
        raise BadInput(f"wrap: {path} gives no environment, but {type(made).__name__}")
    return made
