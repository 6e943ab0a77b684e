"""A masked action has probability 0, is never chosen, and gets no gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import configured
from sauna.algorithm.policy.observation import Parts, seen_of
from sauna.algorithm.policy.policy import Policy, make_policy
from sauna.algorithm.rollout.actor import make_actor
from sauna.envs.spaces import Spaces

SPACES = Spaces("vector", (3 + 5,), "multi_discrete", (3, 2), "", "", mask=5)
MASKS = np.array([[1, 0, 1, 1, 1], [0, 1, 0, 0, 1], [1, 1, 1, 1, 0]], np.float32)


def policy_and_params(**settings) -> tuple[Policy, jax.Array]:
    policy = make_policy(configured(hidden="7,5", **settings), SPACES)
    params = policy.init(jax.random.key(0))
    return policy, params + 0.3 * jax.random.normal(jax.random.key(1), params.shape)


def observations() -> np.ndarray:
    numbers = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    return np.concatenate([numbers, MASKS], -1)


def test_probabilities_and_entropy_are_those_of_a_softmax_over_the_valid_choices() -> None:
    policy, params = policy_and_params()
    seen = observations()
    unmasked = np.concatenate([seen[:, :3], np.ones_like(MASKS)], -1)
    logits = np.asarray(policy.apply(params, unmasked).policy, np.float64)
    given = policy.apply(params, seen).policy
    entropy = np.zeros(3)
    for row in range(3):
        for start, size in ((0, 3), (3, 2)):
            valid = MASKS[row, start : start + size] > 0
            e = np.exp(logits[row, start : start + size]) * valid
            p = e / e.sum()
            entropy[row] -= sum(q * np.log(q) for q in p if q > 0)
            for choice in range(size):
                action = np.zeros((3, 2), np.int32)
                action[row, start // 3] = choice
                action[row, 1 - start // 3] = np.argmax(MASKS[row, 3 - start :])
                found = np.exp(policy.distribution.log_prob(given, action)[row])
                other = 3 - start
                width = 5 - size
                rest = np.exp(logits[row, other : other + width]) * MASKS[row, other:][:width]
                rest = rest / rest.sum()
                expected = p[choice] * rest[action[row, 1 - start // 3]]
                np.testing.assert_allclose(found, expected, rtol=1e-5)
                assert valid[choice] or found == 0.0
    np.testing.assert_allclose(policy.distribution.entropy(given), entropy, rtol=1e-5)


def test_a_masked_action_is_never_sampled_nor_the_mode_even_if_its_logit_is_the_highest() -> None:
    policy, params = policy_and_params()
    tree = policy.unravel(params)
    tree["params"]["policy_head"]["bias"] = jnp.array([-5.0, 40.0, -5.0, -5.0, 40.0])
    params = jax.flatten_util.ravel_pytree(tree)[0]
    logits = policy.apply(params, observations()).policy
    noise = policy.distribution.draw(jax.random.key(2), (500, 3))
    sampled = np.asarray(jax.vmap(policy.distribution.sample, (None, 0))(logits, noise))
    for actions in (sampled, np.asarray(policy.distribution.mode(logits))[None]):
        taken = np.stack([actions[..., 0], 3 + actions[..., 1]], -1)
        rows = np.arange(3)[None, :, None]
        assert MASKS[rows, taken].all()
    unmasked = policy.apply(params, np.concatenate([observations()[:, :3], np.ones((3, 5))], -1))
    assert (np.asarray(policy.distribution.mode(unmasked.policy)) == [1, 1]).all()


def test_masked_logits_get_no_gradient_and_others_do() -> None:
    policy, params = policy_and_params()
    seen = observations()
    action = np.array([[2, 0], [1, 1], [0, 0]])

    def loss(shift: jax.Array) -> jax.Array:
        tree = policy.unravel(params)
        tree["params"]["policy_head"]["bias"] = tree["params"]["policy_head"]["bias"] + shift
        output = policy.apply(jax.flatten_util.ravel_pytree(tree)[0], seen[row : row + 1])
        log_prob = policy.distribution.log_prob(output.policy, action[row : row + 1])
        return (log_prob + 0.1 * policy.distribution.entropy(output.policy))[0]

    for row in range(3):
        gradient = np.asarray(jax.grad(loss)(jnp.zeros(5)))
        assert (gradient[MASKS[row] == 0] == 0).all()
        several = MASKS[row, :3].sum() > 1
        assert (gradient[:3][MASKS[row, :3] > 0] != 0).all() == several  # one choice: p is 1


def test_neither_trunk_nor_heads_see_the_mask() -> None:
    policy, params = policy_and_params()
    seen = observations()
    other = np.concatenate([seen[:, :3], 1 - MASKS], -1)
    one, two = policy.apply(params, seen), policy.apply(params, other)
    np.testing.assert_array_equal(one.value, two.value)
    np.testing.assert_array_equal(one.hidden, two.hidden)


@pytest.mark.parametrize("trunk", ["separate", "shared"])
def test_the_compiled_actor_chooses_as_the_policy_does(trunk: str) -> None:
    config = configured(hidden="7,5", trunk=trunk, envs=3)
    policy = make_policy(config, SPACES)
    params = np.stack([policy.init(jax.random.key(seed)) for seed in range(2)])
    actor = make_actor(config, SPACES, policy, None, 2)
    actor.load(params)
    seen = np.stack([observations(), observations()[::-1]])
    for seed in range(20):
        noise = np.asarray(policy.distribution.draw(jax.random.key(seed), (1, 2, 3)))
        given = actor.act(seen, actor.prepare(noise)[0])
        for p in range(2):
            wanted = policy.distribution.sample(
                policy.apply(params[p], seen[p]).policy, noise[0, p]
            )
            np.testing.assert_array_equal(given[p], wanted)


def test_parts_of_an_observation_are_cut_where_they_stand() -> None:
    spaces = Spaces("vector", (2 + 5 + 12 + 4,), "multi_discrete", (3, 2), "", "", mask=5)
    spaces = spaces._replace(pictures=((2, 3, 2, 255.0), (2, 2, 1, 9.0)))
    row = np.arange(23, dtype=np.float32)
    found = seen_of(spaces, jnp.asarray(row[None]))
    assert isinstance(found, Parts)
    np.testing.assert_array_equal(found.numbers[0], row[:2])
    np.testing.assert_array_equal(found.pictures[0][0], row[7:19].reshape(2, 3, 2))
    np.testing.assert_array_equal(found.pictures[1][0], row[19:].reshape(2, 2, 1))
    assert found.pictures[0].dtype == jnp.uint8
    alone = spaces._replace(observation_shape=(17,), pictures=spaces.pictures[:1])
    np.testing.assert_array_equal(
        seen_of(alone, jnp.asarray(row[None, :17]))[0], row[5:17].reshape(2, 3, 2)
    )
