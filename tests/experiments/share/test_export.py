"""An exported policy opens again as a run does, says what it is, and is refused once changed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import sauna
from helpers import SMALL
from sauna import cli
from sauna.config.presets import resolve
from sauna.experiments.share.card import FILES, command
from sauna.system import hub, run_directory
from sauna.system.checkpoint import BadCheckpoint, NewerFormat
from sauna.system.errors import BadInput
from sauna.training.artifact import load_artifact
from sauna.training.initial import load_initial
from sauna.training.located import zoo

SETTINGS = {**SMALL, "processes": 1, "steps": 64, "eval_every": 32, "eval_episodes": 1}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exported") / "run"
    sauna.train("InvertedPendulum-v5", quiet=True, out=path, **{**SETTINGS, "seeds": 2})
    return path


@pytest.fixture(scope="module")
def policy(run: Path) -> Path:
    """Of the second member, as numpy, too."""
    return sauna.export(run, run.parent / "policy", member=1, numpy=True, episodes=2)


def changed(policy: Path, to: Path, **changes: object) -> Path:
    shutil.copytree(policy, to)
    stored = json.loads((to / "policy.json").read_text())
    (to / "policy.json").write_text(json.dumps({**stored, **changes}))
    return to


def test_it_acts_and_plays_as_its_member(run: Path, policy: Path) -> None:
    seen = np.linspace(-1, 1, 20).reshape(5, 4)
    expected = sauna.load(run, 1)(seen)
    np.testing.assert_array_equal(sauna.load(policy)(seen), expected)
    assert not np.array_equal(sauna.load(run, 0)(seen), expected)
    played = sauna.evaluate(policy, episodes=2, deterministic=True, seed=1000)
    of_run = sauna.evaluate(run, member=1, episodes=2, deterministic=True, seed=1000)
    assert played["members"] == of_run["members"]
    stored = run_directory.read_config(policy, exported=True)
    assert stored["evaluation"]["returns"] == of_run["members"]["ppo/1"]["returns"]
    assert stored["env_steps"] == 64 and stored["members"] == ["ppo/1"]


def test_a_link_to_a_run_is_evaluated_as_the_run(run: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(run)
    how = {"episodes": 1, "deterministic": True, "seed": 5}
    assert sauna.evaluate(link, **how) == sauna.evaluate(run, **how)
    assert (link / "evaluation_deterministic.json").is_file()


def test_nothing_of_the_user_is_in_it(run: Path, policy: Path) -> None:
    names = {str(path.relative_to(policy)) for path in policy.rglob("*") if path.is_file()}
    written = {"evaluation_deterministic.json"}  # by the test above
    assert names - written - {name for name in names if "__pycache__" in name} == {
        "README.md",
        "policy.json",
        "policy.safetensors",
        "numpy/policy.py",
        "numpy/policy.safetensors",
    }
    for name in ("README.md", "policy.json", "numpy/policy.py"):
        assert str(run.parent) not in (policy / name).read_text()
    assert b"optimizer" not in (policy / "policy.safetensors").read_bytes()


def test_the_best_evaluation_is_exported(run: Path, tmp_path: Path) -> None:
    best = sauna.export(run, tmp_path / "best", best=True, episodes=0)
    seen = np.ones(4)
    np.testing.assert_array_equal(sauna.load(best)(seen), sauna.load(run, best=True)(seen))
    assert run_directory.read_config(best, exported=True)["best"] is True
    assert "It was not evaluated" in (best / "README.md").read_text()
    with pytest.raises(BadInput, match=r"best: .* is an exported policy"):
        sauna.load(best, best=True)


def test_a_new_run_starts_from_it(run: Path, policy: Path, tmp_path: Path) -> None:
    settings = {**SMALL, "processes": 1, "steps": 32, "init_from": policy}
    sauna.train("InvertedPendulum-v5", quiet=True, out=tmp_path / "new", **settings)
    initial = load_initial(tmp_path / "new", load_artifact(tmp_path / "new").config)
    expected = load_artifact(policy).checkpoint.arrays
    for name in ("params/policy_head/kernel", "observation_moments/mean"):
        np.testing.assert_array_equal(initial[f"ppo/0/{name}"], expected[f"ppo/1/{name}"])
    stored = run_directory.read_config(tmp_path / "new")
    run_directory.write_config(tmp_path / "new", {**stored, "extended": [{"steps": 16}]})
    tuned = sauna.export(tmp_path / "new", tmp_path / "tuned", episodes=0)
    for again in (tuned, sauna.export(tuned, tmp_path / "again", episodes=0)):
        card = (again / "README.md").read_text()
        assert "It began with the weights of another run" in card and str(policy) not in card
        assert "first to have 16 env steps" in card
    card = (policy / "README.md").read_text()  # of a run from new weights
    assert "It began" not in card and "first to have" not in card


def test_numbers_are_read_as_on_the_command_line(tmp_path: Path) -> None:
    own, to = zoo()["CartPole-v1"], tmp_path / "x"
    for name, value in (("episodes", 1.5), ("episodes", -1), ("seed", "x"), ("seed", True)):
        with pytest.raises(BadInput, match=f"{name}: must be a whole number of at least 0"):
            sauna.export(own, to, **{name: value})
    assert not to.exists()
    sauna.export(own, to, episodes=np.int64(1), seed=np.int64(7))
    played = run_directory.read_config(to, exported=True)["evaluation"]
    assert (played["episodes"], played["seed"]) == (1, 7)


def test_a_path_that_it_started_from_is_left_out(tmp_path: Path) -> None:
    own = zoo()["CartPole-v1"]
    stored = run_directory.read_config(own, exported=True)
    config = {**stored["config"], "init_from": "data:/home/me/secret.parquet"}
    again = sauna.export(changed(own, tmp_path / "old", config=config), tmp_path / "x", episodes=0)
    for name in ("README.md", "policy.json"):
        assert "secret" not in (again / name).read_text()
    sauna.load(again)


def test_the_card_says_what_was_done(run: Path, policy: Path) -> None:
    text = (policy / "README.md").read_text()
    front = dict(line.split(": ", 1) for line in text.split("---\n")[1].splitlines())
    (model,) = json.loads(front["model-index"])
    played = run_directory.read_config(policy, exported=True)["evaluation"]
    (metric,) = model["results"][0]["metrics"]
    assert metric["value"] == f"{played['mean']:.2f} +/- {played['std']:.2f}"
    assert "InvertedPendulum-v5" in json.loads(front["tags"])
    assert "64 env steps" in text and "| `ppo/0` |" in text and "| `ppo/1` |" in text
    typed = command(run_directory.read_config(policy, exported=True)).split()
    parsed, unknown = cli.make_parser().parse_known_args(typed[1:])
    settings = {k: v for k, v in vars(parsed).items() if v is not None and k != "command"}
    again = resolve({k: v for k, v in settings.items() if k not in ("config", "trust")})
    config = load_artifact(run).config
    assert not unknown and (again.hidden, again.seeds, again.steps) == (
        config.hidden,
        config.seeds,
        config.steps,
    )


@pytest.mark.parametrize("how", ["resume", "inspect"])
def test_what_needs_a_run_says_so(policy: Path, how: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as exit:
        cli.main([how, str(policy)])
    error = capsys.readouterr().err
    assert exit.value.code == 2 and error.count("\n") == 1 and "exported policy" in error


def test_a_changed_file_is_refused(policy: Path, tmp_path: Path) -> None:
    broken = changed(policy, tmp_path / "bits")
    blob = bytearray((broken / "policy.safetensors").read_bytes())
    blob[-1] ^= 1
    (broken / "policy.safetensors").write_bytes(blob)
    with pytest.raises(BadCheckpoint, match="SHA-256 differs"):
        sauna.load(broken)
    with pytest.raises(NewerFormat, match="newer version"):
        sauna.load(changed(policy, tmp_path / "newer", format=2))
    for number, change in enumerate(({"members": []}, {"bytes": "1"}, {"spaces": [1]})):
        with pytest.raises(BadCheckpoint):
            sauna.load(changed(policy, tmp_path / str(number), **change))


def test_code_that_somebody_elses_names_does_not_run(policy: Path, tmp_path: Path) -> None:
    stored = run_directory.read_config(policy, exported=True)
    evil = {**stored["config"], "env": "evil_of_somebody:thing"}
    with pytest.raises(BadInput, match=r"names code that would run.*evil_of_somebody.*--trust"):
        sauna.load(changed(policy, tmp_path / "evil", config=evil))


def test_the_command_names_every_file(run: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "listed"
    cli.main(["export", str(run), "--to", str(folder), "--numpy", "--episodes", "0"])
    first, *lines = capsys.readouterr().out.splitlines()
    written = {str(path.relative_to(folder)) for path in folder.rglob("*.*") if path.is_file()}
    written -= {name for name in written if "__pycache__" in name}
    assert first == f"policy: {folder}" and {line.split()[0] for line in lines} == written
    assert all(len(line.split()) > 2 for line in lines)
    assert set(FILES) == set(hub.FILES)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--member", "7"], "7 is not between 0 and 1"),
        (["--episodes", "-1"], "episodes"),
        (["--to", "."], "is not empty"),
    ],
)
def test_bad_input_creates_nothing(
    run: Path, tmp_path: Path, arguments: list[str], message: str, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as exit:
        cli.main(["export", str(run), "--to", "new/policy", *arguments])
    assert exit.value.code == 2 and message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
