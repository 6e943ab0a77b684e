"""Identities that hold whatever the numbers are."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as drawn_arrays

from arrays import no_key, random_rollout
from helpers import configured
from sauna.algorithm.learner.program import make_learner
from sauna.algorithm.learner.update import minibatch_order
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.types import Hypers, member_keys
from sauna.envs.spaces import Spaces
from sauna.system import checkpoint

CONFIG = configured(rollout_steps=40, envs=3, minibatches=4, epochs=2, hidden="5", arm="sauna")
SPACES = Spaces("vector", (2,), "continuous", (1,), "", "")
LEARNER = make_learner(CONFIG, make_policy(CONFIG, SPACES), SPACES)
HYPERS = {**dict.fromkeys(Hypers._fields, 0.1), "gamma": 0.9, "gae_lambda": 0.8}


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["all", "one", "none", "a few"]))
def test_an_update_stays_finite_however_much_is_kept(seed: int, kept: str) -> None:
    rollout = random_rollout(seed)
    keep, rng = rollout.keep, np.random.default_rng(seed)
    share = {"all": 1.0, "one": 0.0, "none": 0.0, "a few": 0.05}[kept]
    keep[:] = rng.random(keep.shape) < share
    if kept == "one":
        keep[rng.integers(40), rng.integers(3)] = True
    single = lambda x: jnp.asarray(x, np.float32 if x.dtype == float else None)  # noqa: E731
    rollout = jax.tree.map(single, rollout)
    hypers = Hypers(**{name: np.float32(value) for name, value in HYPERS.items()})
    state = LEARNER.init(member_keys(seed).init)
    order = minibatch_order(CONFIG, seed, 0)
    batch = LEARNER.make_batch(rollout, hypers, no_key())
    state, metrics = LEARNER.learn(state, rollout, batch, hypers, order, no_key())
    assert bool(metrics.finite)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))


finite = st.sampled_from([np.float32, np.float64, np.int64, np.uint8, np.bool_]).flatmap(
    lambda dtype: drawn_arrays.arrays(
        dtype,
        drawn_arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
        elements={"allow_nan": False, "allow_infinity": False}
        if np.issubdtype(dtype, np.floating)
        else None,
    )
)


@settings(max_examples=40, deadline=None)
@given(st.dictionaries(st.text("abc/0", min_size=1, max_size=6), finite, max_size=5))
def test_saved_loaded_and_saved_again_is_the_same_file(tmp_path_factory, state: dict) -> None:
    folder = tmp_path_factory.mktemp("saved")
    first = checkpoint.save_checkpoint(folder / "one", 4, state, {"logs": {"m": 3}}, 1)
    loaded = checkpoint.load_checkpoint(first)
    assert loaded.arrays.keys() == state.keys()
    again = checkpoint.save_checkpoint(folder / "two", 4, loaded.arrays, {"logs": {"m": 3}}, 1)
    for name in ("state.safetensors", "manifest.json"):
        assert (first / name).read_bytes() == (again / name).read_bytes()
