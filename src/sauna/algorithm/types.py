"""The data that flows through one iteration, as declared types.

Axes: `S` env steps tried in a rollout, `T` kept steps per env, `N` envs of one member, `B` samples
of a minibatch. Everything here belongs to one member. An axis of members is added where they are
collected (`rollout/`) and in the device's loop (`training/loop/device_program.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

Array = jax.Array
Params = Any  # a flax parameter pytree


class Hypers(NamedTuple):
    """Traced hyperparameters, float32 scalars: members that differ in them share one program."""

    learning_rate: Array  # of this iteration, after its schedule
    clip_range: Array
    gamma: Array
    gae_lambda: Array
    entropy_coef: Array
    value_coef: Array
    vex_coef: Array  # c2 of eq. 6
    max_grad_norm: Array
    threshold: Array  # of eq. 7
    drop_rate: Array  # of this iteration


class Rollout(NamedTuple):
    """The full stream of one member's iteration, in time order.

    Env n acted in the rows where `valid[:, n]`. The others are padding behind its last step, or
    rows in which it waited for its next episode.
    """

    observation: Array  # [S, N, ...] normalised float32, or uint8 images
    action: Array  # [S, N, A] float32 (unclipped, or before the tanh of a bounded one) or int32
    log_prob: Array  # [S, N] float32
    reward: Array  # [S, N] float32, normalised
    value: Array  # [S, N] float32, V(s_t) at collection
    next_value: Array  # [S, N] float32, V of the true successor (the final observation at an end)
    vex: Array  # [S, N] float32, the Vex head at s_t
    terminated: Array  # [S, N] bool
    truncated: Array  # [S, N] bool
    valid: Array  # [S, N] bool
    keep: Array  # [S, N] bool, the filter's decision; False on padding
    memory: Any = None  # `Memory` of a recurrent policy


class Memory(NamedTuple):
    """What a recurrent policy's chunks of a rollout begin with, C chunks of L env steps each.

    Truncated back-propagation through time begins anew with each chunk (Williams & Peng 1990). JAX
    arrays, or numpy's on their way there.
    """

    start: Any  # [S, N] bool, whether an episode starts with the row
    state: Any  # [C, N, H] float32 before each chunk's first row, as it was while acting


class Batch(NamedTuple):
    """What the update learns from: the kept steps of one rollout, flattened to `T * N` samples."""

    observation: Array  # [T * N, ...]
    action: Array  # [T * N, A]
    log_prob: Array  # [T * N]
    advantage: Array  # [T * N]
    return_: Array  # [T * N]
    value: Array  # [T * N]
    vex_target: Array  # [T * N]; not read when the target is computed per minibatch
    weight: Array  # [T * N] 1, or 0 for a slot that stayed empty or a masked step
    vex: Any = None  # [T * N] the Vex head at collection, for rules of selection
    next_observation: Any = None  # [T * N, ...] for the auxiliary head
    next_weight: Any = None  # [T * N] 1, or 0 if the next observation is not of this episode
    row: Any = None  # [T * N] int32, place t * N + n in the rollout; None if nothing asks for it
    memory: Any = None  # `Memory` of sequences; see `learner/sequences.py`
    importance: Any = None  # [T * N] multiplies the policy term of a replayed step; None: 1


class TrainState(NamedTuple):
    """What learning changes. Parameters are one flat vector, so that a step is a few vector ops."""

    params: Array  # [D] float32, the raveled parameter pytree
    optimizer: Any  # optax's: ScaleByAdamState (count int32, mu [D], nu [D]), or another
    sampler: Any = ()  # what a selection rule carries from one iteration to the next
    learning_rate: Any = ()  # [] of the last step, 0 before the first; () unless the KL moves it
    replay: Any = ()  # a `Replay`; () if the update learns from the new rollout alone


class Replay(NamedTuple):
    """The latest rollouts of a member, newest first."""

    rollouts: Rollout  # [R, S, N, ...]
    number: Array  # [] int32, how many there are so far; the others are empty


class PolicyOutput(NamedTuple):
    """The network at one observation."""

    policy: Array  # [..., K] parameters of the action distribution
    value: Array  # [...]
    vex: Array  # [...]
    hidden: Array  # [..., H] the policy's last hidden layer
    prediction: Any  # [..., O] of the auxiliary head; None if there is none
    state: Any = ()  # [B, H] of a recurrent policy, after the last step; else ()


class Keys(NamedTuple):
    """The JAX keys of one member; each use folds in the iteration, so that no key is stored."""

    init: Array
    action: Array
    filter: Array
    env: Array  # of environments on the accelerator; a host environment has a seed per episode
    order: Array  # of minibatches drawn on the accelerator; see `minibatch_order`


SELECTION = 2**31 - 1  # no epoch has this number; the order of epoch e folds e into the key


def selection_key(keys: Keys, iteration: Any) -> Array:
    """The key of an iteration's draws by a rule of selection, on the host and on the device."""
    return jax.random.fold_in(jax.random.fold_in(keys.order, iteration), SELECTION)


def member_keys(seed: int) -> Keys:
    """Keys that depend on the member's seed alone."""
    return _keys_of(jax.random.key(seed))


@jax.jit  # one program for all of them, rather than one for each
def _keys_of(root: Array) -> Keys:
    init, action, filter = jax.random.split(root, 3)
    return Keys(init, action, filter, jax.random.fold_in(root, 3), jax.random.fold_in(root, 4))


# ---------------------------------------------------------------------------------------------
# Where a rule of sample selection can act. Each hook is a pure function, or a pair of them.


class ScoredStep(NamedTuple):
    """One vector step that is scored already: what a `StepFilter` sees.

    JAX arrays, or numpy's on their way there.
    """

    observation: Any  # [N, ...] as the policy saw it
    action: Any  # [N, A]
    log_prob: Any  # [N]
    value: Any  # [N] V(s)
    vex: Any  # [N] the Vex head's prediction


class StepFilter(NamedTuple):
    """Stage 1, while collecting: which transitions the rollout keeps.

    `init(num_envs, capacity)` gives the state at the start of a rollout in which each env acts at
    most `capacity` times. `keep(state, step, key, hypers)` is called once per env step, in time
    order, and returns the new state and the mask `[N]` of the envs whose transition is kept.
    `hypers` holds the traced hyperparameters, of which `threshold` and `drop_rate` are filters'.
    A decision never changes how an env acts. If an env's quota is full, its decision is ignored.
    """

    init: Callable[[int, int], Any]
    keep: Callable[[Any, ScoredStep, Array, Hypers], tuple[Any, Array]]


class SamplerSetup(NamedTuple):
    """What a sampler knows before training: static numbers of the run."""

    rollout_steps: int  # T
    envs: int  # N
    iterations: int  # of the whole budget, if no filter drops anything
    action_kind: str
    action_sizes: tuple[int, ...]
    replay_rollouts: int = 0
    distribution: str = "gaussian"  # of continuous actions

    @property
    def rows(self) -> int:
        """M = T * N, and as many again for each rollout that is replayed."""
        return self.rollout_steps * self.envs * (1 + self.replay_rollouts)


class Samples(NamedTuple):
    """What a `Sampler` sees: the `M = T * N` rows of a rollout, row `t * N + n`.

    The last five fields belong to today's policy and are None unless the sampler `reads_policy`.
    """

    present: Array  # [M] bool; False: a slot that stayed empty
    observation: Array  # [M, ...]
    action: Array  # [M, A]
    log_prob: Array  # [M] of the policy that acted
    advantage: Array  # [M] raw
    standardized: Array  # [M] (A - mean) / (std + 1e-8) over the rows that are present
    return_: Array  # [M]
    value: Array  # [M] at collection
    error: Array  # [M] return_ - value
    vex: Array  # [M] the Vex head at collection
    log_ratio: Any = None  # [M] log-probability now minus then
    policy: Any = None  # [M, K] parameters of the action distribution
    hidden: Any = None  # [M, H] the policy's last hidden layer
    entropy: Any = None  # [M]


class Choice(NamedTuple):
    """What a `Sampler` takes of `M` rows: a mask, or probabilities to draw by."""

    keep: Any = None  # [M] bool
    probability: Any = None  # [M], sum 1
    weight: Any = None  # [M] multiplies the policy term; None: 1
    value_probability: Any = None  # [M] if the value loss draws rows of its own
    value_weight: Any = None  # [M] multiplies the terms of the value and Vex losses; None: 1
    score: Any = None  # [M] how much the rule wants a row: what `reversed` ranks by


class Draw(NamedTuple):
    """The rows of one epoch; the first `number` count."""

    rows: Array  # [K] int32
    value_rows: Array  # [K] int32, `rows` themselves unless the value loss draws its own
    number: Array  # [] int32


class Sampler(NamedTuple):
    """Stage 2, once advantages are known: which rows the update learns from, and how often.

    Attributes:
      init: `() -> state`; the state is carried over iterations and checkpointed.
      choose: `(state, samples, key) -> (state, choice)`.
      share: static, the most that a choice takes: arrays have `K = ceil(share * M)` rows.
      reads_policy: whether `samples` hold those of today's policy, which takes one forward pass.
      each_epoch: choose before each epoch instead of once per iteration.
      on_mean: for a Gaussian policy, a mask chooses whom the mean learns from, and the log-std
        learns from all rows; read with `selection_losses=policy`.
    """

    init: Callable[[], Any]
    choose: Callable[[Any, Samples, Array], tuple[Any, Choice]]
    share: float = 1.0
    reads_policy: bool = False
    each_epoch: bool = False
    on_mean: bool = False


class LossTerms(NamedTuple):
    """What a `LossWeight` sees of a minibatch of `B` rows."""

    log_prob: Array  # [B] of today's policy
    log_ratio: Array  # [B] log-probability now minus at collection
    advantage: Array  # [B] as the loss uses it
    entropy: Array  # [B]
    present: Array  # [B] 1, or 0 for a row that does not count
    continuous: bool  # whether log-probabilities are of a density


class LossWeight(NamedTuple):
    """A weight of each policy term in a minibatch.

    Attributes:
      weight: `terms -> (mask [B], scale [B])`; the policy loss is `sum(mask scale l) / sum(mask)`.
      on_mean: for a Gaussian policy, scale the gradient of the mean alone.
    """

    weight: Callable[[LossTerms], tuple[Array, Array]]
    on_mean: bool = False


class StopRule(NamedTuple):
    """When an iteration takes no further gradient step.

    `exceeded(log_ratio [B], weight [B]) -> bool` is asked before each step.
    """

    exceeded: Callable[[Array, Array], Array]
