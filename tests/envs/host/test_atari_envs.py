"""Atari on ale-py: against ale-py's emulator stepped frame by frame, and against itself."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable

import ale_py
import numpy as np
import pytest
from ale_py import roms
from ale_py.vector_env import AtariVectorEnv

from helpers import assert_same_step, equal, make_job, resumed, train_here
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import make_program
from sauna.algorithm.types import Hypers, member_keys
from sauna.envs.host.atari_envs import AtariEnv, AtariEnvs, game_of
from sauna.envs.host.contract import HostEnvs, episode_seed
from sauna.envs.make import env_maker, in_process_envs, make_env
from sauna.envs.probe import probe
from sauna.envs.workers import ProcessEnvs
from sauna.system.errors import BadInput
from sauna.training.loop.host import make_envs

BREAKOUT = "ALE/Breakout-v5"
SEEDS = [(3, 0), (5, 1)]
BOTH = np.ones(2, bool)
STICKY = {"repeat_action_probability": 0.25}


def played(number: int, seed: int = 0) -> np.ndarray:
    """Actions `[number, 2, 1]` of Breakout, FIRE among them."""
    return np.random.default_rng(seed).integers(0, 4, (number, 2, 1)).astype(np.int32)


class Emulator:
    """The game frame by frame on ale-py's plain interface, seen as the papers say."""

    def __init__(self, game: str, seed: int, frames: int) -> None:
        self.ale = ale_py.ALEInterface()
        self.ale.setInt("random_seed", seed)
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.loadROM(roms.get_rom_path(game))
        self.ale.reset_game()
        self.ale.act(ale_py.Action.FIRE)
        for _ in range(frames - 1):
            self.ale.act(ale_py.Action.NOOP)

    def step(self, action: ale_py.Action) -> tuple[np.ndarray, float]:
        """The larger of the last two frames, 84 x 84, and the reward of all four."""
        frames, reward = [], 0.0
        for _ in range(4):
            reward += self.ale.act(action)
            frames.append(self.ale.getScreenGrayscale())
        return shrunk(np.maximum(*frames[-2:])), reward

    def sees(self) -> np.ndarray:
        return shrunk(self.ale.getScreenGrayscale())


def shrunk(picture: np.ndarray) -> np.ndarray:
    """84 x 84: each pixel the mean of the area that it covers."""

    def weights(before: int) -> np.ndarray:
        edges = np.linspace(0, before, 85)
        left, right = (
            np.maximum(edges[:-1, None], np.arange(before)),
            np.minimum(edges[1:, None], np.arange(before) + 1),
        )
        return np.maximum(right - left, 0) / (before / 84)

    return weights(210) @ picture @ weights(160).T


def test_a_step_is_the_published_preprocessing() -> None:
    """Four frames, the larger of the last two, grey, 84 x 84, the newest of four steps last."""
    env = AtariEnv("asteroids", render_mode="rgb_array")
    observation, info = env.reset(seed=11)
    emulator = Emulator("asteroids", 11, info["frames"])
    assert observation.shape == (4, 84, 84) and observation.dtype == np.uint8
    np.testing.assert_allclose(observation[3], emulator.sees(), atol=1)
    assert not observation[:3].any(), "nothing was seen before"
    meanings, most, blinked = emulator.ale.getMinimalActionSet(), 0.0, 0.0
    for action in played(24)[:, 0, 0].tolist():
        before = observation
        observation, reward, *_ = env.step(action)
        expected, raw = emulator.step(meanings[action])
        np.testing.assert_allclose(observation[3], expected, atol=1)
        np.testing.assert_array_equal(observation[:3], before[1:])
        np.testing.assert_array_equal(env.render(), emulator.ale.getScreenRGB())
        assert reward == raw
        most, blinked = max(most, raw), max(blinked, np.abs(emulator.sees() - expected).max())
    assert most > 1, "rewards are not clipped"
    assert blinked > 20, "the last frame alone is another picture"
    env.close()


def test_frames_before_the_first_observation_are_bounded_and_drawn() -> None:
    def frames(seeds: int, **settings: object) -> set[int]:
        env = AtariEnv("pong", **settings)  # type: ignore[arg-type]
        return {env.reset(seed=seed)[1]["frames"] for seed in range(seeds)}

    some = frames(6, noop_max=4)
    assert len(some) > 1 and some <= {1, 2, 3, 4}
    assert frames(2, noop_max=0) == {1}, "FIRE alone"
    assert frames(2, noop_max=0, use_fire_reset=False) == {0}


def make_here(**kwargs: object) -> HostEnvs:
    return in_process_envs(BREAKOUT, kwargs, SEEDS, "auto")


def make_with_gymnasium(**kwargs: object) -> HostEnvs:
    return in_process_envs(BREAKOUT, kwargs, SEEDS, "gymnasium")


def make_in_a_worker(**kwargs: object) -> HostEnvs:
    return ProcessEnvs(BREAKOUT, kwargs, SEEDS, processes=1, timeout=60.0)


@pytest.mark.parametrize(
    "make", [make_with_gymnasium, pytest.param(make_in_a_worker, marks=pytest.mark.slow)]
)
def test_all_backends_step_alike(make: Callable[..., HostEnvs]) -> None:
    """Observations, raw rewards, lost lives, ends, and games that stand still."""
    envs, other = make_here(), make()
    assert isinstance(envs, AtariEnvs)
    assert envs.spaces.observation_shape == (84, 84, 4)
    before = envs.reset()
    assert before.dtype == np.uint8
    np.testing.assert_array_equal(before, other.reset())
    lost, over = 0, 0
    for t, row in enumerate(played(300)):
        active = np.array([True, t % 4 != 0])
        one, two = envs.step(row, active), other.step(row, active)
        assert_same_step(one, two)
        np.testing.assert_array_equal(one.life_lost, two.life_lost)
        np.testing.assert_array_equal(one.observation[~active], before[~active])
        before = np.array(one.observation)
        assert one.ended == bool((one.terminated | one.truncated | one.life_lost).any())
        lost, over = lost + one.life_lost[0], over + one.terminated[0]
    assert over >= 1 and 4 * over <= lost < 4 * (over + 1), "four lives lost, the fifth is the end"
    envs.close()
    other.close()


def test_the_seeds_are_the_episodes_own() -> None:
    """Against ale-py's vector environment as it comes: both games, from the same seeds."""
    envs = make_here()
    seeds = np.array([episode_seed(*pair, 0) % 2**31 for pair in SEEDS])
    plain = AtariVectorEnv("breakout", 2, reward_clipping=False, noop_max=31)
    np.testing.assert_array_equal(np.moveaxis(plain.reset(seed=seeds)[0], 1, -1), envs.reset())
    for row in played(20):
        observation, reward, *_ = plain.step(row[:, 0])
        step = envs.step(row, BOTH)
        np.testing.assert_array_equal(np.moveaxis(observation, 1, -1), step.observation)
        np.testing.assert_array_equal(reward, step.reward)


def test_a_restored_game_goes_on_bit_for_bit() -> None:
    """With sticky actions, which draw from the emulator's own generator, over a lost life."""
    envs, again = make_here(**STICKY), make_here(**STICKY)
    envs.reset()
    again.reset()
    lost = 0
    for row in played(60):
        step = envs.step(row, BOTH)
        lost += step.life_lost.sum()
    assert lost
    for i in range(2):
        np.testing.assert_array_equal(again.restore(i, envs.snapshot(i)), step.observation[i])
    for row in played(30, 1):
        one, two = envs.step(row, BOTH), again.step(row, BOTH)
        assert_same_step(one, two)
        np.testing.assert_array_equal(one.life_lost, two.life_lost)


def test_actions_stick_only_where_asked() -> None:
    def pictures(**settings: float) -> np.ndarray:
        env = AtariEnv("breakout", **settings)  # type: ignore[arg-type]
        env.reset(seed=4)
        return np.stack([env.step(action)[0] for action in played(30)[:, 0, 0]])

    plain, sticky = pictures(), pictures(**STICKY)
    np.testing.assert_array_equal(plain, pictures(repeat_action_probability=0.0))
    assert not np.array_equal(plain, sticky)
    np.testing.assert_array_equal(sticky, pictures(**STICKY))


def test_a_time_limit_shows_what_was_reached() -> None:
    """ale-py's own limit, as a control, shows a frame of the step before in it."""
    limited = in_process_envs(BREAKOUT, {"max_num_frames_per_episode": 43}, [(3, 0)], "auto")
    free = in_process_envs(BREAKOUT, {}, [(3, 0)], "auto")
    seed = np.array([episode_seed(3, 0, 0) % 2**31])
    theirs = AtariVectorEnv("breakout", 1, max_num_frames_per_episode=40, noop_max=31)
    for one in (limited, free):
        one.reset()
    theirs.reset(seed=seed)
    for t, row in enumerate(played(10)[:, :1]):
        got, expected = limited.step(row, BOTH[:1]), free.step(row, BOTH[:1])
        shown, _, _, cut, _ = theirs.step(row[:, 0])
        assert bool(got.truncated[0]) == bool(cut[0]) == (t == 9)
        assert not got.terminated[0] and not expected.truncated[0]
    np.testing.assert_array_equal(got.final_observation, expected.observation)
    assert not np.array_equal(np.moveaxis(shown, 1, -1), expected.observation)
    again = AtariEnv("breakout").reset(seed=episode_seed(3, 0, 1))[0]
    np.testing.assert_array_equal(got.observation[0], np.moveaxis(again, 0, -1))


def test_a_lost_life_ends_what_is_learned_and_not_what_is_told() -> None:
    """Three lives of two steps, rewards 5 and -3; a rollout of 12 steps is two games."""
    job = make_job(
        "small_envs:Lives",
        arm="ppo",
        rollout_steps=12,
        minibatches=1,
        steps=12,
        normalize_rewards=False,
        sign_rewards=True,
    )
    program, keys = make_program(job.config, job.spaces), member_keys(0)
    collector = HostCollector(program, job.spaces, make_envs(job), [keys])
    collector.start()
    params = np.asarray(program.policy.init(keys.init))[None]
    hypers = Hypers(*(np.float32(getattr(job.config, name)) for name in Hypers._fields))
    collected = collector.collect(params, [hypers], 0, np.array([12]))[0]
    rollout, episodes = collected.rollout, collected.episodes
    np.testing.assert_array_equal(rollout.terminated[:, 0], [False, True] * 6)
    assert not rollout.truncated.any() and not rollout.next_value[1::2].any()
    assert rollout.reward[:, 0].tolist() == [1.0, -1.0] * 6, "signs are learned from"
    assert [e.return_ for e in episodes] == [6.0, 6.0], "raw rewards of whole games are counted"
    assert [e.length for e in episodes] == [6, 6]


ATARI = {
    "preset": "atari",
    "network": "trunks:Coarse",
    "envs": 2,
    "rollout_steps": 16,
    "minibatches": 2,
    "epochs": 1,
}


def test_atari_trains_and_resumes_to_the_same_bytes() -> None:
    """The filter lets games stand still; pictures are bytes wherever they are kept."""
    job = make_job(BREAKOUT, arm="sauna", threshold=0.9, steps=128, **ATARI)
    assert job.replay and not job.config.normalize_observations
    whole = train_here(job)
    assert min(row["keep_rate"] for row in whole.rows) < 1
    assert whole.final["sauna/0/collect/observation"].dtype == np.uint8
    part = train_here(job, stop=1)
    rest = train_here(resumed(job, part))
    assert equal(rest.final, whole.final)
    assert part.rows + rest.rows == whole.rows


@pytest.mark.slow
def test_a_members_games_depend_on_its_seed_alone() -> None:
    settings = {**ATARI, "arm": "ppo", "seeds": 2, "steps": 64}
    both = train_here(make_job(BREAKOUT, **settings)).final
    for p in (0, 1):
        alone = train_here(make_job(BREAKOUT, [p], **settings)).final
        assert equal(alone, {name: a for name, a in both.items() if name.startswith(f"ppo/{p}/")})


def test_names_and_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert game_of("ALE/MsPacman-v5") == "ms_pacman"
    with pytest.raises(BadInput, match="'ALE/Brekout-v5'; did you mean 'ALE/Breakout-v5'"):
        env_maker("ALE/Brekout-v5", {})
    for wrong in ({"sticky": 1}, {"repeat_action_probability": 1.5}, {"noop_max": -1}):
        with pytest.raises(BadInput, match="cannot be made"):
            make_env(BREAKOUT, wrong)
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "ale_py" else found(name, *a)
    )
    monkeypatch.delitem(sys.modules, "ale_py")
    with pytest.raises(BadInput, match=r"pip install 'sauna-rl\[atari\]'"):
        probe(BREAKOUT, {})
