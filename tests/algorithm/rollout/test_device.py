"""Environments inside the compiled program: the same rollouts, members, checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import SMALL, TESTS, Recorder, equal, make_job, own, resumed, train_here
from jax_envs import LENGTH, walk
from sauna.algorithm.rollout.collected import capacity
from sauna.algorithm.rollout.device import WINDOW, Collecting, _ends, _Row, collect, start
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import make_program
from sauna.algorithm.types import Hypers, member_keys
from sauna.envs.device.contract import advance, begin, flat
from sauna.envs.host.contract import HostEnvs, Step
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.system.errors import BadInput
from sauna.training.loop.device_program import MAX_PER_CALL
from sauna.training.loop.job import NonFinite

N = 3


class SteppedHere(HostEnvs):
    """The host's face of a `JaxEnv`, with the very keys that the device draws from."""

    def __init__(self, env: Any, number: int, key: Any, cached: bool) -> None:
        self._running = begin(env, key, number, cached=cached)
        self._advance = jax.jit(
            lambda running, action, active: advance(env, running, action, active, key, lambda x: x)
        )

    def reset(self) -> np.ndarray:
        return np.asarray(self._running.observation, np.float64)

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        self._running, transition = self._advance(self._running, action, active)
        ends = np.asarray(transition.terminated), np.asarray(transition.truncated)
        return Step(
            np.asarray(self._running.observation, np.float64),
            np.asarray(transition.reward, np.float64),
            *ends,
            np.zeros_like(ends[0]),
            np.asarray(transition.observation, np.float64),
            bool((ends[0] | ends[1]).any()),
        )


def test_the_means_of_a_row_are_over_all_episodes_also_where_only_the_latest_are_listed() -> None:
    """As on the host; a number that an episode does not give counts for nothing."""
    rng = np.random.default_rng(0)
    shape = (80, 2)
    rows = {name: np.zeros(shape, np.float32) for name in _Row._fields}
    rows |= {name: np.ones(shape, bool) for name in ("terminated", "keep", "valid")}
    rows |= {"truncated": np.zeros(shape, bool), "terminated": rng.random(shape) < 0.9}
    rows["episode_return"], rows["episode_length"] = rng.normal(size=(2, *shape))
    given = np.where(rng.random(shape) < 0.5, rng.normal(size=shape), np.nan)
    rows["info"] = {"x": given, "never": np.full(shape, np.inf)}
    ends = jax.jit(_ends)(_Row(**rows))
    over = rows["terminated"]
    returns = rows["episode_return"][over]
    assert int(ends.number) == len(returns) > WINDOW
    np.testing.assert_allclose(ends.return_mean, returns.mean(), rtol=1e-4)
    np.testing.assert_allclose(ends.return_, returns[-WINDOW:], rtol=1e-6)
    np.testing.assert_allclose(ends.info["x"], np.nanmean(given[over]), rtol=1e-4)
    assert np.isnan(ends.info["never"])


slow = pytest.mark.slow
REMEMBERING = {"recurrent_width": 5, "sequence_length": 8, "trunk": "shared"}
ARMS = [
    pytest.param("ppo", {}, marks=slow),
    ("sauna", {"threshold": 0.9}),
    ("sauna", {"threshold": 0.9, "dropped": "mask", "sign_rewards": True}),
    pytest.param("sauna", {"keep_rate_target": 0.6}, marks=slow),
    pytest.param("sauna", {"threshold": 0.9, "recurrent": "gru", **REMEMBERING}, marks=slow),
    pytest.param("ppo", {"recurrent": "lstm", **REMEMBERING}, marks=slow),
    pytest.param(
        "sauna", {"threshold": 0.9, "distribution": "gsde", "sde_sample_freq": 5}, marks=slow
    ),
    pytest.param("ppo", {"distribution": "gsde", "sde_expln": True}, marks=slow),
    pytest.param("sauna", {"threshold": 0.9, "distribution": "squashed"}, marks=slow),
    pytest.param("sauna", {"threshold": 0.9, "distribution": "beta"}, marks=slow),
    pytest.param("sauna", {"threshold": 0.9, "decision": "joint", "history": "kept"}, marks=slow),
    pytest.param(
        "sauna", {"threshold": 0.9, "reset": "cached", "normalize_rewards": False}, marks=slow
    ),
    pytest.param("random-drop", {"drop_rate": 0.4, "truncation": "terminate"}, marks=slow),
    pytest.param(
        "sauna",
        {"threshold": 0.9, "max_env_steps_factor": 1, "normalize_observations": False},
        marks=slow,
    ),
]


@pytest.mark.parametrize("arm, settings", ARMS)
def test_host_and_device_fill_the_same_rollout(arm: str, settings: dict[str, Any]) -> None:
    job = make_job("jax_envs:walk", arm=arm, envs=N, **settings)
    config, keys = job.config, member_keys(7)
    program = make_program(config, job.spaces)
    params = program.policy.init(keys.init)
    hypers = Hypers(*(np.float32(getattr(job.members[0].config, f)) for f in Hypers._fields))
    env = flat(walk)
    envs = SteppedHere(env, N, keys.env, config.reset == "cached")
    host = HostCollector(program, job.spaces, envs, [keys])
    host.start()
    how = program.policy, program.filter, lambda x: x, job.spaces.normalized
    parts = Collecting(config, env, *how)
    state = start(parts, keys.env)
    step = jax.jit(lambda *arguments: collect(parts, *arguments))
    limit = min(100, capacity(config))
    for iteration in range(3):
        collected = host.collect(np.asarray(params)[None], [hypers], iteration, np.array([limit]))[
            0
        ]
        state, rollout, ends, faults = step(
            params, state, keys, hypers, jnp.int32(iteration), jnp.int32(limit)
        )
        expected = collected.rollout
        rows = expected.valid.any(1)
        np.testing.assert_array_equal(np.asarray(rollout.valid), expected.valid)
        assert_same_memory(rollout, expected)
        for name in set(rollout._fields) - {"memory"}:
            got, wanted = np.asarray(getattr(rollout, name)), getattr(expected, name)
            if got.dtype == bool:
                np.testing.assert_array_equal(got, wanted, err_msg=name)
            else:
                acted = expected.valid[rows]
                np.testing.assert_allclose(
                    got[rows][acted], wanted[rows][acted], rtol=2e-4, atol=2e-5, err_msg=name
                )
        there = np.asarray(ends.there)
        assert int(ends.number) == there.sum() == len(collected.episodes) > 0
        np.testing.assert_allclose(ends.return_mean, collected.return_mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(ends.length_mean, collected.length_mean, rtol=1e-5)
        assert np.isclose(collected.length_mean, np.mean([e.length for e in collected.episodes]))
        assert not faults.found
        for i, episode in zip(np.flatnonzero(there), collected.episodes, strict=True):
            assert ends.env[i] == episode.env
            assert ends.length[i] == episode.length
            assert ends.truncated[i] == episode.truncated
            assert ends.kept[i] == episode.kept
            np.testing.assert_allclose(ends.return_[i], episode.return_, rtol=1e-4, atol=1e-5)
    dropped = 1.0 - collected.kept_steps / collected.env_steps
    assert (dropped > 0.05) == (arm != "ppo"), "the filter had something to do"


def assert_same_memory(rollout: Any, expected: Any) -> None:
    """Where episodes start, and the states before each chunk of the environments that act in it."""
    if expected.memory is None:
        assert rollout.memory is None
        return
    (start, state), (wanted, stored) = rollout.memory, expected.memory
    valid = expected.valid
    np.testing.assert_array_equal(np.asarray(start)[valid], wanted[valid])
    begun = valid[:: len(valid) // len(stored)]
    np.testing.assert_allclose(np.asarray(state)[begun], stored[begun], rtol=2e-4, atol=2e-5)
    assert wanted.any() and np.abs(stored[begun]).max() > 0.01


def same(value: Any) -> Any:
    return value


def _one(tree: Any, n: int) -> Any:
    return jax.tree.map(lambda x: x[n], tree)


def test_an_ended_episode_keeps_its_last_observation_and_the_next_begins() -> None:
    env, key = flat(walk), jax.random.key(3)
    running = begin(env, key, 4, cached=False)
    active = jnp.array([True, True, True, False])
    step = jax.jit(lambda running: advance(env, running, jnp.ones((4, 1)), active, key, same))
    seen_ends = 0
    for _ in range(3 * LENGTH):
        before = running
        running, transition = step(running)
        ended = np.asarray(transition.terminated | transition.truncated)
        for n in np.flatnonzero(ended):
            seen_ends += 1
            reached = env.step(_one(before.state, n), jnp.ones(1))
            np.testing.assert_allclose(transition.observation[n], reached.observation, rtol=1e-6)
            assert running.episode[n] == before.episode[n] + 1
            assert running.observation[n, 1] == 0.0 != transition.observation[n, 1]
        np.testing.assert_array_equal(running.observation[3], before.observation[3])
    assert seen_ends > 6


def test_cached_resets_return_to_the_first_state_and_fresh_ones_do_not() -> None:
    env, key = flat(walk), jax.random.key(3)
    everyone = jnp.ones(2, bool)
    step = jax.jit(lambda running: advance(env, running, jnp.zeros((2, 1)), everyone, key, same))
    for cached in (True, False):
        running = first = begin(env, key, 2, cached=cached)
        starts = []
        for _ in range(3 * LENGTH):
            running, transition = step(running)
            for n in np.flatnonzero(np.asarray(transition.terminated | transition.truncated)):
                starts.append(bool((running.observation[n] == first.observation[n]).all()))
        assert starts and all(starts) == cached and any(starts) == cached


def device_job(**settings: Any) -> Any:
    return make_job("jax_envs:walk", arm="sauna", envs=2, threshold=0.9, steps=512, **settings)


def test_a_member_does_not_depend_on_its_neighbours() -> None:
    together = train_here(device_job(seeds=3))
    alone = train_here(device_job(chosen=[1], seeds=3))
    assert equal(own(together.final, "sauna/1"), own(alone.final, "sauna/1"))
    assert [r for r in together.rows if r["seed"] == 1] == alone.rows


def test_results_do_not_depend_on_how_many_iterations_a_call_runs() -> None:
    whole = train_here(device_job())

    class OneByOne(Recorder):
        def allowance(self, iteration: int) -> int:
            return 1

    single = OneByOne()
    from sauna.training.worker import train_members

    train_members(device_job(), single)
    assert equal(whole.final, single.final)
    assert whole.rows == single.rows
    assert len(whole.rows) < MAX_PER_CALL


@pytest.mark.parametrize("reset", ["fresh", pytest.param("cached", marks=slow)])
def test_resume_is_exact(reset: str) -> None:
    whole = train_here(device_job(reset=reset))
    first = train_here(device_job(reset=reset), stop=2)
    rest = train_here(resumed(device_job(reset=reset), first))
    assert equal(whole.final, rest.final)
    assert whole.rows == first.rows + rest.rows


@slow
def test_no_arm_oversteps_the_budget_and_every_env_step_is_counted() -> None:
    job = make_job("jax_envs:walk", arm="sauna", envs=3, steps=1000, seeds=2, threshold=0.9)
    rows = train_here(job).rows
    for seed in (0, 1):
        mine = [row for row in rows if row["seed"] == seed]
        counted = sum(sum(row["episode_lengths"]) for row in mine)
        assert 1000 - 96 < mine[-1]["env_steps"] <= 1000
        assert counted <= mine[-1]["env_steps"] < counted + 3 * LENGTH
        assert mine[-1]["kept_steps"] < mine[-1]["env_steps"]


@pytest.mark.slow
def test_the_learning_rate_and_the_threshold_follow_their_schedules() -> None:
    job = make_job("jax_envs:walk", arm="ppo", learning_rate=0.5)
    rows = train_here(job).rows
    np.testing.assert_allclose([r["learning_rate"] for r in rows], [0.5, 0.375, 0.25, 0.125])
    schedule = {"threshold": 0.8, "threshold_schedule": "falling"}
    rows = train_here(make_job("jax_envs:walk", arm="sauna", **schedule)).rows
    before = np.array([0, *(row["env_steps"] for row in rows[:-1])])
    np.testing.assert_allclose([r["threshold"] for r in rows], 0.8 * (1 - before / 128), rtol=1e-5)


@pytest.mark.slow
def test_a_truncated_episode_bootstraps_and_a_wrong_one_would_not() -> None:
    """With a time limit every other step the value is still 1 / (1 - gamma) = 2."""
    settings = {
        "rollout_steps": 64,
        "minibatches": 2,
        "epochs": 4,
        "steps": 64 * 120,
        "gamma": 0.5,
        "learning_rate": 1e-2,
        "normalize_rewards": False,
        "normalize_observations": False,
        "hidden": "8",
    }
    found = {}
    for truncation in ("bootstrap", "terminate"):
        job = make_job("jax_envs:cut_off", arm="ppo", truncation=truncation, **settings)
        recorder = train_here(job)
        from helpers import policy_output

        found[truncation] = float(
            policy_output(job, recorder.final, "ppo/0", np.ones((1, 2))).value[0]
        )
    assert abs(found["bootstrap"] - 2.0) < 0.1
    assert found["terminate"] < 1.6  # 1 or 1.5, as the episode has one or two steps to go


@pytest.mark.slow
def test_a_number_that_is_not_finite_stops_the_run_and_is_named() -> None:
    job = make_job("jax_envs:broken", arm="ppo", envs=2)
    with pytest.raises(EnvironmentFailure, match=r"environment 0 .* step 4 .* reward"):
        train_here(job)
    job = make_job("jax_envs:broken_start", arm="ppo", envs=2)
    with pytest.raises(EnvironmentFailure, match=r"step 0 .* observation"):
        train_here(job)
    job = make_job("jax_envs:walk", arm="ppo", envs=2, learning_rate=1e30)
    with pytest.raises(NonFinite, match="ppo/0"):
        train_here(job)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"env": "jax_envs:no_env", "backend": "device"}, "not a sauna.JaxEnv"),
        ({"env": "InvertedPendulum-v5", "backend": "device"}, "does not run on the device"),
        ({"env": "jax_envs:walk", "env_processes": 1}, "env_processes: not read"),
        ({"env": "InvertedPendulum-v5", "reset": "cached"}, "reset: only read"),
        ({"env": "gymnax/CartPol-v1"}, "CartPole-v1"),
        ({"env": "jax_envs:walk", "device": "gpu"}, "device: no NVIDIA GPU"),
        ({"env": "jax_envs:walk", "steps": 3_000_000_000}, "steps: the device counts"),
    ],
)
def test_bad_input_is_refused(
    settings: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sauna.training import prepare, run
    from sauna.training.display import PlainDisplay

    monkeypatch.setattr(prepare, "has_gpu", lambda: False)
    with pytest.raises(BadInput, match=message):
        run.start({**SMALL, **settings}, PlainDisplay())


@slow
def test_the_environment_of_the_docs_trains(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(TESTS).parent / "docs" / "how-to" / "gpu.md").read_text()
    code = text.split('```python title="my_envs.py"\n')[1].split("```")[0]
    (tmp_path / "my_envs.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    result = train_here(make_job("my_envs:near_zero", arm="ppo", envs=2))
    assert result.rows[-1]["env_steps"] == 128
