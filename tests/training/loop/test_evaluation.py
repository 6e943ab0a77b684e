"""Evaluations while a run trains: when, what they say, what they stop, what they leave alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import sauna
from helpers import SMALL, Recorder, equal, make_job, own, resumed, train_here
from jax_envs import LENGTH, informative
from sauna.algorithm.policy.policy import make_policy
from sauna.algorithm.rollout.play import Episode, play, play_on_device
from sauna.config.presets import resolve
from sauna.envs.device.contract import flat
from sauna.envs.host.contract import EVALUATION, episode_seed
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.training.loop.evaluation import Evaluated
from sauna.training.summary import STOPS, summarize
from sauna.training.worker import train_members
from small_envs import Informative, Scripted
from threads import trained_here

BACKENDS = {"host": "small_envs:Scripted", "device": "jax_envs:walk"}
WATCHED = {"eval_every": 64, "eval_episodes": 3, "checkpoint_every": 1}


def of(backend: str, **settings: Any) -> Any:
    return make_job(BACKENDS[backend], **{"arm": "ppo", "steps": 192, "seeds": 2, **settings})


@pytest.fixture(scope="module", params=BACKENDS)
def both(request) -> tuple[str, Recorder, Recorder]:
    """The same training of two members with and without evaluations."""
    backend = request.param
    return backend, train_here(of(backend)), train_here(of(backend, **WATCHED))


def training(rows: list[dict]) -> list[dict]:
    return [{k: v for k, v in row.items() if not k.startswith("eval_")} for row in rows]


def states(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {k: v for k, v in arrays.items() if "/evaluation/" not in k and "/best/" not in k}


def test_evaluations_change_no_bit_of_training(both) -> None:
    _, plain, watched = both
    assert plain.rows == training(watched.rows) and plain.rows != watched.rows
    assert equal(plain.final, states(watched.final))
    assert plain.final.keys() != watched.final.keys()


def test_every_multiple_is_evaluated_once_by_seeds_of_its_own(both) -> None:
    _, _, watched = both
    rows = [row for row in watched.rows if "eval_returns" in row]
    assert [row["env_steps"] for row in rows] == [64, 64, 128, 128, 192, 192]
    assert all(len(row["eval_returns"]) == 3 for row in rows)
    assert len({tuple(row["eval_returns"]) for row in rows}) == 6
    for name in ("ppo/0", "ppo/1"):
        mine = [row for row in rows if row["member"] == name]
        lengths = [3 * row["eval_length_mean"] for row in mine]
        np.testing.assert_allclose([row["eval_env_steps"] for row in mine], np.cumsum(lengths))
        bests = np.maximum.accumulate([row["eval_return_mean"] for row in mine])
        assert [row["eval_return_best"] for row in mine] == bests.tolist()
        np.testing.assert_allclose(mine[0]["eval_return_std"], np.std(mine[0]["eval_returns"]))


def test_in_a_worker_the_evaluations_are_the_same(both) -> None:
    backend, _, watched = both
    if backend == "host":
        found = train_here(of(backend, **WATCHED, env_processes=2))
        assert found.rows == watched.rows and equal(found.final, watched.final)


@pytest.mark.parametrize(
    "env, more",
    [
        ("CartPole-v1", {"eval_deterministic": False}),
        pytest.param("small_envs:Camera", {}, marks=pytest.mark.slow),
        ("small_envs:Choosy", {"action_mask": True, "stack": 2, "eval_deterministic": False}),
        (
            "small_envs:Informative",
            {"recurrent": "gru", "recurrent_width": 4, "sequence_length": 8},
        ),
        pytest.param(
            "small_envs:Wide",
            {"rescale_actions": True, "normalize_observations": False},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_every_kind_of_environment_is_played_in_a_worker_as_here(env: str, more) -> None:
    """Pictures, masks and infos go through the pipe; so do actions of each kind."""
    settings = {"arm": "ppo", "steps": 96, "eval_every": 32, "eval_episodes": 2, **more}
    here, there = (
        train_here(make_job(env, env_processes=number, **settings)).rows for number in (0, 1)
    )
    assert here == there and all("eval_returns" in row for row in here)


@pytest.mark.parametrize("stop", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4))])
def test_a_resumed_run_has_the_same_evaluations(both, stop: int) -> None:
    backend, _, watched = both
    job = of(backend, **WATCHED)
    first = train_here(job, stop)
    second = train_here(resumed(job, first))
    assert first.rows + second.rows == watched.rows and equal(second.final, watched.final)


def test_the_best_policy_is_kept_as_it_was(both) -> None:
    """It is that of the checkpoint after which the best evaluation came."""
    _, _, watched = both
    for name in ("ppo/0", "ppo/1"):
        mine = [row for row in watched.rows if row["member"] == name and "eval_returns" in row]
        best = max(mine, key=lambda row: row["eval_return_mean"])
        final = own(watched.final, name)
        assert final["/evaluation/best_env_steps"] == best["env_steps"]
        then = own(watched.states[best["iteration"] + 1], name)
        kept = {k.removeprefix("/best"): v for k, v in final.items() if k.startswith("/best/")}
        assert kept and equal(kept, {key: then[key] for key in kept})


def test_a_member_that_stops_early_changes_no_other(both) -> None:
    backend, _, whole = both
    reached = [row for row in whole.rows if row.get("env_steps") == 64]
    low, high = sorted(reached, key=lambda row: row["eval_return_mean"])
    level = (low["eval_return_mean"] + high["eval_return_mean"]) / 2
    stopped = train_here(of(backend, stop_at=level, **WATCHED))
    gone, left = high["member"], low["member"]
    last = [row for row in stopped.rows if row["member"] == gone][-1]
    assert last["env_steps"] == 64 and last == high
    others = [row for row in whole.rows if row["member"] == left]
    mine = [row for row in stopped.rows if row["member"] == left]
    assert len(mine) > 2 and mine == others[: len(mine)]
    assert stopped.final[f"{gone}/counters/stopped"] == STOPS.index("stop_at")
    again = train_here(resumed(of(backend, stop_at=level, **WATCHED), stopped))
    assert again.rows == [] and equal(again.final, stopped.final)


def test_a_return_that_is_reached_at_the_end_of_the_budget_stops_nothing(both) -> None:
    backend, _, whole = both
    reached = train_here(of(backend, stop_at=-1e9, **{**WATCHED, "eval_every": 192}))
    assert [row["env_steps"] for row in reached.rows] == [row["env_steps"] for row in whole.rows]
    assert any("eval_return_mean" in row for row in reached.rows)
    assert not any(name.endswith("counters/stopped") for name in reached.final)


class Stopping(Recorder):
    """Stops one member once a row of iteration 1 was seen, as a callback does."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def allowance(self, iteration: int) -> int:
        return 1

    def iteration(self, iteration: int, rows: list[dict], timing: dict) -> None:
        super().iteration(iteration, rows, timing)
        if iteration == 1:
            self.names.add("ppo/0")

    def stopped(self) -> set[str]:
        return self.names


def test_a_callback_stops_a_member_after_the_row_that_it_saw(both) -> None:
    (backend, whole, _), stopped = both, Stopping()
    train_members(of(backend), stopped)
    rows = [row for row in whole.rows if row["member"] == "ppo/1" or row["iteration"] <= 1]
    assert stopped.rows == rows
    assert stopped.final["ppo/0/counters/stopped"] == STOPS.index("callback")
    assert equal(own(stopped.final, "ppo/1"), own(whole.final, "ppo/1"))


def test_a_flat_curve_stops_a_member_after_so_many_evaluations() -> None:
    config = resolve({"env": "none", "eval_every": 10, "stop_when_flat": 2})
    found, stops = Evaluated(), []
    for number, return_ in enumerate([1.0, 3.0, 3.0, 2.0, 5.0]):
        row = found.see([Episode(return_, 7, False)], 10 * number, dict)
        stops.append(found.stop(config, row["eval_return_mean"]))
    flat = STOPS.index("stop_when_flat")
    assert stops == [0, 0, 0, flat, 0]  # the fourth is the second without a new best
    assert (found.best, found.best_env_steps, found.env_steps) == (5.0, 40, 35)


def test_stops_and_the_last_evaluation_stand_in_the_summary() -> None:
    rows = [
        {"member": "ppo/0", "env_steps": 10, "eval_return_mean": 4.0, "eval_returns": [4.0]},
        {"member": "ppo/0", "env_steps": 20, "return_mean": 3.0},
        {"member": "ppo/1", "env_steps": 30},
    ]
    arrays = {"ppo/0/counters/stopped": np.array(STOPS.index("stop_at"))}
    assert summarize(rows, arrays) == {
        "ppo/0": {
            "env_steps": 20,
            "return_mean": 3.0,
            "eval_return_mean": 4.0,
            "stopped_early": "stop_at",
        },
        "ppo/1": {"env_steps": 30},
    }


HERE, THERE = {}, {"env_processes": 1, "env_timeout": 3}  # where the environments are stepped


@pytest.mark.parametrize(
    "what, where, says",
    [
        ("raise", HERE, "the environment raised ValueError: the motor is on fire"),
        ("raise", THERE, r"environment worker 0 .*: environment of seed 0: step raised ValueError"),
        ("exit", THERE, r"environment worker 0 \(process \d+\) ended with exit code 7"),
        ("hang", THERE, r"environment worker 0 \(process \d+\) did not answer within 3 s"),
    ],
)
def test_an_environment_that_fails_in_an_evaluation_is_named_and_nothing_is_lost(
    what: str, where: dict[str, Any], says: str, tmp_path: Path
) -> None:
    """The second evaluation fails, in its second episode; the first is in the checkpoint."""
    run = tmp_path / "run"
    seed = episode_seed(0, EVALUATION, 5)
    kwargs = {"what": what, "where": "step", "episode": 4, "seed": seed}
    settings = {**SMALL, "arm": "ppo", "processes": 1, "checkpoint_every": 1, **where}
    settings |= {"eval_every": 64, "eval_episodes": 2, "quiet": True, "env_kwargs": kwargs}
    with trained_here(), pytest.raises(SaunaError, match=f"evaluation of ppo/0: {says}"):
        sauna.train("small_envs:Failing", out=run, **settings)
    found = checkpoint.load_newest(run / "checkpoints", print)
    assert found is not None and found.manifest["iteration"] == len(run_directory.rows(run)) == 3
    assert found.arrays["ppo/0/evaluation/best_env_steps"] == 64
    assert not run_directory.is_complete(run)


@pytest.mark.parametrize("name", ["eval_episodes", "stop_at", "stop_when_flat"])
def test_what_only_evaluations_read_is_refused_without_them(name: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=f"{name}: not read .* it needs eval_every above 0"):
        sauna.train("small_envs:Scripted", out=tmp_path / "run", **{**SMALL, name: 3})
    assert list(tmp_path.iterdir()) == []


def test_evaluations_that_would_never_come_are_refused(tmp_path: Path) -> None:
    last = r"eval_every: the run ends after 64 env steps, before the first evaluation"
    settings = {**SMALL, "steps": 64 + 31, "eval_every": 65, "out": tmp_path / "run"}
    for arm in ("ppo", "sauna"):
        with pytest.raises(BadInput, match=last):
            sauna.train("small_envs:Scripted", **{**settings, "arm": arm})
    assert list(tmp_path.iterdir()) == []


def test_an_episode_says_whether_it_was_a_success() -> None:
    """`Informative` calls an even length one; of an episode that was cut nothing is known."""

    def still(observation: Any, **how: Any) -> np.ndarray:
        return np.zeros(2, np.float32)

    episodes = [play(still, Informative(), True, seed) for seed in range(6)]
    assert [e.success for e in episodes] == [float(e.length % 2 == 0) for e in episodes]
    assert len({e.success for e in episodes}) == 2
    assert play(still, Informative(), True, 0, max_steps=1).success is None
    assert play(still, Scripted(), True, 0).success is None
    row = Evaluated().see([*episodes[:2], Episode(1.0, 1, True)], 64, dict)
    assert row["eval_success_rate"] == (episodes[0].success + episodes[1].success) / 2
    assert "eval_success_rate" not in Evaluated().see([Episode(1.0, 1, False)], 64, dict)


def test_an_episode_on_the_device_says_so_too() -> None:
    job = make_job("jax_envs:informative", arm="ppo", backend="device", device="cpu")
    policy = make_policy(job.config, job.spaces)
    played = play_on_device(
        policy.init(jax.random.key(0)),
        None,
        jax.vmap(jax.random.key)(np.arange(8)),
        config=job.config,
        env=flat(informative),
        policy=policy,
        deterministic=True,
        max_steps=LENGTH - 1,
    )
    cut, even = np.asarray(played.cut), np.asarray(played.length) % 2 == 0
    assert 0 < cut.sum() < 8
    np.testing.assert_array_equal(np.isnan(played.success), cut)
    np.testing.assert_array_equal(np.asarray(played.success)[~cut], even[~cut])
