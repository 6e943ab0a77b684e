"""Minibatches drawn by how large a row's gradient is."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sauna.algorithm.policy.bounded import beta
from sauna.algorithm.selection.scores import check_range, check_share
from sauna.algorithm.types import Array, Choice, Sampler, SamplerSetup, Samples


def gradient_norm(setup: SamplerSetup, uniform: float = 0.1, share: float = 1.0) -> Sampler:
    """Draws by the norm of the surrogate's gradient at the policy head; its mean stays.

    `p = (1 - uniform) g / sum g + uniform / M`, the policy term weighted by exactly `1 / (M p)`.
    With `z = (a - mu) / sigma` and h the last hidden layer:

        Gaussian     g = |A^| sqrt(sum_j (z_j/sigma_j)^2 (|h|^2 + 1) + sum_j (z_j^2 - 1)^2)
        Beta         g = |A^| sqrt(sum_k (d log pi / d output_k)^2) sqrt(|h|^2 + 1)
        categorical  g = |A^| sqrt(sum_c (1 - 2 pi_a + sum_i pi_i^2)) sqrt(|h|^2 + 1)

    the first also under a tanh, whose slope no parameter moves, the last summed over the components
    c of a factored action. The value loss draws rows of its own, by
    `|R - V|`. The entropy bonus alone is biased: it is a mean over the rows drawn by p, unweighted.
    After Katharopoulos & Fleuret 2018.
    """

    check_range("uniform", uniform, 0.0, 1.0)
    check_share(share)

    def mixed(score: Array, present: Array) -> Array:
        score, even = score * present, present / jnp.sum(present)
        total = jnp.sum(score)
        found = jnp.where(total > 0, score / jnp.where(total > 0, total, 1.0), even)
        return (1.0 - uniform) * found + uniform * even

    def choose(state: tuple[()], samples: Samples, key: Array) -> tuple[tuple[()], Choice]:
        present = samples.present
        head = head_gradient(setup, samples.policy, samples.action, samples.hidden)
        score = jnp.abs(samples.standardized) * head
        p = mixed(score, present)
        value_p = mixed(jnp.abs(samples.error), present)
        number = jnp.sum(present)
        return state, Choice(
            probability=p,
            weight=_inverse(number * p),
            value_probability=value_p,
            value_weight=_inverse(number * value_p),
            score=score,
        )

    return Sampler(lambda: (), choose, share=share, reads_policy=True)


def _inverse(x: Array) -> Array:
    return jnp.where(x > 0, 1.0 / jnp.where(x > 0, x, 1.0), 0.0)


def head_gradient(setup: SamplerSetup, policy: Array, action: Array, hidden: Array) -> Array:
    """The norm of `grad log pi(a | s)` at the policy head `[M]`, for weights, biases and log-std.

    Args:
      policy: `[M, K]` parameters of the distribution; action: `[M, A]`; hidden: `[M, H]`.
    """
    above = jnp.sum(hidden**2, -1) + 1.0
    if setup.action_kind == "continuous" and setup.distribution == "beta":
        log_prob = beta(setup.action_sizes[0]).log_prob
        outputs = jax.grad(lambda outputs: jnp.sum(log_prob(outputs, action)))(policy)
        return jnp.sqrt(jnp.sum(outputs**2, -1) * above)
    if setup.action_kind == "continuous":
        mean, log_std = jnp.split(policy, 2, -1)
        z = (action - mean) * jnp.exp(-log_std)
        weights = jnp.sum((z * jnp.exp(-log_std)) ** 2, -1) * above
        return jnp.sqrt(weights + jnp.sum((z**2 - 1.0) ** 2, -1))
    if setup.action_kind == "multi_binary":  # d log pi / d logit = a - sigmoid(logit)
        return jnp.sqrt(jnp.sum((action - jax.nn.sigmoid(policy)) ** 2, -1) * above)
    total, start = jnp.zeros(len(hidden)), 0
    for c, size in enumerate(setup.action_sizes):
        pi = jax.nn.softmax(policy[:, start : start + size], -1)
        taken = jax.nn.one_hot(action[:, c].astype(jnp.int32), size)
        total += jnp.sum((taken - pi) ** 2, -1)  # of squares: rounding makes no negative number
        start += size
    return jnp.sqrt(total * above)
