"""A run that starts from the weights of a trained one."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from faults.canned import BACKENDS
from helpers import SMALL, equal, make_job, train_here
from sauna.config.presets import Member, resolve_run
from sauna.config.settings import Config
from sauna.experiments.study.found_runs import check_same_start
from sauna.experiments.study.units import Unit
from sauna.system import checkpoint, run_directory
from sauna.system.checkpoint import under
from sauna.system.errors import BadInput
from sauna.training.artifact import _reward_moments
from sauna.training.initial import Source, _matters, _source_of, read_initial
from sauna.training.prepare import prepare
from threads import trained_here

SETTINGS: dict[str, Any] = {**SMALL, "arm": "ppo", "processes": 1, "seeds": 2}


@pytest.fixture(scope="module", params=BACKENDS)
def trained(request, tmp_path_factory) -> tuple[str, Path]:
    """A trained run, with evaluations."""
    env, run = BACKENDS[request.param], tmp_path_factory.mktemp("trained") / "run"
    with trained_here():
        sauna.train(env, out=run, quiet=True, eval_every=64, eval_episodes=1, **SETTINGS)
    return env, run


def initial(env: str, text: Path | str, **more: Any) -> dict[str, np.ndarray]:
    found = read_initial(
        prepare({"env": env, **SETTINGS, "init_from": str(text), **more}), print, False
    )
    assert found is not None
    return found[0]


def final(run: Path) -> dict[str, np.ndarray]:
    loaded = checkpoint.load_newest(run / "checkpoints", print)
    assert loaded is not None
    return loaded.arrays


@pytest.mark.parametrize("normalizer", ["kept", "observations", "fresh"])
def test_weights_and_what_is_kept_of_the_normaliser_are_the_first_state(
    trained, normalizer
) -> None:
    env, run = trained
    job = make_job(env, **{**SETTINGS, "arm": "sauna"})
    fresh = under("sauna/1/", train_here(job, stop=0).final)
    arrays = initial(env, run, arm="sauna", init_normalizer=normalizer)
    state = under("sauna/1/", train_here(job._replace(initial=arrays), stop=0).final)
    source = under("ppo/1/", final(run))
    for name, expected in (
        ("params", source),
        ("adam", fresh),
        ("observation_moments", fresh if normalizer == "fresh" else source),
    ):
        assert equal(under(f"{name}/", state), under(f"{name}/", expected)), name
    assert not equal(under("params/", state), under("params/", fresh))
    scaled = source if normalizer == "kept" else fresh
    assert equal(_reward_moments(state), _reward_moments(scaled)) and _reward_moments(state)
    others = [name for name in fresh if name.startswith(("counters/", "envs/", "sampler/"))]
    assert all(equal({n: state[n]}, {n: fresh[n]}) for n in others)


def test_the_best_of_a_named_member_can_be_taken(trained) -> None:
    env, run = trained
    arrays = initial(env, run / "ppo" / "1" / "best")
    best = under("ppo/1/best/params/", final(run))
    for name in ("ppo/0", "ppo/1"):
        assert equal(under(f"{name}/params/", arrays), best)


NEVER = {"field": "reward", "value": "nan", "episode": 10**9}
ELSEWHERE: dict[str, dict[str, tuple[str, dict[str, Any]]]] = {
    "small_envs:Scripted": {
        "another id": ("small_envs:Informative", {}),
        "other arguments": ("small_envs:Poisoned", NEVER),
        "the other place": ("jax_envs:wide", {}),
    },
    "jax_envs:walk": {
        "another id": ("jax_envs:informative", {}),
        "other arguments": ("jax_envs:make_walk", {"limit": 1.0}),
        "the other place": ("small_envs:Pushed", {}),
    },
}


@pytest.mark.parametrize("where", ELSEWHERE["jax_envs:walk"])
def test_it_goes_on_in_another_environment_of_the_same_spaces(trained, where: str) -> None:
    """On the host and on the device, and from the one to the other: the learning rate is so small
    that the weights stay to the bit, and the normaliser goes on from where it was."""
    env, run = trained
    other, kwargs = ELSEWHERE[env][where]
    source = under("ppo/1/", final(run))
    more = {"env_kwargs": kwargs, "learning_rate": 1e-30}
    arrays = initial(other, run, **more)
    assert equal(under("ppo/1/params/", arrays), under("params/", source))
    job = make_job(other, **SETTINGS, **more)
    assert (job.config.backend == "device") == other.startswith("jax_envs")
    trained_on = train_here(job._replace(initial=arrays))
    found = under("ppo/1/", trained_on.final)
    assert equal(under("params/", found), under("params/", source))
    counts = [arrays["observation_moments/count"].item() for arrays in (source, found)]
    assert counts[1] - counts[0] >= SMALL["steps"] - 1
    assert [row["env_steps"] for row in trained_on.rows if row["seed"] == 1] == [32, 64, 96, 128]


def test_it_is_copied_so_that_a_resume_needs_no_other_run(trained, tmp_path: Path) -> None:
    env, source = trained
    run = tmp_path / "run"
    with trained_here():
        sauna.train(env, out=run, quiet=True, init_from=str(source), **SETTINGS)
        expected = (run / "metrics.jsonl").read_bytes()
        stored = run_directory.read_config(run)
        assert stored["initial"]["members"] == {"ppo/0": "ppo/0", "ppo/1": "ppo/1"}
        stored["config"]["init_from"] = "nowhere"  # as if it were gone
        (run / "summary.json").unlink()
        (run / "checkpoints").rename(run / "killed-before-the-first")
        run_directory.write_config(run, stored)
        sauna.resume(run, quiet=True)
    assert (run / "metrics.jsonl").read_bytes() == expected
    assert expected != (source / "metrics.jsonl").read_bytes()


def test_a_study_does_not_take_runs_that_began_from_other_weights(trained, tmp_path: Path) -> None:
    env, before = trained
    source, settings = tmp_path / "source", {"env": env, "init_from": str(tmp_path / "source")}
    shutil.copytree(before, source)
    unit = Unit("unit", env, "ppo", (0, 1), settings)
    check_same_start([unit], tmp_path)  # nothing is trained yet
    with trained_here():
        sauna.train(out=unit.run(tmp_path), quiet=True, **{**SETTINGS, **settings})
        check_same_start([unit], tmp_path)
        sauna.resume(source, quiet=True, steps=2 * SETTINGS["steps"])
    with pytest.raises(BadInput, match=r"began from iteration 4 of .* has other weights now"):
        check_same_start([unit], tmp_path)
    shutil.rmtree(source)
    check_same_start([unit], tmp_path)  # it holds all that it needs


def test_what_does_not_fit_is_refused_by_its_name(trained, tmp_path: Path) -> None:
    env, run = trained
    other = "small_envs:Endless"
    for more, message in (
        ({"hidden": "8,9"}, "hidden is 8,8 in .*, and 8,9 here"),
        ({"activation": "relu"}, "activation is tanh in .*, and relu here"),
        (
            {"trunk": "shared"},
            "trunk is separate in .*, and shared here; that run has preset mujoco",
        ),
        ({"normalize_observations": False}, "normalize_observations is True in .*, and False"),
        ({"init_from": str(tmp_path)}, "is no run, and no RUN/ARM/SEED of one"),
        ({"init_from": str(run.parent)}, f"one; did you mean {run}\\?"),
        ({"init_from": f"{run}/ppo/7"}, "member: unknown member 'ppo/7'"),
    ):
        settings = {**SETTINGS, "init_from": str(run), **more}
        with pytest.raises(BadInput, match=message):
            sauna.train(env, out=tmp_path / "new", quiet=True, **settings)
    if env.startswith("small_envs"):
        with pytest.raises(BadInput, match=f"has other spaces than {other}: "):
            sauna.train(other, out=tmp_path / "new", quiet=True, init_from=str(run), **SETTINGS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("env", "matters"), [("CartPole-v1", False), ("Pendulum-v1", True)])
def test_how_actions_are_rescaled_matters_to_continuous_ones_alone(env: str, matters: bool) -> None:
    assert _matters("rescale_actions", prepare({"env": env, **SETTINGS})) == matters


def test_the_first_log_std_is_that_of_the_run(trained) -> None:
    """Its own would be read by nothing; that of a clone is where the clone begins."""
    env, run = trained
    common = {"env": env, "preset": "mujoco", "log_std_init": 1.0}
    with pytest.raises(BadInput, match=r"log_std_init: not read by .* no init_from RUN"):
        resolve_run({**common, "init_from": str(run)})
    for text in ("", "data:episodes.parquet"):
        assert resolve_run({**common, "init_from": text}).config.log_std_init == 1.0
    found = under("ppo/0/params/log_std", final(run))
    assert equal(under("ppo/0/params/log_std", initial(env, run)), found)


def test_a_foreign_run_is_refused_until_it_is_trusted(trained, tmp_path, monkeypatch) -> None:
    env, run = trained
    monkeypatch.setenv("SAUNA_KEY_FILE", str(tmp_path / "another"))
    with pytest.raises(BadInput, match="not known to be yours"):
        initial(env, run)
    overrides = {"env": env, **SETTINGS, "init_from": str(run)}
    assert read_initial(prepare(overrides), print, trust=True)


def test_a_path_names_a_run_or_a_member_of_it(tmp_path: Path) -> None:
    (tmp_path / "config.json").touch()
    for text, member, best in (
        ("", "", False),
        ("/ppo/0", "ppo/0", False),
        ("/best", "", True),
        ("/sauna+avec/3/best", "sauna+avec/3", True),
    ):
        source = Source(f"{tmp_path}{text}")
        assert (source.run, source.member, source.best) == (tmp_path, member, best)


def test_a_member_starts_from_the_one_named_the_only_one_or_its_namesake() -> None:
    member = Member("sauna/3", "sauna", 3, dataclasses.replace(Config()))
    assert _source_of(member, ["ppo/0", "ppo/3"], "ppo/0") == "ppo/0"
    assert _source_of(member, ["ppo/0"], "") == "ppo/0"
    assert _source_of(member, ["ppo/0", "ppo/3"], "") == "ppo/3"
    assert _source_of(member, ["ppo/3", "sauna/3"], "") == "sauna/3"
    with pytest.raises(BadInput, match=r"no member ppo/3 for sauna/3; name one: RUN/ppo/0"):
        _source_of(member, ["ppo/0", "ppo/1"], "")
