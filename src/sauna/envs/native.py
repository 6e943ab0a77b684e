"""Which environments run inside the compiled program. Nothing here imports JAX."""

from __future__ import annotations

import sys
from typing import Any

from sauna.config.plugins import import_name
from sauna.config.settings import NATIVE


def is_native(env: str, env_kwargs: dict[str, Any]) -> bool:
    """Whether an environment is a `JaxEnv`: it has no other place to run than the device.

    Raises:
      BadInput: it is `module:name` and that cannot be imported.
    """
    if env.split("/")[0] in NATIVE:
        return True
    if ":" not in env or "-v" in env.rpartition(":")[2]:  # a Gymnasium id, `module:Id-v0`
        return False
    thing = import_name("env", env)
    if is_jax_env(thing) or not callable(thing):
        return is_jax_env(thing)
    try:
        made = thing(**env_kwargs)
    except Exception:
        return False
    if hasattr(made, "close"):
        made.close()
    return is_jax_env(made)


def is_jax_env(thing: Any) -> bool:
    """Whether it is a `JaxEnv`; whoever made one has imported its module."""
    module = sys.modules.get("sauna.envs.jax_env")
    return module is not None and isinstance(thing, module.JaxEnv)
