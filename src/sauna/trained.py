"""A trained policy with everything it needs to act: parameters, frozen normaliser, spaces."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sauna import checkpoint, rundir
from sauna.config import Config
from sauna.core.normalize import Moments, normalize
from sauna.core.policy import Policy, make_policy
from sauna.envs.gymnasium import make_env
from sauna.errors import BadInput, nearest
from sauna.member_state import flat_params
from sauna.presets import stored_config
from sauna.spaces import Spaces, action_writer, describe, observation_reader, read_spaces


class Artifact(NamedTuple):
    """The newest good checkpoint of a run and what it is of."""

    config: Config
    spaces: Spaces
    members: list[str]
    checkpoint: checkpoint.Checkpoint


def load_artifact(run: Path, warn: Any = print) -> Artifact:
    """Reads a run's newest good checkpoint.

    Raises:
      BadInput: no run there, or no checkpoint yet.
      BadCheckpoint: none of its checkpoints can be trusted.
    """
    rundir.read_config(run)
    loaded = checkpoint.load_newest(run / "checkpoints", warn)
    if loaded is None:
        raise BadInput(f"{run} has no checkpoint yet")
    spaces = read_spaces(loaded.manifest["spaces"])
    config = stored_config(loaded.manifest["config"])
    return Artifact(config, spaces, loaded.manifest["members"], loaded)


class TrainedPolicy:
    """`policy(observation) -> action` for one raw observation of the environment.

    Args:
      artifact: of the run.
      member: name (`sauna/0`) or index.
      env: an environment with the run's spaces; made and closed here if not given.

    Raises:
      BadInput: there is no such member, or `env` has other spaces than the run.
    """

    def __init__(self, artifact: Artifact, member: str | int = 0, env: Any = None) -> None:
        self.config, self.name = artifact.config, find_member(artifact.members, member)
        made = env is None
        env = env or make_env(self.config.env, json.loads(self.config.env_kwargs))
        check_spaces(artifact, env)
        self._read = observation_reader(env.observation_space)
        self._write = action_writer(env.action_space)
        if made:
            env.close()
        own = _strip(artifact.checkpoint.arrays, self.name + "/")
        self._policy: Policy = make_policy(self.config, artifact.spaces)
        example = jax.eval_shape(self._policy.init, jax.random.key(0))
        zeros = jnp.zeros(example.shape, example.dtype)
        self._params = flat_params(self._policy, zeros, _strip(own, "params/"))
        self._moments = Moments(**_strip(own, "observation_moments/"))
        self._dtype = artifact.spaces.observation_dtype
        self._act = jax.jit(self._choose, static_argnames="deterministic")

    def _choose(self, observation: Any, key: Any, *, deterministic: bool) -> Any:
        distribution = self._policy.distribution
        parameters = self._policy.apply(self._params, observation).policy
        if deterministic:
            return distribution.mode(parameters)
        return distribution.sample(parameters, distribution.draw(key, parameters.shape[:-1]))

    def __call__(self, observation: Any, *, deterministic: bool = True, key: Any = None) -> Any:
        """The action for one raw observation, clipped as the environment wants it.

        Sampled actions need a JAX `key`; the normaliser is never updated.
        """
        if not deterministic and key is None:
            raise ValueError("a sampled action needs key=jax.random.key(...)")
        seen = self._read(observation)[None]
        if self.config.normalize_observations:
            seen = normalize(self._moments, seen, self.config.clip_observations)
        key = jax.random.key(0) if key is None else key
        action = self._act(seen.astype(self._dtype), key, deterministic=deterministic)
        return self._write(np.asarray(action)[0])


def find_member(members: list[str], member: str | int) -> str:
    if isinstance(member, int) or member.isdigit():
        index = int(member)
        if not 0 <= index < len(members):
            raise BadInput(f"member: {index} is not between 0 and {len(members) - 1}")
        return members[index]
    if member not in members:
        raise BadInput(f"member: unknown member {member!r}{nearest(member, members)}")
    return member


def check_spaces(artifact: Artifact, env: Any) -> None:
    """Refuses an environment whose spaces are not the run's.

    Raises:
      BadInput: naming the space that differs.
    """
    found = describe(env.observation_space, env.action_space)
    for part in ("observation_text", "action_text"):
        ours, theirs = getattr(artifact.spaces, part), getattr(found, part)
        if ours != theirs:
            kind = part.split("_")[0]
            raise BadInput(f"env: the run's {kind} space is {ours}, this environment's {theirs}")


def _strip(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {key[len(prefix) :]: a for key, a in arrays.items() if key.startswith(prefix)}
