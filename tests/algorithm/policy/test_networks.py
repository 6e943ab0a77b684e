"""Networks and distributions: initialisation, heads, trunks, and scipy as the oracle."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from helpers import configured, make_job, train_here
from sauna.algorithm.policy.convolutions import LAYERS, convolutions
from sauna.algorithm.policy.distributions import bernoulli, gaussian, multi_categorical
from sauna.algorithm.policy.networks import NatureCNN
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.rollout.actor import make_actor
from sauna.config.choices import ACTIVATIONS
from sauna.envs.spaces import Spaces
from sauna.system.errors import BadInput
from sauna.training.loop.member_state import flat_params, named_params

VECTOR = Spaces("vector", (11,), "continuous", (3,), "", "")
IMAGE = Spaces("image", (40, 40, 2), "discrete", (3,), "", "")


def tree(spaces: Spaces = VECTOR, **settings):
    policy = make_policy(configured(**settings), spaces)
    return policy, policy.unravel(policy.init(jax.random.key(0)))["params"]


def test_initialisation_is_baselines() -> None:
    _, params = tree()
    gains = {"policy_head": 0.01, "value_head": 1.0, "vex_head": 1.0}
    assert set(params) == {*gains, "policy_trunk", "value_trunk", "log_std"}
    for name, gain in gains.items():
        kernel = np.asarray(params[name]["kernel"])
        np.testing.assert_allclose(kernel.T @ kernel, gain**2 * np.eye(kernel.shape[1]), atol=1e-5)
    for trunk in ("policy_trunk", "value_trunk"):
        kernel = np.asarray(params[trunk]["layer_1"]["kernel"])
        assert kernel.shape == (64, 64)
        np.testing.assert_allclose(kernel.T @ kernel, 2 * np.eye(64), atol=1e-4)
        np.testing.assert_array_equal(params[trunk]["layer_0"]["bias"], 0.0)
    np.testing.assert_array_equal(params["log_std"], np.zeros(3))
    assert np.asarray(tree(log_std_init=-0.7)[1]["log_std"]).tolist() == pytest.approx([-0.7] * 3)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_compiled_actor_has_every_activation_and_layer_norm(activation: str) -> None:
    acts_as_the_network(
        activation=activation, hidden="9,6", value_hidden="4", layer_norm="yes", envs=2
    )
    acts_as_the_network(activation=activation, hidden="5", envs=2)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("trunk", ["separate", "shared"])
@pytest.mark.parametrize("hidden", ["7", "64,64", "5,30,6"])
def test_the_compiled_actor_acts_as_the_network(activation: str, trunk: str, hidden: str) -> None:
    acts_as_the_network(activation=activation, trunk=trunk, hidden=hidden, envs=2)


def acts_as_the_network(**settings) -> None:
    """Actions are the network's means plus the noise; observations far out saturate the tanh."""
    config = configured(**settings)
    policy = make_policy(config, VECTOR)
    params = np.stack([policy.init(jax.random.key(seed)) for seed in range(3)])
    params += np.random.default_rng(0).normal(0, 0.1, params.shape).astype(np.float32)
    actor = make_actor(config, VECTOR, policy, None, 3)
    actor.load(params)
    seen = np.random.default_rng(1).normal(0, 3, (3, 2, 11)).astype(np.float32)
    noise = np.random.default_rng(2).normal(size=(4, 3, 2, 3)).astype(np.float32)
    actions = actor.act(seen, actor.prepare(noise)[1])
    for p, vector in enumerate(params):
        output = np.asarray(policy.apply(vector, seen[p]).policy)
        expected = output[:, :3] + noise[1, p] * np.exp(output[:, 3:])
        np.testing.assert_allclose(actions[p], expected, rtol=2e-5, atol=2e-5)


def test_the_network_is_what_it_says() -> None:
    """A forward pass by hand, tanh and relu, with separate and shared trunks."""
    seen = np.random.default_rng(0).normal(size=(5, 11)).astype(np.float32)
    for trunk in ("separate", "shared"):
        for activation, function in (("tanh", np.tanh), ("relu", lambda x: np.maximum(x, 0))):
            policy, params = tree(trunk=trunk, activation=activation, hidden="9,6,4")
            flat = policy.init(jax.random.key(0))
            output = policy.apply(flat, seen)

            def features(name, function=function, params=params):
                x = seen
                for i in range(3):
                    layer = params[name][f"layer_{i}"]
                    x = function(x @ layer["kernel"] + layer["bias"])
                return x

            value_trunk = "trunk" if trunk == "shared" else "value_trunk"
            policy_trunk = "trunk" if trunk == "shared" else "policy_trunk"
            for head, name, got in (
                ("value_head", value_trunk, output.value[:, None]),
                ("vex_head", value_trunk, output.vex[:, None]),
                ("policy_head", policy_trunk, output.policy[:, :3]),
            ):
                expected = features(name) @ params[head]["kernel"] + params[head]["bias"]
                np.testing.assert_allclose(got, expected, atol=1e-5)


def test_layer_norm_and_the_values_widths_by_hand() -> None:
    policy, params = tree(hidden="9,6", value_hidden="5", layer_norm="yes", activation="elu")
    shapes = {
        name: layer["kernel"].shape
        for name, layer in params["value_trunk"].items()
        if "kernel" in layer
    }
    assert shapes == {"layer_0": (11, 5)}
    assert params["policy_trunk"]["layer_1"]["kernel"].shape == (9, 6)
    flat = policy.init(jax.random.key(0))
    flat += np.random.default_rng(0).normal(0, 0.3, flat.shape).astype(np.float32)
    params = policy.unravel(flat)["params"]
    x = seen = np.random.default_rng(1).normal(2, 3, (5, 11)).astype(np.float32)
    for i in range(2):
        layer, norm = (params["policy_trunk"][f"{kind}_{i}"] for kind in ("layer", "norm"))
        x = x @ layer["kernel"] + layer["bias"]
        x = (x - x.mean(1, keepdims=True)) / x.std(1, keepdims=True) * norm["scale"] + norm["bias"]
        x = np.where(x > 0, x, np.exp(x) - 1)
    expected = x @ params["policy_head"]["kernel"] + params["policy_head"]["bias"]
    output = policy.apply(flat, seen)
    np.testing.assert_allclose(output.policy[:, :3], expected, atol=1e-4)
    assert output.hidden.shape == (5, 6) and output.value.shape == (5,)


def test_the_vex_loss_reaches_the_value_trunk_only() -> None:
    policy, _ = tree()
    flat, seen = policy.init(jax.random.key(0)), np.ones((4, 11), np.float32)
    gradient = jax.grad(lambda p: policy.apply(p, seen).vex.sum())(flat)
    reached = {name.split("/")[0] for name, g in named_params(policy, gradient).items() if g.any()}
    assert reached == {"value_trunk", "vex_head"}


def test_nature_cnn_takes_bytes() -> None:
    policy = make_policy(
        dataclasses.replace(configured(trunk="shared"), network="nature-cnn"), IMAGE
    )
    flat = policy.init(jax.random.key(0))
    image = np.random.default_rng(0).integers(0, 256, (6, 40, 40, 2)).astype(np.uint8)
    output = policy.apply(flat, image)
    assert output.policy.shape == (6, 3) and output.value.shape == (6,)
    scaled = policy.apply(flat, image.astype(np.float32) / 255.0)
    np.testing.assert_allclose(output.value, scaled.value, atol=1e-5)
    params = policy.unravel(flat)["params"]["trunk"]
    assert [params[f"conv_{i}"]["kernel"].shape for i in range(3)] == [
        (8, 8, 2, 32),
        (4, 4, 32, 64),
        (3, 3, 64, 64),
    ]


def test_the_nature_cnn_by_hand() -> None:
    """84 -> 20 -> 9 -> 7 pixels, 7 x 7 x 64 = 3136 features; each layer's weights and biases."""
    picture = jax.ShapeDtypeStruct((2, 84, 84, 4), jnp.uint8)
    features, params = jax.eval_shape(
        lambda x: NatureCNN().init_with_output(jax.random.key(0), x), picture
    )
    assert features.shape == (2, 512)
    sizes = {
        name: sum(math.prod(p.shape) for p in jax.tree.leaves(layer))
        for name, layer in params["params"].items()
    }
    assert sizes == {
        "conv_0": 8 * 8 * 4 * 32 + 32,
        "conv_1": 4 * 4 * 32 * 64 + 64,
        "conv_2": 3 * 3 * 64 * 64 + 64,
        "dense": 3136 * 512 + 512,
    }
    assert sum(sizes.values()) == 1_684_128


def theirs(layers, x):
    """`convolutions` with XLA's own."""
    for (kernel, bias), (_, _, stride) in zip(layers, LAYERS, strict=True):
        x = jax.lax.conv_general_dilated(
            x, kernel, (stride,) * 2, "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        x = jax.nn.relu(x + bias)
    return x


@pytest.mark.parametrize("pictures", [1, 8, 11])
def test_convolutions_are_xlas(pictures: int) -> None:
    """With their gradients, in whole pieces and not, where pixels are left over at the edges."""
    random = np.random.default_rng(0)
    x = random.normal(size=(pictures, 39, 42, 3)).astype(np.float32)
    layers, channels = [], 3
    for features, width, _ in LAYERS:
        kernel = random.normal(size=(width, width, channels, features)) / width
        layers.append((kernel.astype(np.float32), random.normal(size=features).astype(np.float32)))
        channels = features

    def of(function):
        def squares(layers, x):
            y = function(layers, x)
            return (y**2).mean(), y

        return jax.jit(jax.grad(squares, (0, 1), has_aux=True))(layers, x)

    ours, expected = jax.tree.leaves(of(convolutions)), jax.tree.leaves(of(theirs))
    for one, other in zip(ours, expected, strict=True):
        scale = np.abs(other).max()
        np.testing.assert_allclose(one / scale, other / scale, rtol=1e-4, atol=1e-5)
    without_gradient = np.asarray(jax.jit(convolutions)(layers, x))
    np.testing.assert_allclose(without_gradient, ours[-1], rtol=1e-4, atol=1e-4)


def test_the_gradient_of_bytes_is_that_of_their_shares() -> None:
    config = dataclasses.replace(configured(trunk="shared"), network="nature-cnn")
    policy = make_policy(config, IMAGE)
    flat = policy.init(jax.random.key(0))
    image = np.random.default_rng(0).integers(0, 256, (9, 40, 40, 2)).astype(np.uint8)

    @jax.jit
    def gradient(x):
        return jax.grad(lambda flat: (policy.apply(flat, x).value ** 2).mean())(flat)

    of_bytes, of_shares = gradient(image), gradient(image.astype(np.float32) / 255.0)
    assert np.abs(of_bytes).max() > 0
    np.testing.assert_allclose(of_bytes, of_shares, rtol=1e-4, atol=1e-5)


def test_named_parameters_go_round() -> None:
    policy, _ = tree()
    flat = policy.init(jax.random.key(3))
    named = named_params(policy, flat)
    assert named["policy_trunk/layer_0/kernel"].shape == (11, 64)
    np.testing.assert_array_equal(flat_params(policy, jnp.zeros_like(flat), named), flat)


@pytest.mark.parametrize("trunk", ["separate", "shared"])
def test_a_users_own_module_trains(trunk: str) -> None:
    job = make_job("small_envs:Scripted", network="trunks:Sine", trunk=trunk)
    final = train_here(job).final
    part = "trunk" if trunk == "shared" else "policy_trunk"
    assert final[f"sauna/0/params/{part}/inner/kernel"].shape == (3, 7)


def test_something_else_than_a_module_is_refused() -> None:
    config = dataclasses.replace(configured(), network="numpy:sin")
    with pytest.raises(BadInput, match=r"numpy:sin is not a flax\.linen module"):
        make_policy(config, VECTOR)


def test_images_train_end_to_end() -> None:
    job = make_job(
        "small_envs:Picture",
        arm="vex-head",
        network="nature-cnn",
        rollout_steps=8,
        minibatches=2,
        epochs=1,
        steps=16,
        trunk="shared",
    )
    assert not job.config.normalize_observations
    recorder = train_here(job)
    assert recorder.final["vex-head/0/collect/observation"].dtype == np.uint8
    assert len(recorder.rows) == 2


def test_gaussian_is_scipys() -> None:
    rng = np.random.default_rng(0)
    mean, log_std, action = rng.normal(size=(3, 20, 4))
    parameters = np.concatenate([mean, log_std * 0.5], -1).astype(np.float32)
    distribution, std = gaussian(4), np.exp(log_std * 0.5)
    expected = stats.norm(mean, std).logpdf(action).sum(-1)
    got = distribution.log_prob(parameters, action.astype(np.float32))
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)
    entropy = stats.norm(mean, std).entropy().sum(-1)
    np.testing.assert_allclose(distribution.entropy(parameters), entropy, rtol=1e-5)
    np.testing.assert_allclose(distribution.mode(parameters), mean, atol=1e-6)
    np.testing.assert_allclose(
        distribution.sample(parameters, np.ones((20, 4))), mean + std, rtol=1e-5, atol=1e-6
    )


def test_categoricals_are_scipys_and_sample_their_probabilities() -> None:
    rng = np.random.default_rng(1)
    logits = rng.normal(size=5).astype(np.float32)
    distribution = multi_categorical((2, 3))
    p = [np.exp(part) / np.exp(part).sum() for part in (logits[:2], logits[2:])]
    for i in range(2):
        for j in range(3):
            got = distribution.log_prob(logits, np.array([i, j]))
            assert float(got) == pytest.approx(math.log(p[0][i] * p[1][j]), abs=1e-5)
    expected = stats.entropy(p[0]) + stats.entropy(p[1])
    assert float(distribution.entropy(logits)) == pytest.approx(expected, abs=1e-5)
    noise = distribution.draw(jax.random.key(0), (20_000,))
    actions = np.asarray(distribution.sample(logits, noise))
    for part in range(2):
        frequency = np.bincount(actions[:, part]) / 20_000
        np.testing.assert_allclose(frequency, p[part], atol=0.015)
    np.testing.assert_array_equal(distribution.mode(logits), [p[0].argmax(), p[1].argmax()])


def test_bernoulli_is_scipys_and_samples_its_probabilities() -> None:
    logits = np.array([-1.0, 0.5, 3.0], np.float32)
    p, distribution = 1 / (1 + np.exp(-logits)), bernoulli(3)
    bits = np.array([1, 0, 1])
    expected = stats.bernoulli(p).logpmf(bits).sum()
    assert float(distribution.log_prob(logits, bits)) == pytest.approx(expected, abs=1e-5)
    expected = stats.bernoulli(p).entropy().sum()
    assert float(distribution.entropy(logits)) == pytest.approx(expected, abs=1e-5)
    noise = distribution.draw(jax.random.key(0), (20_000,))
    frequency = np.asarray(distribution.sample(logits, noise)).mean(0)
    np.testing.assert_allclose(frequency, p, atol=0.015)
