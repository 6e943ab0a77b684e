"""Which environment a name means, and what steps it: the host or the device."""

from __future__ import annotations

import importlib.util
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sauna.config.plugins import import_module, import_name, is_local
from sauna.config.settings import NATIVE
from sauna.envs.actions import stretch
from sauna.envs.host.answers import close
from sauna.envs.host.contract import HostEnvs
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs
from sauna.envs.host.packages import (
    as_vector,
    forget_worlds,
    know_joints_of_mujoco_4,
    package_of,
    register,
)
from sauna.envs.host.together import group_size, is_known, maker_of, plain_maker, rows_of
from sauna.envs.wrapping import PLAIN, Wrapping, wrapped
from sauna.system.errors import BadInput, nearest, one_line

_GYMNASIUM_ID = re.compile(r"^(?:[\w./-]+:)?(?:[\w-]+/)?[\w.-]+-v\d+$")
_OLD_ATARI = re.compile(r"^(\w+?)(?:-ram)?(?:NoFrameskip|Deterministic)?-v\d$")


def env_maker(env: str, env_kwargs: dict[str, Any]) -> Callable[..., Any]:
    """A function that makes the environment; it takes further keywords such as `render_mode`.

    `env` is a Gymnasium id (also `module:Id-v0`, importing the module first) or `module:function`.
    A further keyword counts more than the same one among `env_kwargs`.

    Raises:
      BadInput: there is no such environment; the nearest known id is named.
    """
    env = one_name(env)
    if is_native(env, env_kwargs):
        from sauna.envs.device.as_gymnasium import HostFace
        from sauna.envs.device.make import make_jax_env

        return lambda **more: HostFace(make_jax_env(env, env_kwargs), **more)
    if env.startswith("ALE/"):
        from sauna.envs.host.atari_envs import AtariEnv, game_of

        game = game_of(env)
        return lambda **more: AtariEnv(game, **{**env_kwargs, **more})
    if is_known(env):
        return plain_maker(maker_of(env), env_kwargs)
    if is_function_name(env):
        function = import_name("env", env)
        check_makes(env, function)
        make = plain_maker(function, env_kwargs)
        return lambda **more: forget_worlds(make(**more))
    import gymnasium

    name = _registered(env)
    kwargs = {"disable_env_checker": True, **env_kwargs}
    return lambda **more: forget_worlds(as_vector(gymnasium.make(name, **{**kwargs, **more})))


def one_name(env: str) -> str:
    """The one name of an environment that has several.

    Raises:
      BadInput: it names an Atari game that would come without the preprocessing of the papers.
    """
    module, _, name = env.rpartition(":")
    if module in ("ale_py", "gymnasium", "") and name.startswith("ALE/"):
        return name
    old = _OLD_ATARI.match(name)
    if old and module in ("ale_py", "gymnasium", "") and not _is_another(name):
        from sauna.envs.host.atari_envs import known_games

        answer = f"ALE/{old[1]}-v5"
        if answer in known_games():
            raise BadInput(f"env: {env} lacks the published preprocessing; write {answer}")
    return env


def _is_another(name: str) -> bool:
    """Whether a registered id is no Atari game."""
    import gymnasium

    spec = gymnasium.registry.get(name)
    return spec is not None and not str(spec.entry_point).startswith("ale_py")


def is_function_name(env: str) -> bool:
    """Whether a name is `module:function`, and not `module:Id-v0`."""
    return ":" in env and not _GYMNASIUM_ID.match(env)


def check_makes(env: str, function: Any) -> None:
    """Refuses what makes no environment: an environment itself, or no function at all.

    Raises:
      BadInput: saying what to write instead.
    """
    if is_jax_env(function) or isinstance(function, type):
        return
    if hasattr(function, "step") and hasattr(function, "reset"):
        raise BadInput(
            f"env: {_shown(env)} is an environment already; give what makes one: its class, or "
            "lambda: MyEnv(...)"
        )
    if not callable(function):
        raise BadInput(
            f"env: {_shown(env)} is a {type(function).__name__}, and makes no environment; give a "
            "Gymnasium id, a class, or a function"
        )


def _shown(env: str) -> str:
    return "what was passed" if is_local(env) else env


def _registered(env: str) -> str:
    """Gymnasium's id of an environment, whose module is imported first.

    Raises:
      BadInput: there is no such id; the nearest is named.
    """
    import gymnasium

    module, _, name = env.rpartition(":")
    if module:
        import_module("env", module, f"{module}:{name}")
    if name.startswith("sauna/"):
        tame_mujoco()
        importlib.import_module("sauna.envs.flagrun")
    package = package_of(name)
    if package is not None and name not in gymnasium.registry:
        register(package, name)
    if name not in gymnasium.registry:
        hint = _with_colon(env) or nearest(name, gymnasium.registry)
        raise BadInput(f"env: unknown environment {env!r}{hint}")
    entry = str(gymnasium.registry[name].entry_point)
    of_robotics = entry.startswith("gymnasium_robotics")
    if "mujoco" in entry or of_robotics:
        tame_mujoco()
    if of_robotics:
        know_joints_of_mujoco_4()
    return name


def _with_colon(env: str) -> str:
    """Writes `; ...` if a name is that of a class or function in a module: `my_module.MyEnv`."""
    module, _, name = env.rpartition(".")
    parts = module.split(".")
    if not name.isidentifier() or not all(part.isidentifier() for part in parts):
        return ""
    is_here = Path(f"{parts[0]}.py").is_file() or Path(parts[0]).is_dir()
    if not is_here and not (parts[0] in sys.modules or importlib.util.find_spec(parts[0])):
        return ""
    return f"; a class or function of a module is written '{module}:{name}'"


def known_in_this_process_alone(env: str) -> bool:
    """Whether this program registered an id itself: another process would not find it."""
    gymnasium = sys.modules.get("gymnasium")
    if ":" in env or gymnasium is None or env not in gymnasium.registry:
        return False
    if env.startswith(("ALE/", "sauna/")) or package_of(env) is not None:
        return False
    own = Path(gymnasium.envs.__file__).read_text(encoding="utf-8")  # registers them one by one
    return f'"{env}"' not in own


def tame_mujoco() -> None:
    """MuJoCo's warnings become Python's, instead of lines on stdout and a MUJOCO_LOG.TXT.

    What it calls deprecated is in the model files that Gymnasium ships: nothing for a user to mend.
    """
    import mujoco

    def warn(message: str) -> None:
        if "deprecated" in message:
            return
        text = f"MuJoCo: {message.strip()}"
        try:
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        except RuntimeWarning:  # made an error of: raised inside MuJoCo, it would end the process
            print(text, file=sys.stderr)

    mujoco.set_mju_user_warning(warn)


def make_env(env: str, env_kwargs: dict[str, Any], wrapping: Wrapping = PLAIN, **more: Any) -> Any:
    """One environment, or a `BadInput` that says why it cannot be made."""
    maker = env_maker(env, env_kwargs)
    try:
        made = maker(**more)
    except Exception as error:  # whatever a user's environment raises when made
        raise BadInput(f"env: {_shown(env)} cannot be made: {one_line(error)}") from error
    if hasattr(made, "single_observation_space") or hasattr(made, "env_is_wrapped"):
        raise BadInput(
            f"env: {_shown(env)} gives a vector of environments; give what makes one of them, and "
            "their number as envs (--envs), or let the function take num_envs"
        )
    if not hasattr(made, "observation_space"):
        raise BadInput(f"env: {_shown(env)} gives no environment, but {type(made).__name__}")
    _check_stands_alone(env, made, wrapping)
    return wrapped(made, wrapping)


def _check_stands_alone(env: str, made: Any, wrapping: Wrapping) -> None:
    """Refuses wrappers around rows that are stepped together.

    Raises:
      BadInput: naming the setting.
    """
    if wrapping == PLAIN or group_size(made) is None:
        return
    name = next(
        name for name in Wrapping._fields if getattr(wrapping, name) != getattr(PLAIN, name)
    )
    raise BadInput(f"{name}: the rows of {_shown(env)} are stepped together; wrap what makes them")


def make_drawn_env(env: str, env_kwargs: dict[str, Any], wrapping: Wrapping = PLAIN) -> Any:
    """As `make_env`, with pictures (`rgb_array`) that follow the robot.

    Where no camera is asked for, Gymnasium 1.4 draws MuJoCo tasks from where they begin, and a
    robot that runs leaves the picture. Before, and here, the model's own camera `track` is used.
    """
    made = make_env(env, env_kwargs, wrapping, render_mode="rgb_array")
    renderer = getattr(getattr(made, "unwrapped", None), "mujoco_renderer", None)
    if renderer is not None and not any("camera" in name for name in env_kwargs):
        import mujoco

        camera = mujoco.mj_name2id(renderer.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
        renderer.camera_id = camera  # -1, a free camera, where the model has none
    return made


def in_process_envs(
    env: str,
    env_kwargs: dict[str, Any],
    seeds: Sequence[tuple[int, int]],
    backend: str,
    rescale: bool = False,
    wrapping: Wrapping = PLAIN,
) -> HostEnvs:
    """M environments stepped in this process, by the fastest backend that gives the same bits.

    Args:
      env, env_kwargs: what is made; see `env_maker`.
      seeds: `(member seed, env index)` of each environment.
      backend: `auto`, or `gymnasium` to have every step taken by Gymnasium itself.
      rescale: stretch actions in [-1, 1] to a bounded box.
      wrapping: is put around each environment, which Gymnasium itself then steps.
    """
    env = one_name(env)
    make = env_maker(env, env_kwargs)
    if is_known(env) or is_function_name(env):
        first = make()
        function = maker_of(env) if is_known(env) else import_name("env", env)
        together = rows_of(function, env_kwargs, first, seeds, rescale)
        if together is not None:
            close(first)
            return together
        made = [first]  # which was only to be looked at
        return GymnasiumEnvs(
            lambda: wrapped(made.pop() if made else make(), wrapping), seeds, rescale
        )
    if wrapping != PLAIN:
        return GymnasiumEnvs(lambda: wrapped(make(), wrapping), seeds, rescale)
    if backend == "auto" and env.startswith("ALE/"):
        from sauna.envs.host.atari_envs import AtariEnvs

        return AtariEnvs(make, seeds)
    if backend == "auto" and steps_mujoco(env):
        from sauna.envs.host.mujoco_envs import MujocoEnvs, time_limit

        first = make()
        stretched = rescale and stretch(first.action_space) is not None
        fits = time_limit(first) is not None and not stretched
        close(first)
        if fits:
            return MujocoEnvs(make, seeds)
    return GymnasiumEnvs(make, seeds, rescale)


def is_mujoco(env: str) -> bool:
    """Whether a registered environment's class is one of Gymnasium's MuJoCo tasks."""
    return _is_of(env, "gymnasium.envs.mujoco")


def steps_mujoco(env: str) -> bool:
    """Whether a registered environment `is_mujoco`, or HumanoidFlagrunHarder."""
    return is_mujoco(env) or _is_of(env, "sauna.envs.flagrun")


def _is_of(env: str, module: str) -> bool:
    import gymnasium

    spec = gymnasium.registry.get(env)
    return spec is not None and str(spec.entry_point).startswith(module)


def is_native(env: str, env_kwargs: dict[str, Any]) -> bool:
    """Whether an environment is a `JaxEnv`: it has no other place to run than the device.

    Raises:
      BadInput: it is `module:name` and that cannot be imported.
    """
    if env.split("/")[0] in NATIVE:
        return True
    if not is_function_name(env):
        return False
    thing = import_name("env", env)
    check_makes(env, thing)
    if is_jax_env(thing) or not callable(thing):
        return is_jax_env(thing)
    try:
        made = thing(**env_kwargs)
    except Exception:
        return False
    if hasattr(made, "close"):
        close(made)
    return is_jax_env(made)


def is_jax_env(thing: Any) -> bool:
    """Whether it is a `JaxEnv`; whoever made one has imported its module."""
    module = sys.modules.get("sauna.envs.device.contract")
    return module is not None and isinstance(thing, module.JaxEnv)
