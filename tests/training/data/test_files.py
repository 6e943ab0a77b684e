"""Recorded episodes come back from a file as they were; what does not fit is refused.

pip install 'sauna-rl[minari,parquet]'
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
import small_envs
from helpers import SMALL
from sauna.envs.actions import action_writer
from sauna.envs.make import make_env
from sauna.envs.spaces import describe
from sauna.experiments.record import _Listener, _writer
from sauna.system.errors import BadInput
from sauna.system.run_directory import read_config
from sauna.training.cloning import _read
from sauna.training.data.minari_sets import read_minari
from sauna.training.data.parquet import read_parquet
from sauna.training.prepare import prepare

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def extras() -> None:
    for name in ("pyarrow", "minari", "h5py"):
        pytest.importorskip(name, reason="needs `pip install 'sauna-rl[minari,parquet]'`")


MASKED: dict[str, Any] = {"env_kwargs": {"by": "method"}, "action_mask": True}
KINDS: dict[str, dict[str, Any]] = {
    "small_envs:Scripted": {},
    "small_envs:Picture": {},
    "small_envs:Board": {},
    "small_envs:Parts": {},
    "small_envs:Wide": {},
    "small_envs:Spaced": {"observation": "dict", "action": "multi_discrete"},
}


def recorded(
    env: str, kwargs: dict[str, Any], to: str, number: int = 3, valid: bool = False
) -> dict[str, Any]:
    """Episodes of random actions (`valid`: of those alone), written; what was seen and done."""
    made = make_env(env, kwargs)
    spaces = describe(made.observation_space, made.action_space)
    made.action_space.seed(0)
    about = {"spaces": list(spaces), "version": "0", "member": "ppo/0"}
    listener, kept = _Listener(made), []
    with _writer(to, made, about) as add:
        for seed in range(number):
            listener.reset(seed=seed)
            done = False
            while not done:
                mask = made.unwrapped.valid if valid else None
                *_, terminated, truncated, _ = listener.step(made.action_space.sample(mask))
                done = terminated or truncated
            kept.append(listener.recorded(seed))
            add(kept[-1])
    return {"episodes": kept, "spaces": spaces, "action_space": made.action_space}


@pytest.mark.parametrize("env", KINDS)
def test_both_kinds_of_file_give_the_same_learners_data(env: str, tmp_path: Path) -> None:
    found = {}
    for to in (str(tmp_path / "a.parquet"), f"minari:{tmp_path}/a-v0"):
        kept = recorded(env, KINDS[env], to)
        overrides = {"env": env, "env_kwargs": KINDS[env], "arm": "ppo", "init_from": f"data:{to}"}
        data = _read(prepared := prepare(overrides))
        assert data.length.tolist() == [len(one.reward) for one in kept["episodes"]]
        assert data.terminated.tolist() == [one.terminated for one in kept["episodes"]]
        assert data.reward.tolist() == [r for one in kept["episodes"] for r in one.reward]
        write = action_writer(kept["action_space"], prepared.config.rescale_actions)
        taken = [write(action) for action in data.action]
        expected = [action for one in kept["episodes"] for action in one.action]
        np.testing.assert_allclose(np.array(taken), np.array(expected), rtol=1e-5, atol=1e-6)
        found[to] = data
    one, other = found.values()
    for name, array, same in zip(one._fields, one, other, strict=True):
        np.testing.assert_array_equal(array, same, err_msg=name)
    assert one.digest == other.digest


def choosy(to: str, run: Path) -> dict[str, Any]:
    """Episodes of a masked policy, which a run of one iteration holds."""
    if not run.exists():
        settings = {**SMALL, "arm": "ppo", "processes": 1, "steps": 64, "seeds": 1, **MASKED}
        sauna.train("small_envs:Choosy", quiet=True, out=run, **settings)
    return sauna.record(run, to, episodes=12, say=lambda text: None)


def test_a_masked_policy_is_cloned_from_both_kinds_of_file(tmp_path, monkeypatch) -> None:
    """Choosy raises at an action that is not valid, also at the first that a clone takes."""
    import minari

    made = []
    for number, to in enumerate((str(tmp_path / "a.parquet"), f"minari:{tmp_path}/a-v0")):
        found, out = choosy(to, tmp_path / "run"), tmp_path / f"clone-{number}"
        settings = {**SMALL, "arm": "ppo", "processes": 1, "steps": 64, "seeds": 1, **MASKED}
        sauna.train("small_envs:Choosy", quiet=True, out=out, init_from=f"data:{to}", **settings)
        origin = read_config(out)["initial"]
        assert origin["env_steps"] == found["env_steps"] == 12 * 6
        held = origin["members"]["ppo/0"]
        assert held["held_out"]["log_likelihood"] > held["before"]["log_likelihood"]
        made.append(origin)
    assert made[0]["sha256"] == made[1]["sha256"]
    assert made[0]["members"] == made[1]["members"]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("a-v0")
    assert dataset[0].infos["action_mask"].shape == (7, 5)
    assert dataset.observation_space == small_envs.Choosy.observation_space


def test_masks_that_are_missing_or_none_are_refused(tmp_path: Path) -> None:
    import pyarrow.parquet

    path = tmp_path / "a.parquet"
    choosy(str(path), tmp_path / "run")
    table = pyarrow.parquet.read_table(path)
    overrides = {"env": "small_envs:Choosy", "arm": "ppo", "init_from": f"data:{path}"}
    prepared = prepare({**overrides, **MASKED})
    assert _read(prepared).observation.shape == (72, 3 + 5)
    # Whoever does not act by masks does not need them.
    plain = describe(small_envs.Choosy.observation_space, small_envs.spaces.Discrete(5, start=1))
    assert {e.observation.shape for e in read_parquet(path, "data:a", plain, "")} == {(6, 3)}
    empty = pyarrow.array([[0] * 5] * 72, pyarrow.list_(pyarrow.int8()))
    short = pyarrow.array([[1] * 4] * 72, pyarrow.list_(pyarrow.int8()))
    index = table.column_names.index("action_mask")
    for changed, message in (
        (table.drop_columns(["action_mask"]), "has no action_mask, which this policy acts by"),
        (table.set_column(index, "action_mask", empty), "the action mask leaves no valid action"),
        (table.set_column(index, "action_mask", short), "has 4 entries instead of 5"),
    ):
        pyarrow.parquet.write_table(changed, path)
        with pytest.raises(BadInput, match=message):
            _read(prepared)
    to = f"minari:{tmp_path}/b-v0"
    recorded("small_envs:Choosy", MASKED["env_kwargs"], to, valid=True)
    with pytest.raises(BadInput, match="has no action_mask"):
        _read(prepare({**overrides, **MASKED, "init_from": f"data:{to}"}))


def test_minari_users_find_the_dataset_and_pandas_users_the_table(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    import minari

    kept = recorded("CartPole-v1", {}, "minari:cartpole/random-v3", 4)
    dataset = minari.load_dataset("cartpole/random-v3")
    steps = sum(len(one.reward) for one in kept["episodes"])
    assert (dataset.total_episodes, dataset.total_steps) == (4, steps)
    assert next(iter(dataset.storage.get_episode_metadata([2])))["seed"] == 2
    np.testing.assert_array_equal(dataset[1].observations, kept["episodes"][1].observation)
    env = dataset.recover_environment()
    assert env.spec.id == "CartPole-v1"
    assert list(minari.list_local_datasets()) == ["cartpole/random-v3"]
    assert not list((tmp_path / "sets").glob(".sauna-*"))

    recorded("CartPole-v1", {}, str(tmp_path / "a.parquet"), 4)
    table = pytest.importorskip("pandas").read_parquet(tmp_path / "a.parquet")
    assert len(table) == steps and table.groupby("episode").size().sum() == steps
    assert table.groupby("episode").tail(1).final_observation.notna().all()
    assert table.final_observation.notna().sum() == 4
    returns = table.groupby("episode").reward.sum().tolist()
    assert returns == [one.reward.sum() for one in kept["episodes"]]


def test_a_table_of_somebody_else_needs_five_columns(tmp_path: Path) -> None:
    spaces = describe(small_envs.Scripted.observation_space, small_envs.Scripted.action_space)
    columns = {
        "episode": [0, 0, 1],
        "observation": [[1.0, 2.0, 3.0]] * 3,
        "action": [[0.5, 0.5]] * 3,
        "reward": [1.0, 2.0, 3.0],
        "terminated": [False, True, False],
    }

    def read(**changes: Any) -> list[Any]:
        path = tmp_path / "theirs.parquet"
        table = {k: v for k, v in {**columns, **changes}.items() if v is not None}
        pyarrow.parquet.write_table(pyarrow.table(table), path)
        return list(read_parquet(path, "data:theirs", spaces, "small_envs:Scripted"))

    import pyarrow.parquet

    one, two = read()
    assert one.terminated and not two.terminated and two.final.tolist() == [1.0, 2.0, 3.0]
    assert one.reward.tolist() == [1.0, 2.0]
    for changes, message in (
        ({"reward": None}, "no column 'reward'"),
        ({"action": [[0.5, 0.5], [0.5], [0.5]]}, "'action' has lists of several lengths"),
        ({"action": [[0.5, 0.5], None, [0.5, 0.5]]}, "'action' has holes"),
        ({"reward": ["1", "2", "3"]}, "'reward' is of type string"),
    ):
        with pytest.raises(BadInput, match=message):
            read(**changes)
    (tmp_path / "text.parquet").write_text("no table")
    with pytest.raises(BadInput, match="is no Parquet file"):
        list(read_parquet(tmp_path / "text.parquet", "data:text", spaces, ""))
    with pytest.raises(BadInput, match="cannot be read: No such file"):
        list(read_parquet(tmp_path / "none.parquet", "data:none", spaces, ""))


def test_other_spaces_and_taken_names_are_refused(tmp_path: Path) -> None:
    for to in (str(tmp_path / "a.parquet"), f"minari:{tmp_path}/a-v0"):
        recorded("small_envs:Scripted", {}, to)
        prepared = prepare({"env": "small_envs:Endless", "arm": "ppo", "init_from": f"data:{to}"})
        with pytest.raises(BadInput, match="has other spaces than small_envs:Endless: observation"):
            _read(prepared)
        with pytest.raises(BadInput, match="is there already"):
            recorded("small_envs:Scripted", {}, to)
    with pytest.raises(BadInput, match="no name of a Minari dataset"):
        recorded("small_envs:Scripted", {}, f"minari:{tmp_path}/noversion")
    spaces = describe(small_envs.Scripted.observation_space, small_envs.Scripted.action_space)
    with pytest.raises(BadInput, match="cannot be read as a Minari dataset"):
        list(read_minari(f"minari:{tmp_path}/none-v0", "data:none", spaces, ""))


def test_a_dataset_that_would_make_its_environment_is_refused(tmp_path: Path) -> None:
    import json

    recorded("small_envs:Scripted", {}, f"minari:{tmp_path}/a-v0")
    file = tmp_path / "a-v0" / "data" / "metadata.json"
    stored = json.loads(file.read_text())
    del stored["action_space"]
    file.write_text(json.dumps({**stored, "env_spec": '{"id": "nowhere:Evil-v0"}'}))
    spaces = describe(small_envs.Scripted.observation_space, small_envs.Scripted.action_space)
    with pytest.raises(BadInput, match="does not say its spaces"):
        list(read_minari(f"minari:{tmp_path}/a-v0", "data:a", spaces, ""))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a-v0"]


def test_nothing_is_left_of_a_recording_that_failed(tmp_path: Path) -> None:
    made = make_env("small_envs:Scripted", {})
    spaces = describe(made.observation_space, made.action_space)
    for to in (str(tmp_path / "a.parquet"), f"minari:{tmp_path}/a-v0"):
        with (
            pytest.raises(RuntimeError),
            _writer(to, made, {"spaces": list(spaces), "version": "0", "member": "ppo/0"}) as add,
        ):
            listener = _Listener(made)
            listener.reset(seed=0)
            listener.step(made.action_space.sample())
            add(listener.recorded(0))
            raise RuntimeError("the environment broke")
    assert list(tmp_path.iterdir()) == []
