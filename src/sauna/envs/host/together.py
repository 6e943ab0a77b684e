"""Environments that step several rows at once, by name.

    make_vec/CartPole-v1               gymnasium.make_vec
    envpool/Pendulum-v1                EnvPool (extra `envpool`)
    pettingzoo/sisl/pursuit_v5         a parallel environment of PettingZoo (extra `pettingzoo`)
    module:function(num_envs, ...)     of a user's, that gives a gymnasium.vector.VectorEnv
    module:function(...)               of a user's, that gives a parallel environment

`plain_maker` makes the plain form of one, in which evaluations play; `rows_of` its training form.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Callable, Sequence
from typing import Any

from sauna.envs.host.grouped_envs import GroupedEnvs
from sauna.envs.host.parallel_envs import AgentsAsOne, ParallelEnvs
from sauna.envs.host.vector_envs import OneRow, VectorEnvs
from sauna.system.errors import BadInput

PREFIXES = ("make_vec", "envpool", "pettingzoo")

Make = Callable[..., Any]


def is_known(env: str) -> bool:
    """Whether a name says by its beginning that it steps several rows at once."""
    return env.partition("/")[0] in PREFIXES


def maker_of(env: str) -> Make:
    """The function behind a name that `is_known`: it takes `num_envs`, but for agents.

    Raises:
      BadInput: there is no such environment, or its package is not installed.
    """
    package, _, name = env.partition("/")
    if package == "make_vec":
        return _make_vec(name)
    if importlib.util.find_spec(package) is None:
        raise BadInput(f"env: {env} needs `pip install 'sauna-rl[{package}]'`")
    if package == "envpool":
        from sauna.envs.host.envpool_envs import make_envpool

        return make_envpool(name)
    path = f"pettingzoo.{name.replace('/', '.')}"
    try:
        return importlib.import_module(path).parallel_env
    except (ImportError, AttributeError) as error:
        raise BadInput(
            f"env: {env} is no parallel environment of PettingZoo: {error}; write "
            "pettingzoo/FAMILY/NAME_vN"
        ) from error


def _make_vec(name: str) -> Make:
    import gymnasium

    if name.rpartition(":")[2] not in gymnasium.registry and ":" not in name:
        raise BadInput(f"env: Gymnasium knows no {name!r}, which make_vec/ is to make")

    def make(num_envs: int, **kwargs: Any) -> Any:
        spec = gymnasium.spec(name)
        mode = kwargs.get("vectorization_mode")
        if mode not in (None, "vector_entry_point") or spec.vector_entry_point is None:
            ours = {"autoreset_mode": "SameStep"}
            if mode == "async":
                ours["context"] = "spawn"  # to fork beside JAX's threads may hang
            kwargs["vector_kwargs"] = {**ours, **(kwargs.get("vector_kwargs") or {})}
        return gymnasium.make_vec(name, num_envs=num_envs, **kwargs)

    return make


def takes_number(function: Make) -> bool:
    """Whether a function says by a parameter `num_envs` that it gives a vector environment."""
    try:
        return "num_envs" in inspect.signature(function).parameters
    except (TypeError, ValueError):  # of a builtin
        return False


def is_vector(env: Any) -> bool:
    """Whether it is a vector environment."""
    return hasattr(env, "single_observation_space") and hasattr(env, "num_envs")


def plain_maker(function: Make, kwargs: dict[str, Any]) -> Make:
    """What makes an environment by `function`; one of several rows in its plain form.

    A further keyword counts more than the same one among `kwargs`.
    """

    def make(**more: Any) -> Any:
        given = {**kwargs, **more}
        if takes_number(function) and "num_envs" not in given:  # else it means its own
            made = function(num_envs=1, **given)
            if is_vector(made):
                return OneRow(made)
            made.close()
        made = function(**given)
        return AgentsAsOne(made) if hasattr(made, "possible_agents") else made

    return make


def rows_of(
    function: Make,
    kwargs: dict[str, Any],
    plain: Any,
    seeds: Sequence[tuple[int, int]],
    rescale: bool,
) -> GroupedEnvs | None:
    """The training form of an environment, or None if it has no other than the plain one.

    Args:
      plain: what `plain_maker` made.
      seeds, rescale: see `in_process_envs`.
    """
    if isinstance(plain, OneRow):
        return VectorEnvs(lambda n: function(num_envs=n, **kwargs), seeds, rescale)
    if isinstance(plain, AgentsAsOne):
        return ParallelEnvs(lambda: function(**kwargs), seeds, rescale)
    return None


def group_size(plain: Any) -> int | None:
    """Rows that stand together: 0 for any number of them, None for a plain environment."""
    if isinstance(plain, OneRow):
        return 0
    return len(plain.agents) if isinstance(plain, AgentsAsOne) else None


def may_wait(plain: Any) -> bool:
    """Whether a row may have to wait until its next episode begins."""
    if isinstance(plain, OneRow):
        return plain.mode == "NEXT_STEP"
    return isinstance(plain, AgentsAsOne)
