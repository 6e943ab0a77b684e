"""How a hyperparameter moves while the budget of steps is used up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sauna.config.plugins import import_name
from sauna.config.settings import Config
from sauna.system.errors import BadInput, one_line

SCHEDULED = ("learning_rate", "clip_range", "entropy_coef", "threshold")


def scheduled(
    config: Config, first: Mapping[str, Any], used: Any, steps: Any, coming: int
) -> dict[str, Any]:
    """Computes the hyperparameters that have a schedule, of one iteration.

    Schedules cover the budget behind `schedule_start`; before it they are at their beginning.

    Args:
      first: their values before their schedules.
      used: how many of the budget's `steps` are used; numbers, or arrays `[]` on the device.
      coming: steps of the budget that one rollout takes; at the end of it counts the warm-up.
    """
    if start := config.schedule_start:
        used, steps = used - least(used, start), steps - start
    left = 1.0 - used / steps
    found = {}
    for name in SCHEDULED:
        schedule = getattr(config, f"{name}_schedule")
        if name == "learning_rate" and config.warmup:
            rise = least((used + coming) / (config.warmup * steps), 1.0)
            after = least(left / (1.0 - config.warmup), 1.0)
            found[name] = shaped(first[name] * rise, schedule, after, f"{name}_schedule")
        else:
            found[name] = shaped(first[name], schedule, left, f"{name}_schedule")
    return found


def shaped(value: Any, schedule: str, left: Any, field: str = "schedule") -> Any:
    """The value of a hyperparameter, when the share `left` of the budget is left.

    Args:
      schedule: a name, or `module:function` from progress in [0, 1] to a factor.
      field: names the schedule in messages.
    """
    if schedule in ("constant", "kl"):
        return value
    if schedule in ("linear", "falling"):
        return value * left
    if schedule == "rising":
        return value * (1.0 - left)
    if schedule == "cosine":
        cos = jnp.cos if isinstance(left, jax.Array) else np.cos
        return value * (0.5 * (1.0 + cos(np.pi * (1.0 - left))))
    return value * import_name(field, schedule)(1.0 - left)


def least(one: Any, other: Any) -> Any:
    """The smaller of two numbers, or of arrays `[]`."""
    minimum = jnp.minimum if isinstance(one, jax.Array) else min
    return minimum(one, other)


def check_schedules(config: Config) -> None:
    """Tries the schedules that are the user's own, as training will call them.

    Raises:
      BadInput: one raises an exception, or gives no finite number of at least 0.
    """
    for name in SCHEDULED:
        schedule = getattr(config, f"{name}_schedule")
        if ":" not in schedule:
            continue
        field = f"{name}_schedule"
        function = import_name(field, schedule)
        try:
            if config.backend == "device":
                number: Any = jax.ShapeDtypeStruct((), jnp.float32)
                found = jax.eval_shape(lambda x, f=function: jnp.asarray(f(x), jnp.float32), number)
                if found.shape != ():
                    raise TypeError(f"gives shape {found.shape} instead of a number")
            for progress in (0.0, 0.25, 0.5, 0.75, 1.0):
                factor = float(function(progress))
                if not (np.isfinite(factor) and factor >= 0):
                    raise ValueError(f"gives {factor} at progress {progress}")
        except Exception as error:  # a user's function fails in its own way
            hint = "; on the device it is compiled: jnp.where in place of if"
            text = one_line(error)[:160] + hint * ("Tracer" in type(error).__name__)
            raise BadInput(f"{field}: {schedule} cannot be used: {text}") from error
