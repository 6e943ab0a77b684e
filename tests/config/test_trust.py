"""Code that a stored run or study names runs for the user who named it, and for nobody else."""

from __future__ import annotations

import json
import shutil
import stat
import sys
from pathlib import Path

import pytest

import sauna
from helpers import SMALL
from sauna import cli
from sauna.config.trust import arguments_of, check_trusted, covers, key_file, named_code, seal
from sauna.experiments.study.command import check_study
from sauna.experiments.study.spec import load_spec
from sauna.system import run_directory
from sauna.system.errors import BadInput

STORED = {
    "config": {"env": "mine:Env", "env_kwargs": {"b": 1, "a": 2}, "network": "mlp"},
    "arms": {"sauna": {"filter": "mine:keep"}, "ppo": {"filter": "none"}},
}
# A module that leaves a trace when it is imported.
TRAP = "from pathlib import Path\nPath(__file__).with_name('was-run').touch()\nraise SystemExit\n"


@pytest.fixture
def key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "config" / "sauna" / "key"
    monkeypatch.setenv("SAUNA_KEY_FILE", str(path))
    return path


def test_all_code_is_found_wherever_it_is_named() -> None:
    assert named_code(STORED) == [["env", "mine:Env"], ["filter", "mine:keep"]]
    study = {"tasks": ["Hopper-v5", "a:b"], "arms": [{"network": "c:d"}], "name": "x:y"}
    assert named_code(study) == [["env", "a:b"], ["network", "c:d"]]
    plain = {"env": "ALE/Pong-v5", "filter": "sauna", "vex_target": "sample", "out": "a:b"}
    assert named_code(plain) == []
    assert named_code({"env": "sauna.config.local:thing"}) == []
    assert named_code({"env": "GymV26Environment-v0"}) == [["env", "GymV26Environment-v0"]]
    assert arguments_of(STORED) == arguments_of({"env_kwargs": '{"a": 2, "b": 1}'}) != []


def test_a_seal_is_of_this_user_and_of_what_it_names(key: Path) -> None:
    own = seal(STORED)
    check_trusted(STORED, "run", own, trust=False)
    assert stat.S_IMODE(key.stat().st_mode) == 0o600 and len(key.read_text()) == 65
    others = [
        {**STORED, "config": {**STORED["config"], "env": "evil:Env"}},
        {**STORED, "config": {**STORED["config"], "env_kwargs": {"file": "/etc/passwd"}}},
        {**STORED, "given": {"vex_target": "evil:target"}},
    ]
    for other in others:
        with pytest.raises(BadInput, match=r"names code that would run.*--trust"):
            check_trusted(other, "run", own, trust=False)
        check_trusted(other, "run", own, trust=True)
        assert not covers(STORED, other)
    check_trusted({"config": STORED["config"]}, "run", own, trust=False)  # less is no harm
    for forged in (None, [], "x", {**own, "mac": "0" * 64}, {**own, "mac": 1}, {"mac": "é"}):
        with pytest.raises(BadInput, match="not known to be yours"):
            check_trusted(STORED, "run", forged, trust=False)
    key.unlink()  # another user, or another machine
    with pytest.raises(BadInput, match=r"env 'mine:Env', filter 'mine:keep'"):
        check_trusted(STORED, "run", own, trust=False)


def test_a_key_that_others_can_read_is_none(key: Path) -> None:
    seal(STORED)
    key.chmod(0o644)
    with pytest.raises(BadInput, match="chmod 600"):
        seal(STORED)
    key.chmod(0o600)
    key.write_text("short")
    with pytest.raises(BadInput, match="key"):
        seal(STORED)


def test_where_no_key_can_be_kept_this_process_still_knows_its_own(monkeypatch) -> None:
    monkeypatch.setenv("SAUNA_KEY_FILE", "/proc/nowhere/key")
    check_trusted(STORED, "run", seal(STORED), trust=False)
    monkeypatch.delenv("SAUNA_KEY_FILE")
    monkeypatch.setenv("XDG_CONFIG_HOME", "/somewhere")
    assert key_file() == Path("/somewhere/sauna/key")


def test_a_run_of_somebody_elses_runs_nothing(tmp_path: Path, key: Path, monkeypatch) -> None:
    """Started with one key, opened with another; then trusted, and from then on one's own."""
    run = tmp_path / "run"
    sauna.train("small_envs:Scripted", out=run, quiet=True, **{**SMALL, "arm": "ppo"})
    shutil.move(run, tmp_path / "moved")
    run = tmp_path / "moved"
    assert sauna.evaluate(run, episodes=1)["members"]
    key.unlink()
    imported = []
    monkeypatch.setattr("sauna.envs.make.import_name", lambda *names: imported.append(names))
    for command in (["eval"], ["inspect", "--no-pictures"], ["resume"]):
        with pytest.raises(SystemExit) as end:
            cli.main([command[0], str(run), *command[1:]])
        assert end.value.code == 2
    for call in (sauna.load, sauna.evaluate, sauna.inspect, sauna.resume):
        with pytest.raises(BadInput, match=r"'small_envs:Scripted'; if you trust it, give --trust"):
            call(run)
    assert imported == []
    monkeypatch.undo()
    monkeypatch.setenv("SAUNA_KEY_FILE", str(key))
    assert sauna.evaluate(run, episodes=1, trust=True)["members"]
    (run / "summary.json").unlink()
    sauna.resume(run, trust=True, quiet=True)
    assert sauna.evaluate(run, episodes=1)["members"]


def test_a_manifest_may_not_name_more_than_its_run(tmp_path: Path, key: Path) -> None:
    run = tmp_path / "run"
    sauna.train("InvertedPendulum-v5", out=run, quiet=True, **{**SMALL, "arm": "ppo"})
    key.unlink()
    assert sauna.evaluate(run, episodes=1)["members"]  # names no code: needs no seal
    stored = json.loads((run / "config.json").read_text())
    stored["config"]["network"] = "evil:Network"
    (run / "config.json").write_text(json.dumps(stored))
    with pytest.raises(BadInput, match="evil:Network"):
        sauna.resume(run)


@pytest.mark.parametrize("field", ["network", "filter", "vex_target", "tasks"])
def test_a_studys_file_runs_nothing_before_it_is_trusted(
    tmp_path: Path, key: Path, monkeypatch: pytest.MonkeyPatch, field: str
) -> None:
    (tmp_path / "trapped.py").write_text(TRAP)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    task = "trapped:thing" if field == "tasks" else "InvertedPendulum-v5"
    text = f'name = "theirs"\ntasks = ["{task}"]\n[[arms]]\nlabel = "sauna"\n'
    text += f'{field} = "trapped:thing"\n' if field != "tasks" else ""
    (tmp_path / "theirs.toml").write_text(text)
    with pytest.raises(SystemExit) as end:
        cli.main(["study", "theirs.toml"])
    assert end.value.code == 2 and not (tmp_path / "was-run").exists()
    assert not (tmp_path / "runs").exists()


def test_a_study_that_was_run_before_needs_no_trust(tmp_path: Path, key: Path) -> None:
    text = {"name": "mine", "tasks": ["small_envs:Scripted"]}
    with pytest.raises(BadInput, match="study 'mine' names code"):
        check_study(text, tmp_path, trust=False)
    (tmp_path / "mine").mkdir()
    run_directory.write_json(tmp_path / "mine" / "study.json", {"seal": seal(text)})
    check_study(text, tmp_path, trust=False)
    load_spec("table1", lambda text: pytest.fail("a study of this package needs no trust"))


def test_a_config_of_somebody_elses_is_no_way_around(tmp_path: Path, key: Path, capsys) -> None:
    file = tmp_path / "config.json"
    file.write_text(json.dumps({"env": "InvertedPendulum-v5", "network": "evil:Network"}))
    with pytest.raises(SystemExit) as end:
        cli.main(["train", "--config", str(file)])
    assert end.value.code == 2 and "network 'evil:Network'" in capsys.readouterr().err
