"""Row 5: a checkpoint of another version, environment or network is refused by the field."""

from __future__ import annotations

import json
import random
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from faults.canned import BACKENDS, ENV, Trap, played_back, record, until
from faults.disk import tree_of
from faults.make_golden import GOLDEN
from faults.result import Result, Tally, assert_held
from helpers import SMALL
from sauna.config import presets
from sauna.config.settings import FIELDS, TYPES, fields_with
from sauna.experiments.evaluate.episodes import evaluate
from sauna.experiments.inspect.inspection import examine
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.training.artifact import load_artifact
from threads import trained_here

# A value of the same type that is another one, where adding 1 would not be.
OTHERS = {
    "arm": ["sauna"],
    "seeds": [7],
    "preset": "mujoco-release",
    "hidden": [8, 9],
    "value_hidden": [8],
    "gamma": 0.5,
    "gae_lambda": 0.5,
    "drop_rate": 0.25,
    "stop_at": 2.0,
    "init_from": "runs/another",
    "wrap": ["wrappers:plus_one"],
}


def experiment(least: int, seed: int, place: Path) -> Result:
    """Changes each setting, space, member and format. `worst`: seconds of the slowest refusal.

    On each backend.
    """
    tally = Tally()
    for backend in BACKENDS:
        _change_everything(backend, least, random.Random(seed), place, tally)
    return tally.result()


def _change_everything(
    backend: str, least: int, rng: random.Random, place: Path, tally: Tally
) -> None:
    whole, env = place / backend, BACKENDS[backend]
    with played_back(record(env)):
        until(whole, Trap(), env)
        (whole / "summary.json").unlink()
        names = [name for name in FIELDS if name not in (*fields_with("resumable"), "out")]
        for name in names if least >= 40 else rng.sample(names, least - 3):
            _change_setting(whole, place / "run", name, tally)
        for name in ("format", "spaces", "members"):
            _change_manifest(whole, place / "run", name, tally)


def _change_setting(whole: Path, run: Path, name: str, tally: Tally) -> None:
    """In the run's config, so that its checkpoints are those of another run."""
    _copy(whole, run)
    path = run / "config.json"
    stored = json.loads(path.read_text())
    before = stored["config"][name]
    stored["config"][name] = _other(name, before)
    path.write_text(json.dumps(stored))
    # The environment cannot be made with them; the sequences do not fill the minibatches; stacked
    # observations are other ones.
    refusers = {"env_kwargs": "env", "recurrent": "minibatches", "stack": "observation"}
    refuser = refusers.get(name, name)
    _expect_refusal(run, refuser, f"setting {name}", tally)


def _other(name: str, value: Any) -> Any:
    if name == "env":
        return {"small_envs:Scripted": "small_envs:Forgetful"}.get(value, "jax_envs:broken")
    if name.endswith("_kwargs"):
        return {"speed": 2}
    if name in OTHERS:
        return OTHERS[name]
    if isinstance(value, dict):
        return {"other": 1}
    if FIELDS[name].metadata["choices"]:
        return next(c for c in FIELDS[name].metadata["choices"] if c != value and c != "auto")
    return not value if TYPES[name] is bool else value + 1


def _change_manifest(whole: Path, run: Path, name: str, tally: Tally) -> None:
    """In the newest checkpoint's manifest, with the right digest: another run's, as it was."""
    _copy(whole, run)
    newest = checkpoint.numbered(run / "checkpoints")[-1]
    manifest = json.loads((newest / "manifest.json").read_text())
    change = {"format": checkpoint.FORMAT + 1, "spaces": ["vector", [9]], "members": ["ppo/9"]}
    manifest[name] = change[name]
    manifest["manifest_sha256"] = checkpoint._digest(manifest)
    (newest / "manifest.json").write_text(json.dumps(manifest))
    _expect_refusal(run, name, f"manifest {name}", tally)


def _copy(whole: Path, run: Path) -> None:
    """The newest state is unreadable: a refusal has to come before tensors are loaded."""
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(whole, run)
    newest = checkpoint.numbered(run / "checkpoints")[-1]
    (newest / "state.safetensors").write_bytes(b"unreadable")


def _expect_refusal(run: Path, name: str, what: str, tally: Tally) -> None:
    before = _tree(run)
    clock = time.perf_counter()
    try:
        sauna.resume(run, quiet=True)
        tally.miss(f"{what}: was resumed")
    except SaunaError as error:
        if name not in str(error) or "SHA-256" in str(error):
            tally.miss(f"{what}: refused as {error}")
    tally.took(time.perf_counter() - clock)
    tally.tried += 1
    if _tree(run) != before:
        tally.lose(f"{what}: something was changed")


def _tree(run: Path) -> dict[str, bytes | None]:
    return {name: data for name, data in tree_of(run).items() if name != ".lock"}


def test_what_belongs_to_another_run_is_refused_by_the_field(tmp_path: Path) -> None:
    tally = Tally()
    _change_everything("host", 15, random.Random(0), tmp_path, tally)
    assert_held(tally.result(), 15)


def test_every_field_that_differs_is_named(tmp_path: Path) -> None:
    with played_back(record()):
        until(tmp_path / "run", Trap())
        (tmp_path / "run" / "summary.json").unlink()
        path = tmp_path / "run" / "config.json"
        stored = json.loads(path.read_text())
        stored["config"] |= {"gamma": 0.5, "clip_range": 0.1}
        path.write_text(json.dumps(stored))
        with pytest.raises(BadInput, match=r"clip_range is 0\.2, not 0\.1; gamma is 0\.99, not 0"):
            sauna.resume(tmp_path / "run", quiet=True)


GOLDEN_RUNS = [
    pytest.param(path, id=path.name, marks=[pytest.mark.slow] if "device" in path.name else [])
    for path in sorted(GOLDEN.iterdir())
]


def test_an_older_format_is_migrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Format 0 never was: the chain of migrations is what is tested."""
    path = checkpoint.save_checkpoint(tmp_path, 3, {"a": np.arange(3.0)}, {"logs": {}}, 1)
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["names"] = manifest.pop("members", ["ppo/0"])
    manifest["format"] = 0
    manifest["manifest_sha256"] = checkpoint._digest(manifest)
    (path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(checkpoint.BadCheckpoint, match="not a checkpoint of format"):
        checkpoint.load_checkpoint(path)

    def rename(old: dict[str, Any]) -> dict[str, Any]:
        return {**old, "members": old.pop("names")}

    monkeypatch.setitem(checkpoint.MIGRATIONS, 0, rename)
    assert checkpoint.load_checkpoint(path).manifest["members"] == ["ppo/0"]


@pytest.mark.parametrize("golden", GOLDEN_RUNS)
def test_runs_of_every_format_there_was_can_be_used(golden: Path, tmp_path: Path, capsys) -> None:
    """Its rows are kept, its policy acts, and it is trained to its end."""
    run = tmp_path / "run"
    shutil.copytree(golden, run)
    loaded = load_artifact(run, trust=True)
    assert loaded.checkpoint.manifest["format"] == checkpoint.FORMAT
    spaces = loaded.spaces
    with pytest.raises(BadInput, match=r"names code .* give --trust"):
        sauna.load(run)  # it was made by somebody else, whose key is not here
    assert (
        sauna.load(run, trust=True)(np.zeros(spaces.observation_shape)).shape == spaces.action_sizes
    )
    with trained_here():  # our environments may have changed since
        sauna.resume(run, trust=True, accept_changed_code=True)
    assert run_directory.is_complete(run)
    kept = loaded.checkpoint.manifest["logs"]["metrics.jsonl"]
    rows, old = (run / "metrics.jsonl").read_bytes(), (golden / "metrics.jsonl").read_bytes()
    assert rows[:kept] == old[:kept] and len(run_directory.rows(run)) == 6


def test_an_old_run_ends_alike_under_other_presets(tmp_path: Path, monkeypatch) -> None:
    """What 0.1.0 stored is enough: nothing is taken from the presets, arms or defaults of today."""
    ended = []
    for name in ("first", "second"):
        shutil.copytree(GOLDEN / "format-1-host", tmp_path / name)
        with trained_here():
            sauna.resume(tmp_path / name, quiet=True, trust=True)
        newest = checkpoint.load_newest(tmp_path / name / "checkpoints", print)
        assert newest is not None and newest.manifest["arms"] == {"ppo": {}}
        ended.append((newest.manifest["sha256"], (tmp_path / name / "metrics.jsonl").read_bytes()))
        other = {"learning_rate": 0.1, "gamma": 0.5, "vex_coef": 0.9}
        monkeypatch.setitem(presets.PRESETS, "mujoco", other)
        monkeypatch.setitem(presets.ARMS, "ppo", {"filter": "sauna", "vex_coef": 0.2})
    assert ended[0] == ended[1]


def test_a_run_of_0_1_0_that_repeats_drop_rates_is_played_and_not_resumed(tmp_path: Path) -> None:
    """One of today's, stored as 0.1.0 stored it."""
    run, settings = tmp_path / "run", {"arm": "random-drop", "drop_rate": 0.4, "vex_coef": 0.1}
    sauna.train(ENV, quiet=True, out=run, **SMALL, **settings)
    former = {"drop_rate": 0.0, "drop_rate_from": "elsewhere"}
    stored = run_directory.read_config(run)
    stored["config"] |= former
    run_directory.write_json(run / "config.json", {**stored, "drop_rates": [[0.4] * 9]})
    for path in checkpoint.numbered(run / "checkpoints"):
        manifest = json.loads((path / "manifest.json").read_text())
        manifest["config"] |= former
        manifest["manifest_sha256"] = checkpoint._digest(manifest)
        (path / "manifest.json").write_text(json.dumps(manifest))
    (run / "summary.json").unlink()
    found = examine(
        run,
        load_artifact(run),
        "random-drop/0",
        episodes=2,
        deterministic=False,
        seed=0,
        frames=False,
        say=print,
    )
    assert found.last["keep_rate"] == pytest.approx(0.6, abs=0.2)
    assert found.hypers.drop_rate == pytest.approx(1 - found.last["keep_rate"])
    assert 0.3 < found.decisions.keep.mean() < 0.9
    assert len(evaluate(run, episodes=1)["members"]["random-drop/0"]["returns"]) == 1
    before = _tree(run)
    with pytest.raises(BadInput, match=r"drop_rate_from: .* repeats the drop rates of another run"):
        sauna.resume(run, quiet=True)
    assert _tree(run) == before


def test_other_versions_of_the_libraries_are_told(tmp_path: Path, capsys, monkeypatch) -> None:
    with played_back(record()):
        until(tmp_path / "run", Trap())
        (tmp_path / "run" / "summary.json").unlink()
        plain = run_directory.versions()
        monkeypatch.setattr(run_directory, "versions", lambda: {**plain, "jax": "9.9.9"})
        sauna.resume(tmp_path / "run")
    assert f"jax {plain['jax']} -> 9.9.9" in capsys.readouterr().out
