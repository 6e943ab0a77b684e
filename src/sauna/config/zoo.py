"""Which preset an environment gets if nobody names one, and for how many env steps.

The published returns are RL Zoo's (DLR-RM/rl-baselines3-zoo, `benchmark.md` at revision 22e3ff2):
mean and standard deviation of the evaluation of one trained agent, perhaps of an older version of
the environment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from sauna.config.settings import Config
from sauna.system.errors import BadInput

AUTO = "auto"  # the preset that stands for the one of the environment
LONG = 1000  # env steps; a time limit above is a long horizon

RL_ZOO = "RL Zoo's numbers"
RL_ZOO_BONUS = "RL Zoo's numbers with an entropy bonus of our own"
OWN = "own numbers"


class Entry(NamedTuple):
    """What a zoo knows of some environments."""

    pattern: str  # of whole names, without a `module:` in front
    preset: str
    steps: int  # env steps of a member, if nobody says otherwise
    source: str  # of the preset's numbers

    def said(self, env: str, steps_named: bool) -> str:
        """Says in one line what is picked for an environment, and whose numbers they are."""
        steps = "" if steps_named else f", {self.steps:,} env steps"
        return f"preset {self.preset} for {env} ({self.source}){steps}"


MUJOCO = (
    "Ant|HalfCheetah|Hopper|Humanoid|HumanoidStandup|InvertedDoublePendulum|InvertedPendulum|"
    "Pusher|Reacher|Swimmer|Walker2d"
)
PLAYGROUND = "CartpoleBalance|CartpoleSwingup|CheetahRun|ReacherEasy|WalkerWalk"
SCHULMAN = "the numbers of Schulman et al. (2017)"

# The first that matches counts.
ZOO = (
    Entry(r"(?:gymnax/)?CartPole-v\d+", "cartpole", 100_000, RL_ZOO),
    Entry(r"(?:gymnax/)?Acrobot-v\d+", "acrobot", 1_000_000, RL_ZOO),
    Entry(r"(?:gymnax/)?MountainCar-v\d+", "mountain-car", 1_000_000, RL_ZOO),
    Entry(r"(?:gymnax/)?MountainCarContinuous-v\d+", "mountain-car-continuous", 100_000, OWN),
    Entry(r"(?:gymnax/)?Pendulum-v\d+", "pendulum", 100_000, RL_ZOO),
    Entry(r"LunarLander(?:Continuous)?-v\d+", "lunar-lander", 1_000_000, RL_ZOO),
    Entry(r"BipedalWalker-v\d+", "bipedal-walker", 5_000_000, RL_ZOO),
    Entry(r"BipedalWalkerHardcore-v\d+", "bipedal-walker-hardcore", 100_000_000, RL_ZOO),
    Entry(r"CarRacing-v\d+", "car-racing", 200_000, OWN),
    Entry(r"(?:mjx/)?Swimmer-v\d+", "swimmer", 1_000_000, OWN),
    Entry(r"InvertedDoublePendulum-v\d+", "inverted-double-pendulum", 1_000_000, OWN),
    Entry(r"(?:mjx/)?HalfCheetah-v\d+", "half-cheetah", 1_000_000, RL_ZOO),
    Entry(rf"(?:mjx/)?(?:{MUJOCO})-v\d+", "mujoco", 1_000_000, SCHULMAN),
    Entry(r"ALE/.+", "atari", 10_000_000, SCHULMAN),
    Entry(r"gymnax/.+-MinAtar", "minatar", 10_000_000, "PureJaxRL's numbers"),
    Entry(rf"playground/(?:{PLAYGROUND})", "playground", 60_000_000, OWN),
    Entry(r"sauna/HumanoidFlagrun\w*-v\d+", "flagrun", 100_000_000, SCHULMAN),
    Entry(r"MiniGrid-FourRooms-v\d+", "minigrid-long", 5_000_000, RL_ZOO_BONUS),
    Entry(r"MiniGrid-RedBlueDoors-\w+-v\d+", "minigrid-long", 1_000_000, RL_ZOO_BONUS),
    Entry(r"MiniGrid-(?:Empty|DoorKey|Unlock)-.+", "minigrid", 100_000, RL_ZOO),
    Entry(r"MiniGrid-KeyCorridor.+", "minigrid", 500_000, RL_ZOO),
    Entry(r"MiniGrid-(?:Fetch|GoToDoor)-.+", "minigrid", 5_000_000, RL_ZOO),
    Entry(r"MiniGrid-.+", "minigrid", 10_000_000, RL_ZOO),
    Entry(r"PointMaze_\w*Dense-v\d+", "robotics", 1_000_000, OWN),
    Entry(r"FetchReachDense-v\d+", "robotics", 200_000, OWN),
)


class Published(NamedTuple):
    """A return that RL Zoo publishes of its PPO."""

    mean: float
    std: float  # over the episodes of one agent
    env: str  # as RL Zoo has it


PUBLISHED = {
    "CartPole-v1": Published(500.0, 0.0, "CartPole-v1"),
    "Acrobot-v1": Published(-73.506, 18.201, "Acrobot-v1"),
    "MountainCar-v0": Published(-110.423, 19.473, "MountainCar-v0"),
    "MountainCarContinuous-v0": Published(88.343, 2.572, "MountainCarContinuous-v0"),
    "Pendulum-v1": Published(-172.225, 104.159, "Pendulum-v1"),
    "LunarLander-v3": Published(242.119, 31.823, "LunarLander-v2"),
    "LunarLanderContinuous-v3": Published(270.863, 32.072, "LunarLanderContinuous-v2"),
    "BipedalWalker-v3": Published(287.939, 2.448, "BipedalWalker-v3"),
    "BipedalWalkerHardcore-v3": Published(122.374, 117.605, "BipedalWalkerHardcore-v3"),
    "CarRacing-v3": Published(153.938, 74.465, "CarRacing-v0"),
    "Ant-v5": Published(1327.158, 451.577, "Ant-v3"),
    "HalfCheetah-v5": Published(5819.099, 663.530, "HalfCheetah-v3"),
    "Hopper-v5": Published(2410.435, 10.026, "Hopper-v3"),
    "Swimmer-v5": Published(281.561, 9.671, "Swimmer-v3"),
    "Walker2d-v5": Published(3478.798, 821.708, "Walker2d-v3"),
    "ALE/Asteroids-v5": Published(2156.174, 744.640, "AsteroidsNoFrameskip-v4"),
    "ALE/BeamRider-v5": Published(3397.000, 1662.368, "BeamRiderNoFrameskip-v4"),
    "ALE/Breakout-v5": Published(398.033, 33.328, "BreakoutNoFrameskip-v4"),
    "ALE/Enduro-v5": Published(996.364, 176.090, "EnduroNoFrameskip-v4"),
    "ALE/MsPacman-v5": Published(1754.356, 172.783, "MsPacmanNoFrameskip-v4"),
    "ALE/Pong-v5": Published(20.989, 0.105, "PongNoFrameskip-v4"),
    "ALE/Qbert-v5": Published(15627.108, 3313.538, "QbertNoFrameskip-v4"),
    "ALE/RoadRunner-v5": Published(40680.645, 6675.058, "RoadRunnerNoFrameskip-v4"),
    "ALE/Seaquest-v5": Published(1783.636, 34.096, "SeaquestNoFrameskip-v4"),
    "ALE/SpaceInvaders-v5": Published(960.331, 425.355, "SpaceInvadersNoFrameskip-v4"),
}
PUBLISHED |= {
    f"MiniGrid-{name}-v0": Published(mean, std, f"MiniGrid-{name}-v0")
    for name, mean, std in (
        ("DoorKey-5x5", 0.964, 0.006),
        ("Empty-Random-5x5", 0.968, 0.013),
        ("FourRooms", 0.573, 0.311),
        ("GoToDoor-5x5", 0.525, 0.476),
        ("KeyCorridorS3R1", 0.949, 0.011),
        ("LockedRoom", 0.0, 0.0),
        ("MultiRoom-N4-S5", 0.0, 0.0),
        ("ObstructedMaze-2Dlh", 0.0, 0.0),
        ("PutNear-6x6-N2", 0.612, 0.295),
        ("RedBlueDoors-6x6", 0.860, 0.313),
        ("Unlock", 0.963, 0.016),
    )
}

# Environments that people try first: what `sauna list presets` and docs/results/zoo.md show.
ENVS = (
    "CartPole-v1",
    "Acrobot-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
    "LunarLander-v3",
    "LunarLanderContinuous-v3",
    "BipedalWalker-v3",
    "BipedalWalkerHardcore-v3",
    "CarRacing-v3",
    *(f"{name}-v5" for name in MUJOCO.split("|")),
    *(name for name in PUBLISHED if name.startswith("ALE/")),
    *(f"gymnax/{name}-MinAtar" for name in ("Asterix", "Breakout", "Freeway", "SpaceInvaders")),
    "gymnax/CartPole-v1",
    "gymnax/Acrobot-v1",
    "gymnax/MountainCar-v0",
    "gymnax/MountainCarContinuous-v0",
    "gymnax/Pendulum-v1",
    *(f"playground/{name}" for name in PLAYGROUND.split("|")),
    *(name for name in PUBLISHED if name.startswith("MiniGrid-")),
    "PointMaze_UMazeDense-v3",
    "FetchReachDense-v4",
    "sauna/HumanoidFlagrunHarder-v0",
)


def entry_of(env: str) -> Entry | None:
    """Finds what the zoo knows of an environment, by its name; None if nothing."""
    module, _, name = env.rpartition(":")
    if module and re.fullmatch(r"[\w.]+", module) is None:
        return None
    return next((entry for entry in ZOO if re.fullmatch(entry.pattern, name)), None)


def entry_for(settings: Mapping[str, Any]) -> Entry | None:
    """Finds the entry that preset `auto` stands for; None if it stands for none.

    Args:
      settings: as a user gives them, parsed.

    Raises:
      BadInput: the zoo knows nothing of the environment.
    """
    env, algorithm = settings.get("env"), settings.get("algorithm", Config.algorithm)
    if settings.get("preset") != AUTO or not env or algorithm != Config.algorithm:
        return None
    entry = entry_of(env)
    if entry is None:
        raise BadInput(
            f"preset: the zoo knows no {env}; `sauna train` picks a preset by its spaces, "
            "elsewhere name one (see `sauna list presets`)"
        )
    return entry


def preset_of_spaces(pictures: bool, discrete: bool, time_limit: int | None) -> tuple[str, str]:
    """Picks a preset for an environment that the zoo does not know.

    Args:
      pictures: whether it is seen in pictures that are large enough for the Nature CNN.
      discrete: whether its actions are.
      time_limit: env steps after which an episode is cut; None if that is not known.

    Returns:
      the preset's name, and why.
    """
    if pictures:
        return "pictures", "it is seen in pictures"
    if time_limit is not None and time_limit > LONG:
        return "long-horizon", f"its episodes last up to {time_limit:,} steps"
    if discrete:
        return "discrete", "its actions are discrete"
    return "mujoco", "its actions are continuous"


def shown_published(env: str) -> str:
    """Writes the published return of an environment as `242.1 +- 31.8`; empty if there is none."""
    found = PUBLISHED.get(env)
    if found is None:
        return ""
    digits = 1 if abs(found.mean) >= 10 else 3
    return f"{found.mean:,.{digits}f} +- {found.std:,.{digits}f}"


def row_of(env: str) -> tuple[str, str, str, str] | tuple[()]:
    """Writes what the zoo knows: environment, preset, env steps, published return; or nothing."""
    entry = entry_of(env)
    return (env, entry.preset, f"{entry.steps:,}", shown_published(env)) if entry else ()
