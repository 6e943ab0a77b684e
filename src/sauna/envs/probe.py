"""What is learned of an environment before a run starts: its spaces, and whether it repeats."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sauna.envs.host.answers import close, first_of, five_of, life_lost, one_number
from sauna.envs.host.parallel_envs import AgentsAsOne
from sauna.envs.host.together import group_size, may_wait
from sauna.envs.make import make_env
from sauna.envs.masked import mask_method
from sauna.envs.shapes import check_shapes, mask_in
from sauna.envs.spaces import Spaces, describe, observation_reader
from sauna.envs.wrapping import PLAIN, Wrapping, wrapped_space
from sauna.system.errors import BadInput, one_line

STEPS = 25


class Probe(NamedTuple):
    """What is known of an environment.

    Attributes:
      spaces: its spaces.
      differs: None where it gave the same episode twice.
      group: rows that stand together (0: any number); None if each environment stands alone.
      may_wait: whether a row may have to wait until its next episode begins.
      time_limit: env steps after which Gymnasium cuts an episode; None if it says no number.
    """

    spaces: Spaces
    differs: str | None
    time_limit: int | None = None
    group: int | None = None
    may_wait: bool = False


def probe(env: str, env_kwargs: dict[str, Any], wrapping: Wrapping = PLAIN) -> Probe:
    """Makes the environment twice and plays the same seed and actions in both.

    One of the two has played another episode before, so that a state which survives a reset is
    seen too.

    Raises:
      BadInput: the environment cannot be made or played, or its spaces are not supported.
    """
    first, second = (make_env(env, env_kwargs, wrapping) for _ in range(2))
    try:
        spaces = describe(first.observation_space, first.action_space)
        limit = getattr(getattr(first, "spec", None), "max_episode_steps", None)
        group, waits = group_size(first), may_wait(first)
        _play(first, spaces, seed=1)
        differs = _difference(_play(first, spaces, seed=2), _play(second, spaces, seed=2))
    except BadInput:
        raise
    except Exception as error:  # whatever a user's environment raises when played
        masked = not wrapping.action_mask and mask_method(first) is not None
        hint = "; it has action_masks(): give --action-mask" if masked else ""
        raise BadInput(f"env: {env} cannot be played: {one_line(error)}{hint}") from error
    finally:
        close(first)
        close(second)
    if group == 0:
        differs = differs or "a vector environment cannot be brought back row by row"
    return Probe(spaces, differs, limit if isinstance(limit, int) else None, group, waits)


def probe_on_device(env: str, env_kwargs: dict[str, Any], wrapping: Wrapping = PLAIN) -> Probe:
    """The spaces of an environment on the device, which repeats itself by construction.

    Raises:
      BadInput: the environment cannot be made, its spaces are not supported, or it is a user's own
        and cannot be compiled.
    """
    from sauna.envs.device.make import make_jax_env

    made = make_jax_env(env, env_kwargs)
    spaces = describe(wrapped_space(made, wrapping), made.action_space)
    if spaces.mask and made.action_mask is None:
        raise BadInput("action_mask: the environment gives none (JaxEnv.action_mask)")
    if ":" in env:
        _check_traced(env, made, spaces, wrapping)
    return Probe(spaces, None)


def _check_traced(env: str, made: Any, spaces: Spaces, wrapping: Wrapping) -> None:
    """Traces a reset and a step, which compiles and computes nothing.

    Raises:
      BadInput: they raise, or give other arrays than `JaxEnv` says.
    """
    import jax

    from sauna.envs.device.contract import flat
    from sauna.envs.device.stacked import stacked

    made = stacked(_with_checked_shapes(made), wrapping.stack)
    one = flat(made, masked=wrapping.action_mask)
    action = jax.ShapeDtypeStruct((spaces.action_width,), spaces.action_dtype)
    try:
        state, first = jax.eval_shape(lambda: one.reset(jax.random.key(0)))
        transition = jax.eval_shape(one.step, state, action)
    except Exception as error:  # whatever a user's environment raises when traced
        raise BadInput(f"env: {env} cannot be played: {one_line(error)}") from error
    once = {
        "observation": spaces.observation_shape,
        "reward": (),
        "terminated": (),
        "truncated": (),
    }
    for name, shape in once.items():
        if getattr(transition, name).shape != shape or (
            name == "observation" and first.shape != shape
        ):
            raise BadInput(f"env: {env}: its {name} is not of shape {shape}")
    if _arrays(transition.state) != _arrays(state):
        raise BadInput(f"env: {env}: its state has other arrays after a step than after a reset")


def _with_checked_shapes(env: Any) -> Any:
    """The environment on the device, which raises if its observations are not of its space."""

    def reset(key: Any) -> Any:
        state, observation = env.reset(key)
        check_shapes(env.observation_space, observation)
        return state, observation

    def step(state: Any, action: Any) -> Any:
        transition = env.step(state, action)
        check_shapes(env.observation_space, transition.observation)
        return transition

    return env._replace(reset=reset, step=step)


def _arrays(tree: Any) -> Any:
    """The structure of a pytree, and its leaves' shapes and types."""
    import jax

    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def _play(env: Any, spaces: Spaces, seed: int) -> list[tuple[np.ndarray, float, bool]]:
    """`STEPS` steps of random actions: `(observation, reward, ended)` of each."""
    reader = observation_reader(env.observation_space)
    agents = isinstance(env, AgentsAsOne)

    def read(observation: Any) -> np.ndarray:
        if agents:
            return np.stack([reader(one) for one in env.rows(observation)])
        found = np.array(reader(observation))
        if found.shape != spaces.observation_shape:
            raise ValueError(
                f"it says that observations are of shape {spaces.observation_shape}, "
                f"and gives {found.shape}"
            )
        return found

    env.action_space.seed(seed)
    observation = first_of(env.reset(seed=seed))
    seen = [(read(observation), 0.0, False)]
    for _ in range(STEPS):
        observation, reward, terminated, truncated, info = five_of(
            env.step(any_action(env, observation))
        )
        life_lost(info)  # raises where it cannot be read
        seen.append((read(observation), one_number(reward), bool(terminated or truncated)))
        if seen[-1][2]:
            break
    return seen


def any_action(env: Any, observation: Any) -> Any:
    """Draws an action, a valid one if the observation holds a mask; of agents one for each."""
    if isinstance(env, AgentsAsOne):
        return env.sample()
    if not mask_in(env.observation_space)[0]:
        return env.action_space.sample()
    from sauna.envs.masked import sample_valid

    return sample_valid(env.action_space, observation["action_mask"])


def each_observation(env: Any, observation: Any) -> list[Any]:
    """The observation, or that of each agent that is there."""
    return env.rows(observation) if isinstance(env, AgentsAsOne) else [observation]


def _difference(
    one: list[tuple[np.ndarray, float, bool]], other: list[tuple[np.ndarray, float, bool]]
) -> str | None:
    for step, (a, b) in enumerate(zip(one, other, strict=False)):
        if not np.array_equal(a[0], b[0], equal_nan=True):
            return f"observations differ at step {step} of an episode played twice"
        if a[1:] != b[1:]:
            return f"rewards or episode ends differ at step {step} of an episode played twice"
    return None
