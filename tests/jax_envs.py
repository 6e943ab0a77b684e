"""Small environments as pure functions. Importable by name, so that workers can make them."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from sauna import JaxEnv, StepFilter, Transition, VexTarget
from sauna.algorithm.types import member_keys

LENGTH = 12


class State(NamedTuple):
    x: jax.Array
    steps: jax.Array
    key: jax.Array


def _observe(state: State) -> jax.Array:
    return jnp.stack([state.x, 0.1 * state.steps])


def reset(key: jax.Array) -> tuple[State, jax.Array]:
    key, own = jax.random.split(key)
    state = State(jax.random.normal(own), jnp.int32(0), key)
    return state, _observe(state)


def step(state: State, action: jax.Array) -> Transition:
    key, own = jax.random.split(state.key)
    x = state.x + 0.3 * action[0] + 0.2 * jax.random.normal(own)
    after = State(x, state.steps + 1, key)
    ended = jnp.abs(x) > 2.0
    return Transition(
        after, _observe(after), 1.0 - jnp.abs(x), ended, (after.steps >= LENGTH) & ~ended
    )


_BOX = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
_PUSH = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

# A random walk that ends beyond +-2 and is cut off after 12 steps.
walk = JaxEnv(reset, step, _BOX, _PUSH)


def _informative_step(state: State, action: jax.Array) -> Transition:
    told = step(state, action)
    steps = told.state.steps
    nothing = jnp.where(steps > LENGTH, 1.0, jnp.nan)
    info = {"is_success": steps % 2 == 0, "length": steps, "never": nothing, "goal": "north"}
    return told._replace(info={**info, "many": jnp.zeros(2)})


# The same, and every step says how far the episode is, and whether that is an even number.
informative = walk._replace(step=_informative_step)


def _twice(observation: jax.Array) -> jax.Array:
    return jnp.concatenate([observation, observation[:1]])


# The same again, with the spaces of `small_envs.Scripted`: the second action does nothing.
wide = JaxEnv(
    lambda key: (reset(key)[0], _twice(reset(key)[1])),
    lambda state, action: (told := step(state, action))._replace(
        observation=_twice(told.observation)
    ),
    gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64),
    gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
)


def make_walk(limit: float = 2.0) -> JaxEnv:
    def near(state: State, action: jax.Array) -> Transition:
        transition = step(state, action)
        ended = jnp.abs(transition.state.x) > limit
        return transition._replace(
            terminated=ended, truncated=(transition.state.steps >= LENGTH) & ~ended
        )

    return walk._replace(step=near)


def _always_one(state: State, action: jax.Array) -> Transition:
    transition = step(state, action)
    return transition._replace(
        observation=jnp.ones(2),
        reward=jnp.float32(1.0),
        terminated=jnp.bool_(False),
        truncated=transition.state.steps >= 2,
    )


# Reward 1 for ever, one observation, cut off every other step: V is 1 / (1 - gamma).
cut_off = walk._replace(
    reset=lambda key: (reset(key)[0], jnp.ones(2)), step=_always_one, action_space=_PUSH
)


def _breaks(state: State, action: jax.Array) -> Transition:
    transition = step(state, action)
    return transition._replace(
        reward=jnp.where(transition.state.steps == 5, jnp.nan, transition.reward)
    )


broken = walk._replace(step=_breaks)


def _starts_nowhere(key: jax.Array) -> tuple[State, jax.Array]:
    state, observation = reset(key)
    return state, observation * jnp.nan


broken_start = walk._replace(reset=_starts_nowhere)

FIELDS = ("first", "observation", "final", "reward")  # what of an episode can be poisoned


class PoisonedState(NamedTuple):
    steps: jax.Array
    cut: jax.Array  # whether its time limit comes first
    bad: jax.Array  # whether this is the episode


class Poison(NamedTuple):
    """One number that is none, in one place of one episode. All may be traced."""

    key: Any  # that the episode is reset with
    field: Any  # of `FIELDS`, its index
    value: Any
    component: Any  # of the observation
    step: Any  # of that episode, from 1; not read where the field says when


def poisoned(poison: Poison) -> JaxEnv:
    """Episodes of 4 steps, one of them with that number."""

    def now(name: str) -> Any:
        return jnp.asarray(poison.field) == FIELDS.index(name)

    def observe(state: PoisonedState, here: Any) -> jax.Array:
        wrong = (jnp.arange(3) == poison.component) & state.bad & here
        return jnp.where(wrong, poison.value, jnp.full(3, 0.1 * state.steps))

    def reset(own: jax.Array) -> tuple[PoisonedState, jax.Array]:
        bad = jnp.all(jax.random.key_data(own) == jax.random.key_data(poison.key))
        state = PoisonedState(jnp.int32(0), jax.random.bernoulli(own), bad)
        return state, observe(state, now("first"))

    def move(state: PoisonedState, action: jax.Array) -> Transition:
        after = state._replace(steps=state.steps + 1)
        ended, here = after.steps == 4, after.steps == poison.step
        wrong = (here & now("observation")) | (ended & now("final"))
        spoiled = here & state.bad & now("reward")
        reward = jnp.where(spoiled, poison.value, jnp.sum(action))
        return Transition(
            after, observe(after, wrong), reward, ended & ~state.cut, ended & state.cut
        )

    return JaxEnv(reset, move, gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32), _PUSH)


def unlucky() -> JaxEnv:
    """Gives a NaN in the fourth episode of the member with seed 1, and only there."""
    own = jax.random.fold_in(member_keys(1).env, 0)
    return poisoned(Poison(jax.random.fold_in(own, 3), FIELDS.index("reward"), jnp.nan, 0, 2))


def faulty(fault: str) -> JaxEnv:
    """A beginner's environment."""

    def play(state: State, action: jax.Array) -> Transition:
        transition = step(state, action)
        if fault == "raises":
            raise ValueError("two\nlines")
        if fault == "branches" and transition.terminated:
            return transition
        other = {
            "observation": jnp.zeros(3),
            "reward": jnp.ones(1),
            "terminated": jnp.zeros(2, bool),
        }
        after = {
            "state": State(
                transition.state.x, jnp.float32(transition.state.steps), transition.state.key
            )
        }
        return transition._replace(**{k: v for k, v in {**other, **after}.items() if k == fault})

    return walk._replace(step=play)


def no_env(**kwargs: Any) -> int:
    return 3


# Parts of a user's own with the mistakes that users make.
misspelt = StepFilter(lambda n, capacity: (), lambda s, step, k, h: (s, step.vex > h.treshold))
too_long = StepFilter(
    lambda n, capacity: (), lambda s, step, k, h: (s, jnp.append(step.vex, 0.0) > 0)
)
forgetting = StepFilter(
    lambda n, capacity: jnp.zeros(n), lambda s, step, k, h: (s.sum(), step.vex > 0)
)
# And without: Python numbers as a state, and numpy where nothing is traced.
smoothed = StepFilter(
    lambda n, capacity: 0, lambda s, step, k, h: (0.9 * s + step.vex.mean(), step.vex >= s)
)
by_numpy = StepFilter(
    lambda n, capacity: jnp.asarray(np.asarray(jnp.zeros(n))),
    lambda s, step, k, h: (s + step.vex, step.vex >= s),
)
summed = VexTarget(lambda return_, value, weight, episode: jnp.sum(return_ - value))


def _valid(state: State) -> jax.Array:
    """Of two components: 3 and 2 choices, which of them depends on the step."""
    t = state.steps
    return jnp.stack([t % 3 == 0, t % 3 != 0, t % 2 == 0, t % 2 == 0, t % 2 != 0])


def _masked_step(state: State, action: jax.Array) -> Transition:
    told = step(state, 0.1 * action[:1])
    taken = jnp.stack([action[0], 3 + action[1]])
    return told._replace(info={"invalid": jnp.any(~_valid(state)[taken])})


# The walk by choices, of which some are valid; an episode's last step says whether its was not.
choosy = JaxEnv(reset, _masked_step, _BOX, gymnasium.spaces.MultiDiscrete([3, 2]))
choosy = choosy._replace(action_mask=_valid)
# The same, in whose fourth state no action is valid.
stuck = choosy._replace(action_mask=lambda state: _valid(state) & (state.steps != 3))


def shade(kind: str = "uint8") -> JaxEnv:
    """Pictures `[40, 40, 1]` of one shade, which gets brighter with each step."""
    most = 255 if kind == "uint8" else 1
    space = gymnasium.spaces.Box(0, most, (40, 40, 1), np.dtype(kind))

    def observe(state: State) -> jax.Array:
        return jnp.full((40, 40, 1), most * state.steps / LENGTH).astype(kind)

    def begin(key: jax.Array) -> tuple[State, jax.Array]:
        state, _ = reset(key)
        return state, observe(state)

    def go_on(state: State, action: jax.Array) -> Transition:
        after = step(state, jnp.float32(action)[None])
        return after._replace(observation=observe(after.state))

    return JaxEnv(begin, go_on, space, gymnasium.spaces.Discrete(2))
