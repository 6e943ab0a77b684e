"""The compiled parts of acting choose as numpy does."""

from __future__ import annotations

import numpy as np

from helpers import configured
from sauna.algorithm.rollout.actor import _sampler
from sauna.envs.spaces import Spaces


def test_the_largest_logit_of_each_choice_is_numpys() -> None:
    sizes = (2, 1, 4)
    spaces = Spaces("vector", (1,), "multi_discrete", sizes, (), ())
    choose = _sampler(configured(), spaces)
    logits = np.random.default_rng(0).integers(-2, 3, (3, 50, 7)).astype(np.float32)  # with ties
    logits[0, ::5] = np.nan
    logits[1, ::7, 4] = np.nan
    logits[2, ::6, 5] = np.inf
    parts = np.split(logits, np.cumsum(sizes)[:-1], -1)
    expected = np.stack([part.argmax(-1) for part in parts], -1)
    chosen = choose(logits, logits)
    assert chosen.dtype == np.int32
    np.testing.assert_array_equal(chosen, expected)
