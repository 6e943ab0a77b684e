"""Policies with random weights, and their exported forms, for tests of these."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from safetensors.numpy import save

from helpers import configured
from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.algorithm.policy.normalize import Moments
from sauna.algorithm.policy.policy import Policy
from sauna.envs.masked import MASK, MaskedSpace
from sauna.envs.spaces import describe
from sauna.experiments.share.graph import Graph
from sauna.experiments.share.numpy_file import to_numpy
from sauna.experiments.share.policy_graph import policy_graph
from sauna.experiments.share.same import numpy_policy
from sauna.training.loop.member_state import named_params


def made(observed: Any, acted: Any, settings: dict[str, Any]) -> tuple[FrozenPolicy, Graph]:
    """A policy for observations and actions, and its graph; `normalize` stands for its field."""
    settings = {"hidden": (16, 8), "network": "mlp", "rescale_actions": False, **settings}
    settings["normalize_observations"] = settings.pop("normalize", False)
    config = dataclasses.replace(configured(), **settings)
    spaces, random = describe(observed, acted), np.random.default_rng(0)
    env = SimpleNamespace(observation_space=observed, action_space=acted)
    policy = FrozenPolicy(config, spaces, env)
    moments = None
    if config.normalize_observations:
        length = spaces.normalized
        variance = random.uniform(0.1, 3, length)
        moments = Moments(random.standard_normal(length), variance, np.ones(1))
    policy.load(_random_params(policy.policy, random), moments)
    arrays = {f"params/{k}": v for k, v in named_params(policy.policy, policy.params).items()}
    if moments is not None:
        arrays |= {f"observation_moments/{k}": v for k, v in moments._asdict().items()}
    return policy, policy_graph(config, arrays, observed, acted)


def _random_params(policy: Policy, random: np.random.Generator) -> np.ndarray:
    """Parameters `[D]` with which no layer's outputs are much larger than its inputs."""
    size = jax.eval_shape(policy.init, jax.random.key(0)).size
    shapes = [leaf.shape for leaf in jax.tree.leaves(policy.unravel(np.zeros(size, np.float32)))]
    parts = [
        min(0.3, math.prod(shape[:-1]) ** -0.5) * random.standard_normal(math.prod(shape))
        for shape in shapes
    ]
    return np.concatenate(parts).astype(np.float32)


def sampled(space: Any, number: int) -> list[Any]:
    """As many random observations; a mask leaves each component of the action a choice."""
    space.seed(0)
    found = [space.sample() for _ in range(number)]
    if isinstance(space, MaskedSpace):
        starts = np.cumsum((0, *space.sizes))[:-1]
        for mask in (one[MASK] for one in found):
            mask[starts[np.maximum.reduceat(mask, starts) == 0]] = 1
    return found


def numpy_file(graph: Graph, folder: Path) -> Callable[[Any], Any]:
    """Writes the numpy form into a folder, and opens it."""
    (folder / "policy.safetensors").write_bytes(save(graph.constants))
    (folder / "policy.py").write_text(to_numpy(graph, "A policy."))
    return numpy_policy(folder / "policy.py", graph)
