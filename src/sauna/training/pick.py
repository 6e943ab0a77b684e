"""The preset of a training that names none: the zoo's for its task, or one for its spaces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from sauna.config.other_names import ACCEPTED
from sauna.config.presets import arm_settings, parse_all, resolve_run
from sauna.config.settings import FIELDS, Config
from sauna.config.zoo import AUTO, entry_of, preset_of_spaces
from sauna.envs.pictures import SMALLEST_IMAGE
from sauna.envs.probe import Probe
from sauna.system.working_folder import kept_folder
from sauna.training.prepare import look_at, place

# What has to be known to look at an environment.
LOOKED_AT = ("env", "env_kwargs", "wrap", "stack", "action_mask", "backend", "device", "devices")


class Picked(NamedTuple):
    """Settings with their preset.

    Attributes:
      overrides: what the user gives, and the preset.
      said: which preset was picked and why, in one line; empty if nothing was.
      found: what was learned of the environment, if it had to be looked at.
    """

    overrides: dict[str, Any]
    said: str = ""
    found: Probe | None = None


def pick(overrides: Mapping[str, Any]) -> Picked:
    """Picks a preset, and how many env steps, if the user names none.

    Args:
      overrides: as the user gives them; `None` is not given.

    Raises:
      BadInput: a setting cannot be read, or the environment cannot be used.
    """
    given = {name: value for name, value in overrides.items() if value is not None}
    env, named = given.get("env"), given.get("preset", AUTO) != AUTO
    if not env or named or given.get("algorithm", Config.algorithm) != Config.algorithm:
        return Picked(given)
    entry = entry_of(str(env))
    if entry is not None:
        said = f"{entry.said(str(env), 'steps' in given)}; --preset names another"
        return Picked({**given, "preset": AUTO}, said)
    if given.get("distributed"):  # no machine may touch its accelerator before all have joined
        return Picked({**given, "preset": Config.preset})
    found = _look(given)
    spaces = found.spaces
    shapes = spaces.picture_shapes
    pictures = bool(shapes) and min(min(shape[:2]) for shape in shapes) >= SMALLEST_IMAGE
    discrete = spaces.action_kind != "continuous"
    preset, why = preset_of_spaces(pictures, discrete, found.time_limit)
    said = f"preset {preset}: the zoo does not know this environment, and {why}"
    return Picked({**given, "preset": preset}, f"{said}; --preset names another", found)


def _look(given: Mapping[str, Any]) -> Probe:
    """Looks at the environment, after everything that can be checked without it."""
    parsed = parse_all({name: value for name, value in given.items() if name not in ACCEPTED})
    for arm in parsed.get("arm", FIELDS["arm"].default):
        arm_settings(arm)
    with kept_folder():  # an environment may go elsewhere
        where = {name: value for name, value in parsed.items() if name in LOOKED_AT}
        return look_at(place(resolve_run(where)).config)
