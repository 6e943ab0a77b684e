"""Training with a memory: resumed to the byte, by itself, under every rule, and it remembers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import sauna
from helpers import SMALL, equal, make_job, own, resumed, train_here
from sauna.algorithm.policy.frozen import FrozenPolicy
from sauna.algorithm.rollout.play import play
from sauna.config.presets import ARMS, resolve
from sauna.envs.spaces import describe
from sauna.experiments.evaluate.policy import TrainedPolicy
from sauna.experiments.inspect.recording import play_steps
from sauna.experiments.inspect.streams import stream_of
from sauna.system.checkpoint import under
from sauna.system.errors import BadInput
from sauna.training.artifact import load_artifact
from small_envs import Scripted

slow = pytest.mark.slow
CELL = {"recurrent": "gru", "recurrent_width": 6, "sequence_length": 8}
PLACES = {"host": {}, "device": {"backend": "device"}}
ENVS = {"host": "small_envs:Scripted", "device": "jax_envs:walk"}


def job_of(place: str, arm: str = "sauna", **settings: Any) -> Any:
    given = {"arm": arm, "envs": 2, "steps": 256, **CELL, **PLACES[place], **settings}
    return make_job(ENVS[place], **given)


@pytest.mark.parametrize("place", ["host", pytest.param("device", marks=slow)])
def test_a_recurrent_member_is_its_own_and_resumed_to_the_byte(place: str) -> None:
    """Its bits are those of a member alone, and those of a run that nobody interrupted."""
    settings = {"threshold": 0.9, "seeds": 2}
    whole = train_here(job_of(place, **settings))
    first = train_here(job_of(place, **settings), 2)
    again = train_here(resumed(job_of(place, **settings), first))
    assert equal(again.final, whole.final) and first.rows + again.rows == whole.rows
    alone = train_here(make_second(place, settings))
    assert equal(own(alone.final, "sauna/1"), own(whole.final, "sauna/1"))
    assert min(row["keep_rate"] for row in whole.rows) < 0.95
    memory = first.final["sauna/0/collect/memory"]
    assert memory.shape == (2, 2 * 6) and np.abs(memory).max() > 0.01
    assert {row["gradient_steps"] for row in whole.rows} == {8.0}


def make_second(place: str, settings: dict[str, Any]) -> Any:
    job = job_of(place, **settings)
    return job._replace(members=job.members[1:])


@slow
@pytest.mark.parametrize("cell", ["lstm", "gru"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("arm", [*ARMS, "gigaflow+random", "prioritized+reversed", "sauna+random"])
def test_every_rule_trains_a_recurrent_policy(arm: str, place: str, cell: str) -> None:
    if cell == "lstm" and arm not in ("ppo", "sauna", "gradient-norm"):
        pytest.skip("one combination is enough")
    more: dict[str, Any] = {"drop_rate": 0.3} if arm == "random-drop" else {}
    recorder = train_here(job_of(place, arm, **{**more, "recurrent": cell, "steps": 512}))
    assert len(recorder.rows) >= 2
    for row in recorder.rows:
        assert 0 < row["gradient_steps"] <= 8 and 0 <= row["sample_rate"] <= 1
        assert all(np.isfinite(x) for x in row.values() if isinstance(x, float))
    shares = {"top-advantage": 0.5, "kondo": 0.3}
    if arm in shares:
        expected = np.ceil(shares[arm] * 64) / 64
        np.testing.assert_allclose([row["sample_rate"] for row in recorder.rows], expected)


@slow
@pytest.mark.parametrize("mode", ["fewer", "smaller", "refill"])
@pytest.mark.parametrize("losses", ["all", "policy"])
def test_every_mode_of_selection_trains_a_recurrent_policy(mode: str, losses: str) -> None:
    chosen = {"selection_losses": losses}
    if losses == "all":
        chosen["selection_mode"] = mode
    elif mode != "fewer":
        pytest.skip("one combination is enough")
    for arm in ("top-advantage", "prioritized"):
        rows = train_here(job_of("host", arm, **chosen)).rows
        assert all(0 < row["gradient_steps"] <= 8 for row in rows)


@slow
@pytest.mark.parametrize("algorithm", ["ppo", "a2c"])
def test_a_rule_that_takes_everything_is_plain_training(algorithm: str) -> None:
    """Threshold 0 drops nothing: the loops over all and over chosen sequences agree."""
    settings: dict[str, Any] = {"vex_coef": 0.5, "algorithm": algorithm, "vex_target": "sample"}
    if algorithm == "a2c":
        settings |= {"rollout_steps": 8, "preset": "a2c"}
    plain = train_here(job_of("host", "vex-head", **settings))
    masked = train_here(job_of("host", "sauna", threshold=0.0, dropped="mask", **settings))
    for name, array in own(plain.final, "vex-head/0").items():
        if name.startswith("/params/"):
            other = own(masked.final, "sauna/0")[name]
            np.testing.assert_allclose(array, other, rtol=2e-3, atol=2e-4, err_msg=name)


def refused(**settings: Any) -> str:
    with pytest.raises(BadInput) as error:
        resolve({"env": "x", "arm": "ppo", **SMALL, **CELL, **settings})
    return str(error.value)


def test_what_cannot_work_is_refused_in_one_line() -> None:
    assert refused(sequence_length=5) == "sequence_length: 5 does not divide rollout_steps 32"
    assert "minibatches: 4 does not divide the 1 sequences" in refused(sequence_length=32)
    assert "needs a minibatch in random order" in refused(arm="delight+random")
    assert "use next-observation" in refused(auxiliary="shuffled-observation")
    assert "needs recurrent lstm or gru" in refused(recurrent="none")
    assert "cloned step by step" in refused(init_from="data:x.parquet")
    assert "not read with recurrent gru" in refused(replay_rollouts=1)


def frozen(seed: int = 0) -> tuple[FrozenPolicy, Any]:
    env = Scripted()
    spaces = describe(env.observation_space, env.action_space)
    config = resolve({"env": "small_envs:Scripted", "arm": "ppo", "hidden": "4", **CELL})
    config = dataclasses.replace(config, network="mlp", normalize_observations=False)
    policy = FrozenPolicy(config, spaces, env)
    params = np.asarray(jax.jit(policy.policy.init)(jax.random.key(seed)))
    noise = np.random.default_rng(1).normal(size=params.shape).astype(np.float32)
    policy.load(params + noise, None)
    return policy, env


def test_a_frozen_policy_remembers_until_it_is_reset() -> None:
    """Its actions are those of `Policy.step` with the state carried by hand; batches, too."""
    policy, env = frozen()
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(5, 2, *env.observation_space.shape)).astype(np.float32)
    state, expected, step = policy.policy.initial_state(2), [], jax.jit(policy.policy.step)
    for row in seen:
        output, state = step(policy.params, row, state)
        expected.append(np.asarray(policy.policy.distribution.mode(output.policy)))
    one = [policy.act(row[0]) for row in seen]
    np.testing.assert_allclose(one, np.stack(expected)[:, 0], rtol=1e-4, atol=1e-5)
    with pytest.raises(BadInput, match="remembers 1 episodes, and got observations of 2"):
        policy(seen[0])
    policy.reset()
    both = [policy(row) for row in seen]
    policy.reset([True, False])
    again = policy(seen[0])
    np.testing.assert_allclose(again[0], both[0][0], rtol=1e-4, atol=1e-5)
    assert np.abs(again[1] - both[0][1]).max() > 1e-4
    policy.reset()
    first, second = (play(policy, env, True, 3).return_ for _ in range(2))
    assert first == second


def trained(folder: Path, arm: str) -> Path:
    settings = {**SMALL, **CELL, "arm": arm, "processes": 1, "eval_every": 64}
    if "sauna" in arm:
        settings["threshold"] = 0.9
    return sauna.train("small_envs:Drawn", quiet=True, out=folder / "run", **settings).path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("recurrent"), "ppo,sauna")


@slow
def test_a_run_is_evaluated_loaded_and_inspected(run: Path) -> None:
    found = sauna.evaluate(run, episodes=2, deterministic=True)
    assert set(found["members"]) == {"ppo/0", "sauna/0"}
    policy = sauna.load(run)
    seen = np.zeros(policy._space.shape)
    one, state = policy.predict(seen, deterministic=True)
    two, state = policy.predict(seen, state, deterministic=True)
    start, _ = policy.predict(seen, state, [True], deterministic=True)
    np.testing.assert_allclose(start, one, rtol=1e-5)
    assert not np.allclose(one, two)
    sauna.inspect(run, member="sauna/0", episodes=2, frames=False)


@slow
@pytest.mark.parametrize("arm", ["gigaflow", "gradient-norm", "delight"])
def test_a_rule_of_a_recurrent_run_is_inspected(arm: str, tmp_path: Path) -> None:
    sauna.inspect(trained(tmp_path, arm), episodes=2, frames=False)


@slow
def test_an_inspected_stream_is_what_the_policy_saw(run: Path) -> None:
    artifact = load_artifact(run)
    env = Scripted()
    policy = TrainedPolicy(artifact, "ppo/0", env)
    played = play_steps(policy, env, 40, False, 0, 0)
    own_arrays = under("ppo/0/", artifact.checkpoint.arrays)
    stream = stream_of(policy, artifact.config, own_arrays, played)
    state, network = policy.policy.initial_state(1), policy.policy
    ends = 0
    for t in range(40):
        np.testing.assert_allclose(stream.memory.state[t], state[0], rtol=1e-4, atol=1e-5)
        output, state = network.step(policy.params, played.observation[t][None], state)
        assert float(stream.value[t]) == pytest.approx(float(output.value[0]), rel=1e-4, abs=1e-5)
        over = bool(played.terminated[t] | played.truncated[t])
        if played.truncated[t]:
            after = network.step(policy.params, played.final[ends][None], state)[0]
            assert float(stream.next_value[t]) == pytest.approx(float(after.value[0]), rel=1e-4)
        if over:
            ends, state = ends + 1, network.initial_state(1)
    assert ends > 0


RECALL: dict[str, Any] = {
    "arm": "ppo",
    "env_kwargs": {"length": 6},
    "envs": 16,
    "rollout_steps": 48,
    "minibatches": 4,
    "epochs": 4,
    "hidden": "16",
    "learning_rate": 3e-3,
    "entropy_coef": 0.01,
    "normalize_observations": False,
    "normalize_rewards": False,
    "steps": 48_000,
    "seeds": 2,
}


@slow
@pytest.mark.parametrize("cell", ["none", "lstm", "gru"])
def test_a_cue_is_recalled_with_a_memory_alone(cell: str) -> None:
    """The best mean return is 1; without a memory it is 0, whatever is learned."""
    memory = {} if cell == "none" else {"recurrent_width": 16, "sequence_length": 24}
    job = make_job("sauna.envs.memory_tasks:recall", recurrent=cell, **RECALL, **memory)
    rows = train_here(job).rows
    last = [[row["return_mean"] for row in rows if row["member"] == f"ppo/{i}"][-1] for i in (0, 1)]
    if cell == "none":
        assert max(map(abs, last)) < 0.35  # of 100 episodes of +-1
    else:
        assert min(last) > 0.9
