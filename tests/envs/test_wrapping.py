"""What is put around environments: a user's wrappers, and the last observations as one."""

from __future__ import annotations

import copy
import json

import jax
import numpy as np
import pytest
from gymnasium import spaces as gym

import jax_envs
import sauna
import wrappers
from helpers import equal, make_job, resumed, train_here
from sauna.config.trust import named_code
from sauna.envs.device.as_gymnasium import HostFace
from sauna.envs.device.stacked import stacked
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs
from sauna.envs.make import in_process_envs, make_env
from sauna.envs.masked import MaskedEnv
from sauna.envs.spaces import describe, difference, read_spaces
from sauna.envs.stacked import StackedEnv, StackedSpace
from sauna.envs.wrapping import Wrapping, read_wrapping
from sauna.system.errors import BadInput
from small_envs import Finite, Picture

ORDERED = ("wrappers:Double", "wrappers:plus_one")
FRAMES = [[0, 1, 0, 1, 0, 1], [0, 1, 0, 1, 20, 21], [0, 1, 20, 21, 40, 41]]


def test_the_last_observations_are_one_also_at_both_ends_of_an_episode() -> None:
    env = StackedEnv(Finite(), 3)
    for _ in range(2):
        assert env.reset(seed=1)[0].tolist() == [0, 0, 0]
        seen = [env.step(0)[0].tolist() for _ in range(5)]
        assert seen == [[0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]]
    envs = in_process_envs("small_envs:Finite", {}, [(0, 0)], "auto", wrapping=Wrapping(stack=2))
    envs.reset()
    for _ in range(5):
        step = envs.step(np.zeros((1, 1), np.int32), np.ones(1, bool))
    assert step.final_observation.tolist() == [[4, 5]] and step.observation.tolist() == [[0, 0]]


def test_an_observation_of_another_shape_is_not_stretched_into_a_stack() -> None:
    class Shrinking(Finite):
        def observe(self):
            return super().observe()[:0] if self.t == 2 else super().observe()

    env = StackedEnv(Shrinking(), 3)
    env.reset(seed=1)
    env.step(0)
    with pytest.raises(ValueError, match=r"is of shape \(0,\) instead of \(1,\)"):
        env.step(0)


def test_wrapped_environments_can_be_copied() -> None:
    for env in (StackedEnv(Finite(), 3), MaskedEnv(Finite())):
        again = copy.deepcopy(env)
        assert again.observation_space == env.observation_space


def test_a_learner_sees_a_stack_as_any_box_of_its_shape() -> None:
    """Of a dataset, which holds a plain box, and of a policy that was trained on one."""
    action, one = gym.Discrete(2), gym.Box(-1, 1, (3,), np.float32)
    stack = describe(StackedSpace(one, action, 3), action)
    box, other = (describe(gym.Box(-np.inf, np.inf, (n,)), action) for n in (9, 8))
    assert difference(box, stack) == "" and difference(other, stack)
    before = stack._replace(observation_structure=("StackedSpace", 9))
    assert read_spaces(json.loads(json.dumps(before))) == stack


def test_the_device_stacks_as_the_host_does() -> None:
    one = jax_envs.walk
    ours, theirs = stacked(one, 3), StackedEnv(HostFace(one), 3)
    assert isinstance(ours.observation_space, StackedSpace)
    assert ours.observation_space == theirs.observation_space and stacked(one, 1) is one
    face = HostFace(ours)
    np.testing.assert_array_equal(face.reset(seed=4)[0], theirs.reset(seed=4)[0])
    assert np.ptp(face.reset(seed=4)[0].reshape(3, -1), 0).max() == 0
    theirs.reset(seed=4)
    action = one.action_space.sample()
    for _ in range(4):
        np.testing.assert_array_equal(face.step(action)[0], theirs.step(action)[0])
    state, _ = jax.jit(ours.reset)(jax.random.key(0))
    assert jax.tree.structure(state) == jax.tree.structure(ours.step(state, action).state)


@pytest.mark.slow
@pytest.mark.parametrize("place", ["host", "device"])
def test_stacked_observations_train_are_evaluated_and_resume_exactly(place: str) -> None:
    env = {"host": "small_envs:Scripted", "device": "jax_envs:walk"}[place]
    job = make_job(env, arm="ppo", stack=3, eval_every=64, eval_episodes=1)
    width = make_job(env, arm="ppo").spaces.observation_shape[0]
    assert job.spaces.observation_shape == (3 * width,)
    whole, first = train_here(job), train_here(job, 2)
    again = train_here(resumed(job, first))
    assert equal(again.final, whole.final) and first.rows + again.rows == whole.rows
    kernel = whole.final["ppo/0/params/policy_trunk/layer_0/kernel"]
    assert kernel.shape[0] == 3 * width and "eval_return_mean" in whole.rows[-1]


def test_a_policy_makes_the_environment_that_it_was_trained_on(tmp_path) -> None:
    settings = {"steps": 64, "rollout_steps": 32, "minibatches": 4, "hidden": "4"}
    env = {"stack": 2, "wrap": [wrappers.Double], "out": tmp_path / "run"}
    policy = sauna.train("small_envs:TwoSteps", arm="ppo", quiet=True, **settings, **env).policy()
    made = policy.make_env()
    seen, _ = made.reset(seed=0)
    assert seen.tolist() == [0, 0] and policy(seen) in (0, 1)
    made.step(0)
    assert made.step(0)[1] == 2.0


def test_the_channels_of_pictures_stand_side_by_side() -> None:
    """The pictures `[2, 40, 40]` of step t have 20 t and 20 t + 1 as their two channels."""
    env = StackedEnv(Picture(), 3)
    kind = describe(env.observation_space, env.action_space)
    assert (kind.observation_kind, kind.observation_shape) == ("image", (40, 40, 6))
    for _ in range(2):
        seen = [env.reset(seed=1)[0], *(env.step(5)[0] for _ in range(2))]
        for picture, channels in zip(seen, FRAMES, strict=True):
            assert picture.dtype == np.uint8 and picture.shape == (40, 40, 6)
            assert np.unique(picture.reshape(-1, 6), axis=0).tolist() == [channels]
    with pytest.raises(BadInput, match="stack: 8 channels of 5 x 7 pixels would be read as"):
        StackedSpace(gym.Box(0, 255, (5, 7, 4), np.uint8), gym.Discrete(2), 2)
    made = StackedSpace(gym.Box(0.0, 1.0, (40, 40), np.float32), gym.Discrete(2), 2)
    assert describe(made, gym.Discrete(2)).observation_kind == "float_image"


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_the_device_stacks_pictures_as_the_host_does(kind: str) -> None:
    one = jax_envs.shade(kind)
    face, theirs = HostFace(stacked(one, 3)), StackedEnv(HostFace(one), 3)
    assert face.observation_space == theirs.observation_space
    pairs = [(face.reset(seed=4)[0], theirs.reset(seed=4)[0])]
    pairs += [(face.step(1)[0], theirs.step(1)[0]) for _ in range(3)]
    for ours, other in pairs:
        assert ours.dtype == other.dtype == kind and ours.shape == (40, 40, 3)
        np.testing.assert_array_equal(ours, other)
    assert len(np.unique(pairs[-1][0])) == 3


@pytest.mark.slow
@pytest.mark.parametrize("place", ["host", "device"])
def test_stacked_pictures_train_and_resume_exactly(place: str) -> None:
    env = {"host": "small_envs:Picture", "device": "jax_envs:shade"}[place]
    job = make_job(env, arm="ppo", stack=2, network="auto")
    whole, first = train_here(job), train_here(job, 2)
    again = train_here(resumed(job, first))
    assert equal(again.final, whole.final) and first.rows + again.rows == whole.rows
    channels = {"host": 4, "device": 2}[place]
    assert whole.final["ppo/0/params/policy_trunk/conv_0/kernel"].shape[2] == channels


def test_a_users_wrappers_go_around_every_environment_in_their_order() -> None:
    """Twice the reward, and one more; in training and in evaluations."""
    job = make_job(
        "small_envs:TwoSteps",
        arm="ppo",
        normalize_rewards="no",
        wrap=",".join(ORDERED),
        eval_every=128,
        eval_episodes=1,
    )
    found = train_here(job)
    assert set(found.rows[-1]["episode_returns"]) == {4.0}  # (2 * 0 + 1) + (2 * 1 + 1), of 0 and 1
    assert found.rows[-1]["eval_returns"] == [4.0]
    envs = in_process_envs("Hopper-v5", {}, [(0, 0)], "auto", wrapping=Wrapping(ORDERED))
    assert type(envs) is GymnasiumEnvs
    envs.close()
    assert read_wrapping({"wrap": list(ORDERED), "stack": 2}) == Wrapping(ORDERED, 2)


REFUSED = [
    ({"wrap": "wrappers:nothing"}, "wrap: wrappers:nothing gives no environment, but NoneType"),
    ({"wrap": "wrappers:broken"}, "wrap: wrappers:broken cannot wrap the environment: .*no such"),
    ({"wrap": "wrappers:NUMBER"}, "wrap: wrappers:NUMBER cannot be called"),
    ({"wrap": "wrappers:Dubble"}, "wrap: module 'wrappers' has no 'Dubble'.*Double"),
    ({"wrap": "wrappers"}, "wrap: 'wrappers' is no module:function"),
    ({"wrap": "sauna.config.local:f_0"}, "wrap: a wrapper has to be importable"),
    ({"env": "jax_envs:walk", "wrap": ORDERED[0]}, "wrap: not read by arm ppo; .* on the host"),
    ({"env": "vector_envs:same", "wrap": ORDERED[0]}, "wrap: the rows of vector_envs:same are"),
    ({"env": "vector_envs:Agents", "stack": 2}, "stack: the rows of vector_envs:Agents are"),
    ({"env": "small_envs:Camera", "stack": 2}, "stack: a Dict or Tuple with pictures is not"),
    ({"env": "ALE/Pong-v5", "stack": 2}, "stack: .* Atari game is its last four frames already"),
]


@pytest.mark.parametrize("settings, words", REFUSED, ids=[str(r[0]) for r in REFUSED])
def test_a_wrapper_that_cannot_be_used_is_refused_in_a_line(settings: dict, words: str) -> None:
    with pytest.raises(BadInput, match=words) as error:
        make_job(**{"env": "small_envs:TwoSteps", "arm": "ppo", **settings})
    assert "\n" not in str(error.value)


def test_wrappers_that_somebody_else_named_need_trust() -> None:
    stored = {"config": {"env": "CartPole-v1", "wrap": ["theirs:Wrapper"], "stack": 2}}
    assert named_code(stored) == [["wrap", "theirs:Wrapper"]]


def test_the_plain_form_of_an_environment_is_wrapped_too() -> None:
    env = make_env("small_envs:TwoSteps", {}, Wrapping(ORDERED, stack=2))
    assert env.reset(seed=0)[0].tolist() == [0, 0]
    assert env.step(0)[:2][1] == 1.0 and env.unwrapped.__class__.__name__ == "TwoSteps"
