"""Which environments run inside the compiled program, and how they are found by name.

    gymnax/CartPole-v1   playground/CheetahRun   brax/ant   mjx/InvertedPendulum-v5
    module:name          a `JaxEnv`, or a function that gives one

Every backend is an extra, imported where it is used.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

from sauna.config.plugins import import_name
from sauna.config.settings import NATIVE
from sauna.envs.device.contract import JaxEnv
from sauna.system.errors import BadInput, nearest, one_line

# What each backend's package is called where it is imported.
PACKAGES = {
    "gymnax": "gymnax",
    "playground": "mujoco_playground",
    "brax": "brax",
    "mjx": "mujoco.mjx",
}
HOST_ENVS = {"sauna/HumanoidFlagrunHarder-v0": "sauna.envs.flagrun.device:flagrun_mjx"}


def make_jax_env(env: str, env_kwargs: dict[str, Any]) -> JaxEnv:
    """The environment behind a name, whose functions see one environment.

    Raises:
      BadInput: there is no such environment, it lacks its extra, or it refuses its arguments.
    """
    backend, _, name = env.partition("/")
    if backend in NATIVE:
        module = _module(backend)
        if name not in module.names():
            raise BadInput(f"env: unknown environment {env!r}{nearest(name, module.names())}")
        return _made(env, lambda: module.make(name, **env_kwargs))
    if env in HOST_ENVS and not _is_installed("mjx"):
        raise BadInput(f"backend: {env} on the device needs `pip install 'sauna-rl[mjx]'`")
    path = HOST_ENVS.get(env, env)
    if ":" not in path:
        raise BadInput(f"backend: {env} does not run on the device; known are {_known()}")
    thing = import_name("env", path)
    if not isinstance(thing, JaxEnv):
        thing = _made(env, lambda: thing(**env_kwargs))
    elif env_kwargs:
        raise BadInput(f"env_kwargs: {env} is an environment already and takes none")
    if not isinstance(thing, JaxEnv):
        raise BadInput(f"backend: {env} is not a sauna.JaxEnv, so it cannot run on the device")
    return thing


def names_of(backend: str) -> list[str]:
    """All environments of a backend.

    Raises:
      BadInput: it is not installed.
    """
    return [f"{backend}/{name}" for name in sorted(_module(backend).names())]


def _module(backend: str) -> Any:
    if not _is_installed(backend):
        raise BadInput(f"env: {backend} is not installed; `pip install 'sauna-rl[{backend}]'`")
    return importlib.import_module(f"sauna.envs.device.{backend}_envs")


def _known() -> str:
    return ", ".join([*HOST_ENVS, *(f"{backend}/..." for backend in NATIVE), "module:name"])


def _made(env: str, make: Callable[[], Any]) -> Any:
    try:
        return make()
    except BadInput:
        raise
    except Exception as error:  # whatever a backend raises at names and arguments
        raise BadInput(f"env: {env} cannot be made: {one_line(error)}") from error


def _is_installed(backend: str) -> bool:
    try:
        return importlib.util.find_spec(PACKAGES[backend]) is not None
    except ModuleNotFoundError:  # of a parent package
        return False
