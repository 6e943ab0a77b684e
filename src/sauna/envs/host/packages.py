"""Environments of other packages, each an extra, which are known by their ids alone."""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

from sauna.system.errors import BadInput


class Package(NamedTuple):
    """A package that registers environments with Gymnasium when it is imported."""

    pattern: str  # of its ids
    module: str
    extra: str  # of ours, which installs it
    examples: str  # of its ids, for a list


PACKAGES = (
    Package(r"(?:MiniGrid|BabyAI)-.+", "minigrid", "minigrid", "MiniGrid-..., BabyAI-..."),
    Package(
        r"(?:Adroit|AntMaze_|Fetch|FrankaKitchen|HandManipulate|HandReach|PointMaze_).*-v\d+",
        "gymnasium_robotics",
        "robotics",
        "PointMaze_..., AntMaze_..., FetchReachDense-v4, ...",
    ),
)


def package_of(name: str) -> Package | None:
    """Finds the package that has an environment of this id; None if none of ours does."""
    return next((one for one in PACKAGES if re.fullmatch(one.pattern, name)), None)


def register(package: Package, name: str) -> None:
    """Registers the package's environments.

    Raises:
      BadInput: it is not installed; the extra that installs it is named.
    """
    import gymnasium

    if importlib.util.find_spec(package.module) is None:
        raise BadInput(f"env: {name} needs `pip install 'sauna-rl[{package.extra}]'`")
    gymnasium.register_envs(importlib.import_module(package.module))


def know_joints_of_mujoco_4() -> None:
    """Lets Gymnasium-Robotics (1.4.2) find its joints with MuJoCo 4.

    It asks whether a number is in a tuple of MuJoCo's kinds of joints. Since MuJoCo 4 those equal
    no NumPy number there, and Fetch, Hand and Kitchen fail. Here the kinds become plain numbers.
    """
    import mujoco

    utils = importlib.import_module("gymnasium_robotics.utils.mujoco_utils")
    if vars(utils)["mujoco"] is not mujoco:  # it knows them already
        return
    kinds = {name: int(kind) for name, kind in mujoco.mjtJoint.__members__.items()}
    seen = ModuleType(mujoco.__name__)
    seen.__dict__.update(mujoco.__dict__, mjtJoint=SimpleNamespace(**kinds))
    vars(utils)["mujoco"] = seen


def forget_worlds(env: Any) -> Any:
    """Lets each episode of BipedalWalker (Gymnasium 1.3) begin in a new Box2D world.

    Gymnasium keeps the world, whose order of contacts depends on the episodes before. The same
    episode then ends elsewhere in an environment that has played others, and exact resume, which
    replays it, cannot find its state again. LunarLander's world is new in each episode already.
    Any other environment stays as it is.
    """
    module = sys.modules.get("gymnasium.envs.box2d.bipedal_walker")
    walker = getattr(env, "unwrapped", None)
    if module is None or not isinstance(walker, vars(module)["BipedalWalker"]):
        return env
    destroy = walker._destroy  # the first that a reset calls

    def destroy_world() -> None:
        destroy()
        walker.world = vars(module)["Box2D"].b2World()

    walker._destroy = destroy_world
    return env


def as_vector(env: Any) -> Any:
    """MiniGrid's observations as one vector, picture and mission, as RL Zoo has them.

    Any other environment stays as it is.
    """
    spaces = getattr(env.observation_space, "spaces", {})
    if type(spaces.get("mission", None)).__name__ != "MissionSpace":
        return env
    from minigrid.wrappers import FlatObsWrapper

    return FlatObsWrapper(env)
