"""Collecting a rollout inside the compiled program, from environments that are pure functions.

The same rollout that `rollout/host.py` fills, step by step: what is observed enters the moments
before the policy sees it, the filter decides at once, and with `dropped="replace"` the loop goes
on until every environment has kept T steps or tried all it may. Each environment writes its own
column and stops writing when it is full; what stays empty is not valid and gets weight 0.

Everything is written for one member.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sauna.algorithm.policy.bounded import to_env
from sauna.algorithm.policy.normalize import (
    LongMoments,
    initial_moments,
    long_moments,
    long_moments_after_all,
    normalize,
    scale_rewards,
    update_long_moments,
)
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.program import draw_noise
from sauna.algorithm.types import Array, Hypers, Keys, Memory, Rollout, ScoredStep, StepFilter
from sauna.config.settings import Config
from sauna.envs.device.contract import JaxEnv, Running, Transition, advance, begin

LARGEST = 1e18  # of an observation or a reward: its square is finite in float32
WINDOW = 100  # finished episodes of one iteration that are reported one by one, the latest


class CollectState(NamedTuple):
    """What one member carries from one rollout to the next."""

    envs: Running  # [N, ...]
    observation_moments: LongMoments | tuple[()]  # of [D]; () where nothing is normalised
    reward_moments: LongMoments  # of [1]
    discounted_return: Array  # [N] float32
    episode_return: Array  # [N] float32, raw rewards so far
    episode_length: Array  # [N] int32
    memory: Any = ()  # [N, H] float32, the states of a recurrent policy


class Ends(NamedTuple):
    """The episodes that ended in a rollout."""

    number: Array  # [] int32, all of them
    return_mean: Array  # [] float32, over all of them; NaN if there are none
    length_mean: Array  # [] float32
    return_: Array  # [WINDOW] float32, of the latest, in the order in which they ended
    length: Array  # [WINDOW] int32
    truncated: Array  # [WINDOW] bool
    kept: Array  # [WINDOW] bool, whether the last step was kept
    env: Array  # [WINDOW] int32
    there: Array  # [WINDOW] bool; False: the slot is empty
    info: dict[str, Array]  # [] float32, means over all that gave the number; NaN if none did


class Faults(NamedTuple):
    """The first env step of a rollout with a number that is not finite."""

    found: Array  # [] bool
    row: Array  # [] int32
    env: Array  # [] int32
    in_reward: Array  # [] bool, else in the observation


class Collecting(NamedTuple):
    """The static parts of collecting."""

    config: Config
    env: JaxEnv  # flat
    policy: Policy
    filter: StepFilter | None
    any_member: Callable[[Array], Array]  # see `envs.device.contract.advance`
    normalized: int  # numbers of an observation, the first, that have running moments


class _Row(NamedTuple):
    """One env step of N environments."""

    observation: Array
    action: Array
    log_prob: Array
    reward: Array  # raw
    value: Array
    final_value: Array  # of a truncated episode's final observation, else 0
    vex: Array
    terminated: Array
    truncated: Array
    valid: Array
    keep: Array
    episode_return: Array  # with this step
    episode_length: Array
    finite: Array
    info: dict[str, Array]  # what an episode's last step says of it


class _Carry(NamedTuple):
    t: Array  # [] int32
    state: CollectState
    filter: Any
    kept: Array  # [N] int32
    chunks: Any = None  # [C, N, H] states before each chunk of a recurrent policy


def start(parts: Collecting, key: Array) -> CollectState:
    """Episode 0 everywhere; the first observations enter the running moments."""
    config = parts.config
    envs = begin(parts.env, key, config.envs, cached=config.reset == "cached")
    moments: Any = ()
    if config.normalize_observations:
        moments = _first_moments(parts.normalized)
        moments = update_long_moments(moments, envs.observation, jnp.ones(config.envs, bool))
    zeros = jnp.zeros(config.envs, jnp.float32)
    lengths, memory = zeros.astype(jnp.int32), parts.policy.initial_state(config.envs)
    return CollectState(envs, moments, _first_moments(1), zeros, zeros, lengths, memory)


def _first_moments(size: int) -> LongMoments:
    parts = long_moments(initial_moments((), size))
    return LongMoments(*(jnp.asarray(part, jnp.float32) for part in parts))


def collect(
    parts: Collecting,
    params: Array,
    state: CollectState,
    keys: Keys,
    hypers: Hypers,
    iteration: Array,
    limit: Array,
) -> tuple[CollectState, Rollout, Ends, Faults]:
    """One rollout of one member.

    Args:
      params: `[D]`.
      limit: env steps that each environment may try, at least T.
    """
    config = parts.config
    max_rows = capacity(config)
    noise = _noise(parts, keys.action, iteration)
    filter_key = jax.random.fold_in(keys.filter, iteration)
    filter_state = parts.filter.init(config.envs, max_rows) if parts.filter else ()
    chunks = None
    if parts.policy.state_size:
        chunks = parts.policy.initial_state(max_rows // config.sequence_length, config.envs)
    kept = jnp.zeros(config.envs, jnp.int32)
    carry = _Carry(jnp.int32(0), state, filter_state, kept, chunks)
    begun = _finite_rows(state.envs.observation)  # the run's first ones no step has looked at

    def step(carry: _Carry) -> tuple[_Carry, _Row]:
        acting = (carry.kept < config.rollout_steps) & (carry.t < limit)
        key = jax.random.fold_in(filter_key, carry.t)
        own = noise[_noise_row(parts, carry.t)]
        return _step(parts, params, carry, own, acting, keys.env, key, hypers)

    if max_rows == config.rollout_steps:  # every env acts in every row: a plain scan
        carry, rows = jax.lax.scan(lambda c, _: step(c), carry, length=max_rows)
    else:
        carry, rows = _until_full(parts, step, carry, max_rows, limit)
    return _finish(parts, params, carry, rows, begun, hypers)


def _until_full(
    parts: Collecting,
    step: Callable[[_Carry], tuple[_Carry, _Row]],
    carry: _Carry,
    max_rows: int,
    limit: Array,
) -> tuple[_Carry, _Row]:
    """`step` until all environments are full or `limit` rows are written; the rest stays 0.

    Members that are compiled together go on until the last of them is full: a condition of each
    member's own would copy all rows in every step.
    """
    wanted = parts.config.rollout_steps
    shapes = jax.eval_shape(step, carry)[1]
    empty = jax.tree.map(lambda row: jnp.zeros((max_rows, *row.shape), row.dtype), shapes)

    def continues(now: tuple[_Carry, _Row]) -> Array:
        return parts.any_member(jnp.any(now[0].kept < wanted) & (now[0].t < limit))

    def write(now: tuple[_Carry, _Row]) -> tuple[_Carry, _Row]:
        carry, row = step(now[0])
        at = now[0].t
        return carry, jax.tree.map(lambda rows, x: rows.at[at].set(x), now[1], row)

    return jax.lax.while_loop(continues, write, (carry, empty))


def _noise(parts: Collecting, key: Array, iteration: Array) -> Array:
    """Action noise of all rows `[S / hold, N, M]`, drawn T rows at a time as the host does."""
    config = parts.config
    blocks = jnp.arange(capacity(config) // config.rollout_steps)
    noise = jax.vmap(lambda block: draw_noise(parts.policy, config, key, iteration, block))(blocks)
    return noise.reshape((-1, *noise.shape[2:]))


def _noise_row(parts: Collecting, t: Array) -> Array:
    """The row of `_noise` that env step `t` of a rollout has."""
    hold, block = parts.policy.hold, parts.config.rollout_steps
    if hold == 1:
        return t
    return t // block * -(-block // hold) + t % block // hold


def _seen(parts: Collecting, moments: LongMoments | tuple[()], raw: Array) -> Array:
    """What the policy sees of raw observations `[N, *obs]`."""
    if isinstance(moments, LongMoments):
        return normalize(moments.moments, raw, parts.config.clip_observations)
    return raw


def _step(
    parts: Collecting,
    params: Array,
    carry: _Carry,
    noise: Array,
    acting: Array,
    env_key: Array,
    filter_key: Array,
    hypers: Hypers,
) -> tuple[_Carry, _Row]:
    """Acts once everywhere that `acting` `[N]` says."""
    policy, state = parts.policy, carry.state
    observation = _seen(parts, state.observation_moments, state.envs.observation)
    output, memory = policy.step(params, observation, state.memory)
    action = policy.sample(params, output, noise)
    keep, filter_state = acting, carry.filter
    if parts.filter is not None:
        log_prob = policy.distribution.log_prob(output.policy, action)
        scored = ScoredStep(observation, action, log_prob, output.value, output.vex)
        filter_state, decided = parts.filter.keep(carry.filter, scored, filter_key, hypers)
        keep = decided & acting
    shown = to_env(policy.distribution, action)
    envs, transition = advance(parts.env, state.envs, shown, acting, env_key, parts.any_member)
    moments = state.observation_moments
    if isinstance(moments, LongMoments):
        moments = update_long_moments(moments, envs.observation, acting)
    reward = jnp.where(acting, transition.reward, 0.0)
    ended = transition.terminated | transition.truncated
    episode_return = state.episode_return + reward
    episode_length = state.episode_length + acting
    reached = _where(acting, memory, state.memory)
    after = state._replace(
        envs=envs,
        observation_moments=moments,
        episode_return=jnp.where(ended, 0.0, episode_return),
        episode_length=jnp.where(ended, 0, episode_length),
        memory=_where(~ended, reached, policy.initial_state(len(ended))),
    )
    row = _Row(
        observation,
        action,
        policy.distribution.log_prob(output.policy, action),
        reward,
        output.value,
        _final_values(parts, params, moments, reached, transition),
        output.vex,
        transition.terminated,
        transition.truncated,
        acting,
        keep,
        episode_return,
        episode_length,
        ~acting | _finite_rows(transition.observation, envs.observation, reward),
        transition.info,
    )
    chunks = _noted(parts.config, carry)
    return _Carry(carry.t + 1, after, filter_state, carry.kept + keep, chunks), row


def _noted(config: Config, carry: _Carry) -> Any:
    """The states before each chunk, with those of now if one begins; None of other policies."""
    if carry.chunks is None:
        return None
    place, begins = carry.t // config.sequence_length, carry.t % config.sequence_length == 0
    now = jnp.where(begins, carry.state.memory, carry.chunks[place])
    return carry.chunks.at[place].set(now)


def _where(mask: Array, yes: Any, no: Any) -> Any:
    """States `[N, H]`: `yes` where `mask` `[N]`, else `no`; () of a policy that has none."""
    return jax.tree.map(lambda a, b: jnp.where(mask[:, None], a, b), yes, no)


def _finite_rows(*arrays: Array) -> Array:
    """Whether the numbers of each row are finite, and small enough to be squared in float32."""
    fine = [(jnp.abs(x.reshape(len(x), -1)) <= LARGEST).all(1) for x in arrays]
    return jnp.all(jnp.stack(fine), 0)


def _final_values(
    parts: Collecting,
    params: Array,
    moments: LongMoments | tuple[()],
    memory: Any,
    transition: Transition,
) -> Array:
    """V `[N]` of what truncated episodes had reached; 0 elsewhere, and computed only for some."""
    if parts.config.truncation != "bootstrap":
        return jnp.zeros(transition.reward.shape)

    def values() -> Array:
        seen = _seen(parts, moments, transition.observation)
        return parts.policy.step(params, seen, memory)[0].value

    some = parts.any_member(jnp.any(transition.truncated))
    found = jax.lax.cond(some, values, lambda: jnp.zeros(transition.reward.shape))
    return jnp.where(transition.truncated, found, 0.0)


def _finish(
    parts: Collecting,
    params: Array,
    carry: _Carry,
    rows: _Row,
    begun: Array,
    hypers: Hypers,
) -> tuple[CollectState, Rollout, Ends, Faults]:
    """Scales the rewards and looks back over the rows `[S, N]`."""
    reward, state = _scaled_rewards(parts.config, carry.state, rows, hypers)
    ended = rows.terminated | rows.truncated
    starts = jnp.concatenate([jnp.zeros_like(ended[:1]), ended[:-1]])
    rollout = Rollout(
        rows.observation,
        rows.action,
        rows.log_prob,
        reward,
        rows.value,
        _next_values(parts, params, state, rows),
        rows.vex,
        rows.terminated,
        rows.truncated,
        rows.valid,
        rows.keep,
        None if carry.chunks is None else Memory(starts, carry.chunks),
    )
    return state, rollout, _ends(rows), _faults(rows, begun)


def _next_values(parts: Collecting, params: Array, state: CollectState, rows: _Row) -> Array:
    """The value of each step's true successor `[S, N]`."""
    seen = _seen(parts, state.observation_moments, state.envs.observation)
    after = parts.policy.step(params, seen, state.memory)[0].value
    following = jnp.concatenate([rows.valid[1:], jnp.zeros_like(rows.valid[:1])])
    later = jnp.concatenate([rows.value[1:], after[None]])
    next_value = jnp.where(following, later, jnp.where(rows.valid, after, 0.0))
    return jnp.where(rows.terminated | rows.truncated, rows.final_value, next_value)


def _scaled_rewards(
    config: Config, state: CollectState, rows: _Row, hypers: Hypers
) -> tuple[Array, CollectState]:
    """Rewards over the running std of the discounted return, as in VecNormalize."""
    if config.sign_rewards:
        rows = rows._replace(reward=jnp.sign(rows.reward))
    if not config.normalize_rewards:
        return rows.reward, state

    def step(running: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, ended, valid = row
        now = jnp.where(valid, running * hypers.gamma + reward, running)
        return jnp.where(ended, 0.0, now), jnp.where(valid, now, 0.0)

    ended = rows.terminated | rows.truncated
    last, sums = jax.lax.scan(step, state.discounted_return, (rows.reward, ended, rows.valid))
    own = LongMoments(*(part[0] for part in state.reward_moments))
    after, end = long_moments_after_all(own, sums, rows.valid)
    moments = LongMoments(*(part[None] for part in end))
    reward = scale_rewards(after, rows.reward, config.clip_rewards)
    return reward, state._replace(reward_moments=moments, discounted_return=last)


def _ends(rows: _Row) -> Ends:
    ended = (rows.terminated | rows.truncated).ravel()
    order = jnp.where(ended, jnp.arange(ended.size), -1)
    latest = jax.lax.top_k(order, min(WINDOW, ended.size))[0][::-1]

    def pick(x: Array) -> Array:
        return x.ravel()[jnp.maximum(latest, 0)]

    env = jnp.broadcast_to(jnp.arange(rows.valid.shape[1]), rows.valid.shape)
    number = jnp.sum(ended, dtype=jnp.int32)

    def mean(x: Array) -> Array:
        return jnp.sum(jnp.where(ended, x.ravel(), 0.0)) / number

    def mean_of_given(x: Array) -> Array:
        given = ended & jnp.isfinite(x.ravel())
        return jnp.sum(jnp.where(given, x.ravel(), 0.0)) / jnp.sum(given)

    return Ends(
        number,
        mean(rows.episode_return),
        mean(rows.episode_length),
        pick(rows.episode_return),
        pick(rows.episode_length),
        pick(rows.truncated),
        pick(rows.keep),
        pick(env),
        latest >= 0,
        {name: mean_of_given(x) for name, x in dict(rows.info).items()},
    )


def _faults(rows: _Row, begun: Array) -> Faults:
    """`argmax` of a mask is its first true entry, in time order.

    An observation that the rollout begins with (`begun` `[N]`: it is finite) comes before its row.
    """
    bad, early = rows.valid & ~rows.finite, ~jnp.all(begun)
    bad = bad.at[0].set(jnp.where(early, ~begun, bad[0]))
    place = jnp.argmax(bad)
    row, env = jnp.unravel_index(place, bad.shape)
    in_reward = ~(jnp.abs(rows.reward[row, env]) <= LARGEST) & ~early
    return Faults(jnp.any(bad), row.astype(jnp.int32), env.astype(jnp.int32), in_reward)
