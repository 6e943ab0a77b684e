"""What every environment on the accelerator is, and many of them stepped together.

A backend gives one environment as a pair of pure functions. It never resets by itself: the next
episode is begun here, once for all backends, so that none of them can lose the observation that
an episode ended with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sauna.envs.info import is_metric_name, is_one_number, numbers_of

State = Any  # a pytree of arrays; whatever is random in an environment keeps its key in there


class Transition(NamedTuple):
    """One env step of one environment."""

    state: State
    observation: Array  # [*obs] that this very step reached, also where the episode ended
    reward: Array  # [] float32
    terminated: Array  # [] bool
    truncated: Array  # [] bool: a time limit, and not terminated
    # Numbers [] by name, the same names always: where an episode ends they become metrics.
    info: Any = ()


def numbers_in(info: Any) -> dict[str, Array]:
    """The single numbers `[]` of a `Transition.info`, as float32; what else it holds is left out.

    What is no number would not pass through a compiled function.
    """
    found: dict[str, Array] = {}
    for name, value in dict(info).items():
        if not isinstance(value, Array):  # known when compiled
            found |= {n: jnp.float32(number) for n, number in numbers_of({name: value}).items()}
        elif is_metric_name(name) and is_one_number(value):
            found[name] = value.astype(jnp.float32).reshape(())
    return found


class JaxEnv(NamedTuple):
    """An environment as `reset(key) -> (state, observation)` and `step(state, action)`.

    Both are pure and can be compiled and vmapped; the state has the same structure, shapes and
    dtypes always. A time limit is the environment's own: it counts in its state and says
    `truncated`.

    Attributes:
      reset: `key -> (state, observation)`, the observation as its space has it.
      step: `(state, action) -> Transition`; actions arrive as the action space has them.
      observation_space, action_space: Gymnasium spaces.
      render: `state -> image [H, W, 3] uint8` on the host, where there is one.
      frames_per_second: of `render`'s pictures, one per env step.
      action_mask: `state -> mask`, 1 or True for each choice of a Discrete or MultiDiscrete action
        (one component after the other) that is valid there; at least one of each component.
    """

    reset: Callable[[Array], tuple[State, Array]]
    step: Callable[[State, Array], Transition]
    observation_space: Any
    action_space: Any
    render: Callable[[State], Any] | None = None
    frames_per_second: float = 30.0
    action_mask: Callable[[State], Array] | None = None


def ended_where_broken(transition: Transition) -> Transition:
    """A simulation whose numbers are not finite any more ends its episode, with zeros to see.

    For physics alone, where that is a known end; other environments are reported as faulty.
    """
    is_finite = jnp.all(jnp.isfinite(transition.observation)) & jnp.isfinite(transition.reward)
    terminated = transition.terminated | ~is_finite
    return transition._replace(
        observation=jnp.where(is_finite, transition.observation, 0.0),
        reward=jnp.where(is_finite, transition.reward, 0.0),
        terminated=terminated,
        truncated=transition.truncated & ~terminated,
    )


class Running(NamedTuple):
    """N environments in the middle of their episodes."""

    state: State  # [N, ...]
    observation: Array  # [N, *obs] what the policy sees next
    episode: Array  # [N] int32, 0, 1, ...
    first: Any  # (state, observation) that `reset="cached"` returns to, else ()


def flat(env: JaxEnv, rescale: bool = False, masked: bool = False) -> JaxEnv:
    """`env` with the arrays that the learner has: observations `[*Spaces.observation_shape]`,
    actions `[A]`, which are clipped (or stretched: `rescale`) here and nowhere else.

    Args:
      masked: the mask is a part of the observation.
    """
    write = _writer(env.action_space, rescale)
    read = _masked_reader(env) if masked else _without_mask(_reader(env.observation_space))

    def reset(key: Array) -> tuple[State, Array]:
        state, observation = env.reset(key)
        return state, read(state, observation, False)

    def step(state: State, action: Array) -> Transition:
        transition = env.step(state, write(action))
        ended = transition.terminated | transition.truncated
        return transition._replace(
            observation=read(transition.state, transition.observation, ended),
            reward=jnp.asarray(transition.reward, jnp.float32),
            truncated=transition.truncated & ~transition.terminated,
            info=numbers_in(transition.info),
        )

    return env._replace(reset=reset, step=step)


def _without_mask(read: Callable[[Any], Array]) -> Callable[[State, Any, Any], Array]:
    return lambda state, observation, ended: read(observation)


def _masked_reader(env: JaxEnv) -> Callable[[State, Any, Any], Array]:
    """Of the observation and the mask, side by side.

    Where an episode ends every action counts as valid. A mask that leaves a component no valid
    action becomes NaN, which is reported.
    """
    from sauna.envs.masked import choices

    packed, mask_of = _packed_reader(env.observation_space), env.action_mask
    sizes = choices(env.action_space)
    splits = np.cumsum(sizes)[:-1]
    assert mask_of is not None

    def read(state: State, observation: Any, ended: Any) -> Array:
        mask = (jnp.asarray(mask_of(state)).reshape(-1) != 0) | jnp.asarray(ended)
        if mask.shape != (sum(sizes),):
            raise ValueError(f"its action mask has {mask.size} entries instead of {sum(sizes)}")
        has_valid = jnp.stack([part.any() for part in jnp.split(mask, splits)]).all()
        numbers, pictures = packed(observation)
        return jnp.concatenate([numbers, jnp.where(has_valid, mask, jnp.nan), pictures])

    return read


def _packed_reader(space: Any) -> Callable[[Any], tuple[Array, Array]]:
    """Of an observation of several parts: its numbers, and its pictures' bytes as numbers."""
    from sauna.envs.pictures import is_picture
    from sauna.envs.shapes import leaves, part_at
    from sauna.envs.spaces import describe_observation

    parts = list(leaves(space))
    whole = describe_observation(space)[0] == "image"
    readers = [
        (path, whole or is_picture(part), _reader(part) if whole else _part_reader(part))
        for path, part in parts
    ]
    empty = jnp.zeros(0, jnp.float32)

    def read(observation: Any) -> tuple[Array, Array]:
        found: tuple[list[Array], list[Array]] = ([empty], [empty])
        for path, as_picture, reader in readers:
            part = reader(part_at(observation, path))
            found[as_picture].append(jnp.asarray(part, jnp.float32).reshape(-1))
        return jnp.concatenate(found[0]), jnp.concatenate(found[1])

    return read


def _reader(space: Any) -> Callable[[Any], Array]:
    """The device's twin of `spaces.observation_reader`."""
    from gymnasium import spaces as gym

    from sauna.envs.pictures import is_picture
    from sauna.envs.shapes import leaves
    from sauna.envs.spaces import PICTURES, describe_observation

    if isinstance(space, gym.Discrete):
        return lambda x: jax.nn.one_hot(x - space.start, int(space.n))
    if isinstance(space, gym.MultiDiscrete):
        return _reader_of_choices(space)
    if any(path and is_picture(part) for path, part in leaves(space)):
        packed = _packed_reader(space)
        return lambda x: jnp.concatenate(packed(x))
    if isinstance(space, gym.Dict | gym.Tuple):
        parts = space.spaces.items() if isinstance(space, gym.Dict) else enumerate(space.spaces)
        readers = {name: _part_reader(part) for name, part in parts}
        return lambda x: jnp.concatenate([read(x[name]) for name, read in readers.items()])
    kind, shape = describe_observation(space)
    if kind in PICTURES:
        if shape != space.shape and len(space.shape) == 3:
            return lambda image: jnp.moveaxis(image, 0, -1)
        return lambda image: image.reshape(shape)
    return lambda x: jnp.asarray(x, jnp.float32).reshape(-1)


def _part_reader(space: Any) -> Callable[[Any], Array]:
    """Of a part of a Dict or Tuple, where also small boards become numbers of a vector."""
    from gymnasium import spaces as gym

    from sauna.envs.pictures import is_picture

    if isinstance(space, gym.Box | gym.MultiBinary) and not is_picture(space):
        return lambda x: jnp.asarray(x, jnp.float32).reshape(-1)
    return _reader(space)


def _reader_of_choices(space: Any) -> Callable[[Any], Array]:
    """Of several choices: their one-hots, one after the other."""
    sizes, starts = space.nvec.ravel(), np.broadcast_to(space.start, space.nvec.shape).ravel()

    def read(x: Any) -> Array:
        chosen = jnp.asarray(x).reshape(-1) - starts
        return jnp.concatenate([jax.nn.one_hot(chosen[i], int(n)) for i, n in enumerate(sizes)])

    return read


def _writer(space: Any, rescale: bool) -> Callable[[Array], Any]:
    """The device's twin of `actions.action_writer`."""
    from gymnasium import spaces as gym

    from sauna.envs.actions import stretch

    if isinstance(space, gym.Box):
        low, high = space.low.ravel(), space.high.ravel()
        stretched = stretch(space) if rescale else None
        if stretched is not None:
            bounded, center, half = (jnp.asarray(x) for x in stretched)

            def write(action: Array) -> Array:
                inner = jnp.where(bounded, jnp.clip(action, -1.0, 1.0), action)
                moved = (center + half * inner).astype(action.dtype)
                return jnp.clip(moved, low, high).reshape(space.shape)

            return write
        return lambda action: jnp.clip(action, low, high).reshape(space.shape)
    if isinstance(space, gym.Discrete):
        return lambda action: action[0] + int(space.start)
    return lambda action: action + np.asarray(getattr(space, "start", 0))


def begin(env: JaxEnv, key: Array, number: int, *, cached: bool) -> Running:
    """Episode 0 of `number` environments; environment n depends on `key` and n alone."""
    episode = jnp.zeros(number, jnp.int32)
    state, observation = jax.vmap(env.reset)(_episode_keys(key, episode))
    return Running(state, observation, episode, (state, observation) if cached else ())


def _episode_keys(key: Array, episode: Array) -> Array:
    own = jax.vmap(lambda n: jax.random.fold_in(key, n))(jnp.arange(len(episode)))
    return jax.vmap(jax.random.fold_in)(own, episode)


def advance(
    env: JaxEnv,
    running: Running,
    action: Array,
    acting: Array,
    key: Array,
    any_member: Callable[[Array], Array],
) -> tuple[Running, Transition]:
    """One env step of the acting environments; where an episode ends, the next one begins.

    Args:
      action: `[N, A]`; acting: `[N]` bool, the others stay where they are.
      key: the one given to `begin`; episode e of environment n is reset with a key made of it, n
        and e. Not read with cached resets, which return to the environment's first state.
      any_member: `bool -> bool`, whether it holds in any member that is compiled together with this
        one: then alone is the reset computed.

    Returns:
      the environments, and what the step gave (`Transition` of `[N]`; rows that did not act are
      meaningless but for their `terminated` and `truncated`, which are False).
    """
    transition = jax.vmap(env.step)(running.state, action)
    terminated = transition.terminated & acting
    truncated = transition.truncated & acting
    ended = terminated | truncated
    episode = running.episode + ended
    reached = (transition.state, transition.observation)

    def fresh() -> tuple[State, Array]:
        return jax.vmap(env.reset)(_episode_keys(key, episode))

    if running.first:
        start = _with_new_keys(running.first, episode)
    else:
        start = jax.lax.cond(any_member(jnp.any(ended)), fresh, lambda: reached)
    now = (running.state, running.observation)
    state, observation = _where(acting, _where(ended, start, reached), now)
    transition = transition._replace(terminated=terminated, truncated=truncated)
    return Running(state, observation, episode, running.first), transition


def _with_new_keys(first: Any, episode: Array) -> Any:
    """A cached start whose random keys are this episode's own: only the start is repeated."""

    def renew(leaf: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return leaf
        return jax.vmap(jax.random.fold_in)(leaf, episode)

    return jax.tree.map(renew, first)


def _where(mask: Array, yes: Any, no: Any) -> Any:
    """`yes` where `mask` `[N]`, leaf by leaf."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, yes, no)
