"""The whole state of a member as named arrays, and back.

Everything that a resumed run needs is here or follows from the seed and the iteration: JAX keys
are folded from them, environments are replayed from their episode's seed and actions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from sauna.algorithm.policy.normalize import Moments
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.collected import Collected
from sauna.algorithm.types import Replay, Rollout, TrainState
from sauna.envs.host.contract import HostEnvs
from sauna.system.checkpoint import BadCheckpoint, under
from sauna.system.errors import SaunaError
from sauna.training.summary import WINDOW

if TYPE_CHECKING:  # it imports Numba, which a training on the device does not need
    from sauna.algorithm.rollout.host import HostCollector


class NotRestored(SaunaError):
    """An environment did not come back to where the checkpoint says it was."""


@dataclass
class Counters:
    """What a member has done so far."""

    env_steps: int = 0
    kept_steps: int = 0
    episodes: int = 0
    recent_returns: list[float] = field(default_factory=list)  # of the last `WINDOW` episodes
    reported_returns: list[float] = field(default_factory=list)  # those that ended on a kept step
    stopped: int = 0  # why the member was stopped early: its index in `STOPS`

    def add(self, collected: Collected) -> None:
        self.env_steps += collected.env_steps
        self.kept_steps += collected.kept_steps
        self.episodes += collected.ended
        returns = [episode.return_ for episode in collected.episodes]
        reported = [episode.return_ for episode in collected.episodes if episode.kept]
        self.recent_returns = (self.recent_returns + returns)[-WINDOW:]
        self.reported_returns = (self.reported_returns + reported)[-WINDOW:]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Named as in a checkpoint; `stopped` is there only if the member was."""
        return {
            f"counters/{key}": np.asarray(
                value, np.float64 if isinstance(value, list) else np.int64
            )
            for key, value in dataclasses.asdict(self).items()
            if key != "stopped" or value
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Counters:
        """The inverse of `to_arrays`."""
        names = [part.name for part in dataclasses.fields(cls)]
        if "counters/stopped" not in arrays:
            names.remove("stopped")
        return cls(**{name: arrays[f"counters/{name}"].tolist() for name in names})


def named_params(policy: Policy, params: jax.Array) -> dict[str, np.ndarray]:
    """The flat parameters as arrays named by their place in the network."""
    return {name: np.asarray(leaf) for name, leaf in _named(policy.unravel(params)).items()}


def _named(tree: Any) -> dict[str, Any]:
    return {
        "/".join(str(key.key) for key in path if key.key != "params"): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def flat_params(policy: Policy, example: Any, named: Mapping[str, np.ndarray]) -> jax.Array:
    """The inverse of `named_params`; `example` has the shape and type of a parameter vector.

    Memory is taken for what is stored, not for what the policy would need.

    Raises:
      BadCheckpoint: an array is missing, or of another shape or type.
    """
    tree = jax.eval_shape(policy.unravel, example)
    structure = jax.tree_util.tree_structure(tree)
    leaves = [jnp.asarray(fitting(named, name, leaf)) for name, leaf in _named(tree).items()]
    return ravel_pytree(jax.tree_util.tree_unflatten(structure, leaves))[0]


def fitting(stored: Mapping[str, np.ndarray], name: str, place: Any) -> np.ndarray:
    """A stored array, if it is there and fits where it belongs.

    Raises:
      BadCheckpoint: it is missing, or of another shape or type.
    """
    array = stored.get(name)
    if array is None or (array.shape, array.dtype) != (place.shape, place.dtype):
        found = "missing" if array is None else f"{array.dtype}{list(array.shape)}"
        expected = f"{place.dtype}{list(place.shape)}"
        raise BadCheckpoint(f"checkpoint: {name} is {found}; this network and run need {expected}")
    return array


def pack_member(
    name: str,
    p: int,
    state: TrainState,
    counters: Counters,
    policy: Policy,
    collector: HostCollector,
    envs: HostEnvs,
) -> dict[str, np.ndarray]:
    """Member `p`'s state, every name starting with the member's."""
    arrays = named_learner(policy, state) | counters.to_arrays()
    for key, value in (moments_of(collector, p) | collected_of(collector, p)).items():
        arrays[key] = value
    number = collector.state.episode_length.shape[1]
    for n in range(number):
        for key, value in envs.snapshot(p * number + n).items():
            arrays[f"envs/{n}/{key}"] = value
    return {f"{name}/{key}": np.array(value) for key, value in arrays.items()}


def named_learner(policy: Policy, state: TrainState) -> dict[str, np.ndarray]:
    """What learning changes, as named arrays."""
    arrays = {f"params/{key}": value for key, value in named_params(policy, state.params).items()}
    arrays |= named_optimizer(state) | named_sampler(state) | named_replay(state)
    if moves_rate_in(state):
        arrays["learning_rate"] = np.asarray(state.learning_rate)
    return arrays


def unpack_learner(
    policy: Policy, own: Mapping[str, np.ndarray], example: TrainState
) -> TrainState:
    """The inverse of `named_learner`.

    Raises:
      BadCheckpoint: an array is missing, or of another shape or type.
    """
    rate = example.learning_rate
    if moves_rate_in(example):
        rate = jnp.asarray(fitting(own, "learning_rate", rate))
    params = flat_params(policy, example.params, under("params/", own))
    return TrainState(
        params,
        unpack_optimizer(own, example),
        unpack_sampler(own, example),
        rate,
        unpack_replay(own, example),
    )


def moves_rate_in(state: TrainState) -> bool:
    """Returns whether a state carries a learning rate."""
    return not isinstance(state.learning_rate, tuple)


def named_optimizer(state: TrainState) -> dict[str, np.ndarray]:
    """The optimizer's state as arrays, in its own order."""
    optimizer = state.optimizer
    if isinstance(optimizer, optax.ScaleByRmsState):
        named = {"rmsprop/mean_square": optimizer.nu}
    elif isinstance(optimizer, optax.ScaleByAdamState):
        named = {
            "adam/count": optimizer.count,
            "adam/mean": optimizer.mu,
            "adam/variance": optimizer.nu,
        }
    else:
        leaves = jax.tree_util.tree_leaves(optimizer)
        named = {f"optimizer/{i}": leaf for i, leaf in enumerate(leaves)}
    return {name: np.asarray(array) for name, array in named.items()}


def named_sampler(state: TrainState) -> dict[str, np.ndarray]:
    """What a selection rule carries from one iteration to the next, in its own order."""
    leaves = jax.tree_util.tree_leaves(state.sampler)
    return {f"sampler/{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}


def unpack_sampler(own: Mapping[str, np.ndarray], example: TrainState) -> Any:
    """The inverse of `named_sampler`.

    Raises:
      BadCheckpoint: an array is missing, or of another shape or type.
    """
    structure = jax.tree_util.tree_structure(example.sampler)
    named = named_sampler(example)
    leaves = [jnp.asarray(fitting(own, name, place)) for name, place in named.items()]
    return jax.tree_util.tree_unflatten(structure, leaves)


def named_replay(state: TrainState) -> dict[str, np.ndarray]:
    """The rollouts that the update learns from again, as named arrays."""
    if not isinstance(state.replay, Replay):
        return {}
    parts = {**state.replay.rollouts._asdict(), "number": state.replay.number}
    return {
        f"replay/{name}": np.asarray(array) for name, array in parts.items() if array is not None
    }


def unpack_replay(own: Mapping[str, np.ndarray], example: TrainState) -> Any:
    """The inverse of `named_replay`.

    Raises:
      BadCheckpoint: an array is missing, or of another shape or type.
    """
    if not isinstance(example.replay, Replay):
        return ()
    named = named_replay(example)
    found = {
        name.removeprefix("replay/"): jnp.asarray(fitting(own, name, place))
        for name, place in named.items()
    }
    number = found.pop("number")
    return Replay(Rollout(**found), number)


def unpack_optimizer(own: Mapping[str, np.ndarray], example: TrainState) -> Any:
    """The inverse of `named_optimizer`.

    Raises:
      BadCheckpoint: an array is missing, or of another shape or type.
    """
    structure = jax.tree_util.tree_structure(example.optimizer)
    named = named_optimizer(example)
    leaves = [jnp.asarray(fitting(own, name, place)) for name, place in named.items()]
    return jax.tree_util.tree_unflatten(structure, leaves)


def unpack_member(
    name: str,
    p: int,
    arrays: Mapping[str, np.ndarray],
    example: TrainState,
    policy: Policy,
    collector: HostCollector,
    envs: HostEnvs,
    replay: bool,
) -> tuple[TrainState, Counters]:
    """Puts member `p` of the collector and its environments back; its learning state.

    Without `replay` each environment starts the episode after the one it was in.

    Raises:
      NotRestored: a replayed environment shows another observation than the stored one.
    """
    own = under(name + "/", arrays)
    state = unpack_learner(policy, own, example)
    counters = Counters.from_arrays(own)
    for key, place in moments_of(collector, p).items():
        place[...] = fitting(own, key, place)
    if replay:
        for key, place in collected_of(collector, p).items():
            place[...] = fitting(own, key, place)
    collect = collector.state
    number = len(collect.observation[p])
    for n in range(number):
        snapshot = under(f"envs/{n}/", own)
        if replay:
            seen = envs.restore(p * number + n, snapshot)
            _check_replayed(name, n, collect.observation[p, n], seen)
        else:
            collect.observation[p, n] = envs.start_after(p * number + n, snapshot)
    return state, counters


def moments_of(collector: HostCollector, p: int) -> dict[str, np.ndarray]:
    """Views of member `p`'s running moments, by their names in a checkpoint."""
    parts = {"reward_moments": Moments(*(part[p] for part in collector.reward_moments))}
    if collector.observation_moments is not None:
        parts["observation_moments"] = collector.observation_moments.of(p)
    return {
        f"{kind}/{name}": value
        for kind, moments in parts.items()
        for name, value in moments._asdict().items()
    }


def collected_of(collector: HostCollector, p: int) -> dict[str, np.ndarray]:
    """Views of what member `p` carries from one rollout to the next, by their names."""
    carried = collector.state._asdict().items()
    return {f"collect/{key}": x[p] for key, x in carried if not isinstance(x, tuple)}


def _check_replayed(name: str, n: int, stored: np.ndarray, seen: np.ndarray) -> None:
    if not np.array_equal(seen, stored):
        raise NotRestored(
            f"{name}: environment {n} is not deterministic: replaying its episode ended at "
            f"another observation than the checkpoint's; resume with --inexact to start new "
            f"episodes instead"
        )
