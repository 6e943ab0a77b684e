"""Spaces: what is taken and as what numbers, what is refused, and actions stretched to a box."""

from __future__ import annotations

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces as gym

from sauna.config.presets import resolve
from sauna.config.settings import to_json
from sauna.config.stored import stored_config
from sauna.envs.actions import action_reader, action_writer
from sauna.envs.device.contract import _reader, _writer
from sauna.envs.spaces import board_of, describe, observation_reader, read_spaces
from sauna.system.errors import BadInput

TWO = gym.Discrete(2)


def box(*shape: int, dtype: Any = np.float32, high: float = 1.0) -> gym.Box:
    return gym.Box(0, high, shape, dtype)


BY_HAND = [
    (gym.Tuple((gym.Discrete(3), gym.Discrete(2))), (2, 0), [0, 0, 1, 1, 0]),
    (gym.Discrete(3, start=5), 6, [0, 1, 0]),
    (gym.MultiDiscrete([2, 3], start=[1, 4]), np.array([2, 4]), [0, 1, 1, 0, 0]),
    (gym.MultiDiscrete([[2, 2]]), np.array([[1, 0]]), [0, 1, 1, 0]),
    (gym.MultiBinary((2, 2)), np.array([[1, 0], [1, 1]], np.int8), [1, 0, 1, 1]),
    (
        gym.Dict({"b": gym.Dict({"x": box(2), "y": gym.Discrete(2, start=-1)}), "a": box(1)}),
        {"a": np.array([0.5]), "b": {"x": np.array([0.25, 0.75]), "y": -1}},
        [0.5, 0.25, 0.75, 1, 0],
    ),
    (
        gym.Dict({"board": box(2, 2, dtype=np.uint8, high=9), "turn": gym.MultiBinary(1)}),
        {"board": np.array([[1, 2], [3, 9]], np.uint8), "turn": np.array([1], np.int8)},
        [1, 2, 3, 9, 1],
    ),
]


@pytest.mark.parametrize("space, value, expected", BY_HAND, ids=[str(b[0])[:40] for b in BY_HAND])
def test_observations_are_the_numbers_by_hand_on_host_and_device(space, value, expected) -> None:
    found = describe(space, TWO)
    assert found.observation_shape == (len(expected),)
    assert found.observation_kind in ("vector", "one_hot")
    np.testing.assert_array_equal(observation_reader(space)(value), expected)
    np.testing.assert_array_equal(jax.jit(_reader(space))(value), expected)


REFUSED = [
    (gym.Dict({"state": box(4), "camera": box(84, 84, 3)}), "['camera']"),
    (gym.Dict({"far": gym.Tuple((box(1), box(3, 64, 64)))}), "['far'][1]"),
    (gym.Dict({"goal": gym.Text(4)}), "['goal']: Text is not supported"),
    (gym.Tuple((TWO, gym.Sequence(box(1)))), "[1]: Sequence is not supported"),
    (
        box(84, 84, 3, high=2.0),
        "(84, 84, 3) and type float32 are not supported (only uint8 is, and a Box of floats from 0",
    ),
    (box(60, 80, dtype=np.float64, high=2.0), "give bytes up to 255 as uint8 [H, W, C]"),
    (box(4, 84, 84, 1, dtype=np.uint8, high=255), "give a stack as uint8 [H, W, frames x C]"),
]


@pytest.mark.parametrize("space, words", REFUSED, ids=[r[1] for r in REFUSED])
def test_what_would_become_a_long_vector_is_refused_with_what_to_do(space, words) -> None:
    with pytest.raises(BadInput) as error:
        describe(space, TWO)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_pictures_in_a_dict_stand_behind_the_numbers_on_host_and_device() -> None:
    space = gym.Dict(
        {
            "camera": box(40, 36, 3, dtype=np.uint8, high=255),
            "deep": gym.Tuple((gym.Discrete(2), box(2, 36, 40, dtype=np.uint8, high=9))),
            "map": box(5, 5, dtype=np.uint8, high=255),
            "state": box(2),
        }
    )
    found, one = describe(space, TWO), space.sample()
    numbers = [*np.eye(2)[one["deep"][0]], *one["map"].ravel(), *one["state"]]
    assert (found.observation_kind, found.numbers, found.normalized) == ("vector", 29, 29)
    assert found.pictures == ((40, 36, 3, 255.0), (36, 40, 2, 9.0)) and found.is_combined
    seen = observation_reader(space)(one)
    assert seen.shape == found.observation_shape == (29 + 40 * 36 * 3 + 36 * 40 * 2,)
    np.testing.assert_array_equal(seen[:29], numbers)
    stack = np.moveaxis(one["deep"][1], 0, -1)  # frames in front, as a picture alone has it
    np.testing.assert_array_equal(seen[29:], [*one["camera"].ravel(), *stack.ravel()])
    np.testing.assert_array_equal(jax.jit(_reader(space))(one), seen.astype(np.float32))
    assert read_spaces(json.loads(json.dumps(list(found)))) == found


@pytest.mark.parametrize(
    "changed", [{"pictures": ((1, 2, -1, 1.0),)}, {"mask": 40}, {"pictures": ((9, 9, 9, 1.0),)}]
)
def test_parts_without_a_place_are_no_spaces(changed: dict[str, Any]) -> None:
    spaces = describe(box(30), TWO)
    with pytest.raises(ValueError):
        read_spaces(list(spaces._replace(**changed)))


def test_small_boards_and_masks_are_images_that_know_their_highest_byte() -> None:
    for high, shape in ((3, (5, 5)), (1, (48, 48, 2)), (255, (40, 40, 3))):
        found = describe(box(*shape, dtype=np.uint8, high=high), TWO)
        assert (found.observation_kind, found.observation_high) == ("image", high)
        assert found.observation_shape == (*shape, 1)[:3]
    stored = list(found)[:-4]  # as runs before have it
    assert read_spaces(stored) == found


def test_large_pictures_of_floats_in_0_to_1_are_pictures_and_small_ones_boards() -> None:
    random = np.random.default_rng(0)
    for shape, turned in (((3, 40, 36), (40, 36, 3)), ((36, 36), (36, 36, 1))):
        space, seen = box(*shape), random.random(shape)
        found = describe(space, TWO)
        assert (found.observation_kind, found.observation_shape) == ("float_image", turned)
        assert found.observation_dtype == np.float32 and board_of(found) == ()
        expected = np.moveaxis(seen, 0, -1) if len(shape) == 3 else seen[..., None]
        np.testing.assert_array_equal(observation_reader(space)(seen), expected)
        np.testing.assert_allclose(_reader(space)(jnp.asarray(seen)), expected, rtol=1e-6)
    small = describe(box(4, 10, 10), TWO)
    assert (small.observation_kind, board_of(small)) == ("vector", (4, 10, 10))
    for other in (box(400), gym.Tuple((box(4, 5),)), box(5, 5, dtype=np.uint8, high=3)):
        assert board_of(describe(other, TWO)) == ()
    assert board_of(small._replace(observation_structure=("Box", 3, 10, 10))) == ()
    assert board_of(small._replace(observation_structure="Box")) == ()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("low, high", [(0, 1000), (-0.01, 0.01), (0, 1), (-3, 3)])
def test_a_bounded_box_is_reached_from_minus_one_to_one(low, high, dtype) -> None:
    space = gym.Box(low, high, (1, 3), dtype)
    write = action_writer(space, rescale=True)
    action = np.array([-1.0, 0.5, 7.0], np.float32)
    expected = [[low, low + 0.75 * (high - low), high]]
    np.testing.assert_allclose(write(action), expected, rtol=1e-6, atol=1e-9)
    assert space.contains(write(action))
    on_device = np.asarray(jax.jit(_writer(space, True))(action))
    np.testing.assert_allclose(on_device, expected, rtol=1e-5, atol=1e-7)


def test_components_without_both_bounds_stay_as_they_are() -> None:
    """Infinite bounds, and those of a float's range, which stand for none."""
    most = np.finfo(np.float32).max
    low = np.array([0, -np.inf, 0, -most, 2], np.float32)
    high = np.array([10, np.inf, np.inf, most, 2], np.float32)
    action = np.array([-1, -50, 30, 40, 5], np.float32)
    got = action_writer(gym.Box(low, high), rescale=True)(action)
    np.testing.assert_allclose(got, [0, -50, 30, 40, 2])


def test_boxes_of_minus_one_to_one_have_the_same_bits() -> None:
    space = gym.Box(-1, 1, (4,), np.float32)
    actions = np.random.default_rng(0).normal(size=(500, 4)).astype(np.float32) * 2
    one, other = action_writer(space, True), action_writer(space, False)
    assert all(one(action).tobytes() == other(action).tobytes() for action in actions)


def test_mujoco_and_stored_runs_keep_what_was_done_before() -> None:
    for env in ("InvertedPendulum-v5", "Humanoid-v4", "mjx/Pusher-v5", "gymnasium:Hopper-v5"):
        assert not resolve({"env": env}).rescale_actions
        assert resolve({"env": env, "rescale_actions": True}).rescale_actions
    for env in ("Pendulum-v1", "module:Humanoid", "gymnax/Pendulum-v1", "HumanoidMaze-v5"):
        assert resolve({"env": env}).rescale_actions
    stored = to_json(resolve({"env": "Pendulum-v1"}))
    assert stored_config(stored).rescale_actions
    del stored["rescale_actions"]
    assert not stored_config(stored).rescale_actions


@pytest.mark.parametrize("rescale", [False, True])
@pytest.mark.parametrize(
    "space, actions",
    [
        (gym.Box(-2.0, 6.0, (2,), np.float32), np.array([[0.25, -1.0], [1.0, 0.5]], np.float32)),
        (gym.Box(-np.inf, np.inf, (2, 1)), np.array([[30.0, -4.0]], np.float32)),
        (gym.Discrete(3, start=-1), np.array([[0], [2]])),
        (gym.MultiDiscrete([2, 3], start=[1, 4]), np.array([[1, 2], [0, 0]])),
        (gym.MultiBinary(3), np.array([[1, 0, 1]])),
    ],
)
def test_what_an_environment_took_is_read_back_as_the_network_gave_it(
    space, actions, rescale
) -> None:
    write, read = action_writer(space, rescale), action_reader(space, rescale)
    taken = np.stack([np.asarray(write(action)) for action in actions])
    np.testing.assert_allclose(read(taken), actions, rtol=1e-6)


def test_choices_that_a_space_does_not_have_are_refused() -> None:
    for space, taken in (
        (gym.Discrete(3, start=2), [1]),
        (gym.Discrete(3), [3]),
        (gym.Discrete(3), [0.5]),
        (gym.MultiDiscrete([2, 2]), [[0, 2]]),
        (gym.MultiDiscrete([2, 2]), [[0, 1, 1]]),
        (gym.MultiBinary(2), [[0, 2]]),
    ):
        with pytest.raises(ValueError, match="its actions are none of"):
            action_reader(space)(np.array(taken))


def test_a_prepared_reader_flattens_as_gymnasium_does() -> None:
    space = gym.Dict(
        {
            "b": gym.Box(-1, 1, (2, 2), np.float32),
            "a": gym.Tuple((gym.Discrete(3, start=-1), gym.MultiBinary((2, 2)))),
            "c": gym.MultiDiscrete([[2, 3], [4, 2]]),
            "d": gym.Box(0, 9, (), np.int64),
        }
    )
    read = observation_reader(space)
    for seed in range(20):
        space.seed(seed)
        seen = space.sample()
        expected = gym.flatten(space, seen)
        assert (read(seen).dtype, read(seen).tobytes()) == (expected.dtype, expected.tobytes())
    small = gym.Dict({"x": gym.Box(-1, 1, (2,), np.float32), "n": gym.Discrete(3)})
    read, seen = observation_reader(small), {"x": np.array([1 / 3, 0.1]), "n": 2}
    expected = gym.flatten(small, seen)  # float64 is rounded as the space says
    assert (read(seen).dtype, read(seen).tobytes()) == (expected.dtype, expected.tobytes())
    for wrong in ({**seen, "n": 3}, {**seen, "x": 1}, {**seen, "x": np.zeros(3)}, {"n": 2}):
        with pytest.raises((IndexError, ValueError)):
            read(wrong)
