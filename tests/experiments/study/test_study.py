"""Studies: what is trained, that nothing is trained twice, and that a failed seed is shown."""

from __future__ import annotations

import dataclasses
import json
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from command_line import sauna, sauna_here, small_flags
from helpers import SMALL, environment
from sauna.api import compare
from sauna.config.presets import ARMS, COMPARED, resolve_run
from sauna.config.settings import parse, to_json
from sauna.envs.spaces import describe
from sauna.experiments.measure.measurement import find_measurement
from sauna.experiments.study.command import _check_runs, compare_command, comparison
from sauna.experiments.study.execute.process import UnitProcess
from sauna.experiments.study.results import _ended, cell_command
from sauna.experiments.study.spec import built_in, check, load_spec, read_spec
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.units import SEEDS, mark_split, parts, seeds_per_unit, units_of
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.training.pick import pick

TWO = {"tasks": ["A-v0"], "seeds": 6, "arms": [{"label": "ppo"}, {"label": "sauna"}]}
QUICK = {key: value for key, value in SMALL.items() if key != "seeds"}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"task": ["A"]}, "unknown key 'task'.*'tasks'"),
        ({"threshhold": 1}, "unknown key 'threshhold'.*'threshold'"),
        ({"out": "x"}, "unknown key 'out'"),
        ({"arms": [{"label": "ppo", "thresold": 1}]}, "'thresold' in an arm.*'threshold'"),
        ({"arms": [{"label": "suana"}]}, "unknown arm 'suana'.*'sauna'"),
        ({"arms": [{"label": "ppo"}, {"label": "ppo"}]}, "'ppo' is given twice"),
        ({"arms": []}, "no arms"),
        ({"arms": [3]}, "list of tables"),
        ({"tasks": "A"}, "tasks must be a list"),
        ({"baseline": "poo"}, "no arm 'poo'.*'ppo'"),
        (
            {"arms": [{"label": "ppo"}, {"label": "random-drop"}]},
            "drop needs a rate .arm sauna",
        ),
        ({"arms": [{"label": "sauna-reference+random"}]}, "control: needs gae_over=all"),
        ({"tasks": ["A-v0", "A-v0"]}, "each of them once"),
        ({"arm": "sauna"}, "unknown key 'arm'"),
        ({"name": "../x"}, "cannot be a folder"),
        ({"name": "units"}, "cannot be a folder"),
        ({"name": ".."}, "cannot be a folder"),
        ({"arms": [{"label": "ppo"}, {"label": "sauna", "baseline": "sauna"}]}, "own baseline"),
        (
            {"arms": [{"label": "ppo", "tasks": ["B-v0"]}, {"label": "sauna"}]},
            "'ppo', the baseline of 'sauna', is not trained on A-v0",
        ),
        ({"arms": [{"label": ["x"]}]}, "arm must be a name"),
        ({"arms": [{"label": "ppo"}, {"label": "sauna", "rates_of": "ppo"}]}, "key 'rates_of' in"),
        ({"threshold": 0.8, "arms": [{"label": "ppo"}]}, "threshold is read by none of the arms"),
        ({"arms": [{"label": "x", "arm": "ppo", "threshold": 0.3}]}, "arm 'x': threshold: not re"),
        ({"minibatches": 7}, "does not divide"),
        ({"seeds": "0"}, "seeds: empty"),
    ],
)
def test_mistakes_in_a_study_are_named(change: dict, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        read_spec({**TWO, **change})


def test_a_setting_for_all_arms_goes_to_those_that_read_it() -> None:
    spec = comparison("A-v0", COMPARED, {"threshold": 0.8, "gamma": 0.9, "vex_coef": 0.1})
    settings = {arm.label: arm.settings for arm in spec.arms}
    every = {"threshold": 0.8, "gamma": 0.9, "vex_coef": 0.1}
    assert settings["sauna"] == settings["sauna+random"] == every
    assert settings["ppo"] == {"gamma": 0.9}
    assert settings["vex-head"] == {"gamma": 0.9, "vex_coef": 0.1}


def test_beside_the_reference_all_arms_take_its_rules() -> None:
    spec = comparison("A-v0", ("ppo", "vex-head", "sauna-reference"), {})
    configs = [check(arm, "A-v0") for arm in spec.arms]
    assert {c.truncation for c in configs} == {"terminate"}
    assert {c.budget for c in configs} == {"env"}


@pytest.mark.parametrize(
    "given, advice",
    [({}, (5, 98)), ({"algorithm": "a2c"}, (125, 100)), ({"checkpoint_every": 1}, (1, 489))],
)
def test_the_advice_about_checkpoints_can_be_taken(given: dict, advice: tuple) -> None:
    text = {**TWO, "arms": [{"label": "sauna"}], "measure": "noise", **given}
    with pytest.raises(
        BadInput, match="checkpoint_every = {} and keep_checkpoints = {}$".format(*advice)
    ):
        read_spec(text)
    every, kept = advice
    assert read_spec({**text, "checkpoint_every": every, "keep_checkpoints": kept}).measure


def test_images_are_not_measured() -> None:
    config = check(read_spec(TWO).arms[1], "A-v0")
    spaces = describe(Box(0, 255, (84, 84, 4), np.uint8), Discrete(3))
    for measure, changed in (("noise", {}), ("coverage", {"normalize_observations": False})):
        with pytest.raises(BadInput, match=f"measure: {measure}"):
            find_measurement(measure).check_spaces(dataclasses.replace(config, **changed), spaces)
    find_measurement("coverage").check_spaces(config, spaces)


def test_the_auc_is_that_of_the_budget() -> None:
    rows = [{"env_steps": n, "return_mean": float(n)} for n in (100, 200, 300, 400)]
    assert _ended(rows, 300)["auc"] == 200.0
    assert _ended(rows, 400)["auc"] == 250.0
    assert _ended([], 400)["auc"] is None


def test_a_member_that_stopped_early_keeps_its_last_return() -> None:
    rows = [{"env_steps": n, "return_mean": n / 100, "samples_backward": 5.0} for n in (100, 200)]
    ended = _ended(rows, 400, stopped_early=True)
    assert ended["auc"] == (1.5 * 100 + 2.0 * 200) / 300
    assert (ended["env_steps"], ended["final_return"], ended["samples_backward"]) == (200, 2.0, 10)
    assert ended["curve"]["env_steps"] == [100, 200, 400]
    assert ended["curve"]["return_mean"] == [1.0, 2.0, 2.0]
    assert ended["curve"]["samples_backward"] == [5.0, 10.0, 10.0]
    assert _ended(rows, 400)["auc"] == 1.5


def test_a_members_evaluations_are_in_its_results() -> None:
    rows: list[dict[str, Any]] = [{"env_steps": n, "return_mean": 0.0} for n in (100, 200, 300)]
    assert not {"evaluations", "eval_return"} & set(_ended(rows, 300))
    rows[0]["eval_return_mean"], rows[2]["eval_return_mean"] = 7.12345678, 3.0
    ended = _ended(rows, 300)
    assert (ended["eval_return"], ended["eval_return_best"]) == (3.0, 7.12345678)
    assert ended["evaluations"] == {"env_steps": [100, 300], "return_mean": [7.12346, 3.0]}


def test_files_are_read_and_their_mistakes_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('tasks = ["A-v0"]\nseeds = [4, 9]\nsteps = 1e5\n[[arms]]\nlabel = "ppo"\n')
    spec = load_spec(str(path))
    assert (spec.name, spec.arms[0].seeds, check(spec.arms[0], "A-v0").steps) == (
        "mine",
        (4, 9),
        100_000,
    )
    path.write_text("tasks = [")
    with pytest.raises(BadInput, match="cannot read"):
        load_spec(str(path))
    with pytest.raises(BadInput, match="did you mean 'table1'"):
        load_spec("table")


# The paper's, and others at its budget and with its rules.
PAPERS = (
    "a2c",
    "cheetah",
    "fig",
    "minatar",
    "noise",
    "pong",
    "release",
    "replay",
    "table",
    "threshold",
)


@pytest.mark.parametrize("name", [n for n in built_in() if not n.startswith(PAPERS)])
def test_studies_of_our_own_give_every_arm_the_same_steps(name: str) -> None:
    spec = load_spec(name)
    for task in spec.tasks:
        assert len({check(arm, task).steps for arm in spec.arms}) == 1
    (baseline,) = {arm.arm for arm in spec.arms if arm.label == spec.baseline}
    assert baseline == "ppo"


@pytest.mark.parametrize("name", [n for n in built_in() if n.startswith(PAPERS)])
def test_studies_of_the_paper(name: str) -> None:
    spec = load_spec(name)
    arms = {arm.label: arm for arm in spec.arms}
    assert spec.name == name and (arms[spec.baseline].arm == "ppo" or spec.measure)
    for arm in spec.arms:
        config = check(arm, spec.tasks[0])
        steps = 10**8 if name.startswith("fig4") else 10**6
        others = {"minatar": 3 * 10**6, "selection-pilot-hopper": 3 * 10**5}
        others |= {"fig4a-cpu": 2 * 10**7, "fig4b-cpu": 10**7, "fig4c-cpu": 10**7}
        assert config.steps == others.get(name, steps)
        # Only the filter may differ from the baseline: the same rules of truncation and budget.
        if arm.baseline and not arm.label.startswith("ppo"):
            base = check(arms[arm.baseline], spec.tasks[0])
            assert config.truncation == base.truncation
            assert config.budget == base.budget or "kept steps" in arm.label
    assert {a.arm.removesuffix("+random") for a in spec.arms} <= set(ARMS)
    if name == "fig3":
        paper = {"ppo", "vex-head", "sauna+random", "sauna", "sauna-paper", "sauna-reference"}
        assert {a.arm for a in spec.arms} == paper
        assert {len(a.seeds) for a in spec.arms} == {6} and len(spec.tasks) == 6


@pytest.mark.parametrize("place, backend", [("", "device"), ("-cpu", "auto")])
def test_the_papers_three_settings_of_flagrun(place: str, backend: str) -> None:
    found = {}
    for name in ("fig4a", "fig4b", "fig4c"):
        config = check(load_spec(name + place).arms[0], "sauna/HumanoidFlagrunHarder-v0")
        assert config.backend == backend and config.rollout_steps == 512
        assert config.envs * config.rollout_steps // config.minibatches == 4096
        found[name] = (config.hidden, config.envs)
    wide = (512, 256, 128)
    assert found == {"fig4a": ((64, 64), 32), "fig4b": (wide, 32), "fig4c": (wide, 128)}


def test_units_share_folders_with_equal_settings() -> None:
    units = {u.name: u for u in units_of(load_spec("fig3"), SEEDS)}
    again = {u.name for u in units_of(load_spec("table1"), SEEDS)}
    assert again < set(units)
    assert again == {u.name for u in units_of(load_spec("fig2"), SEEDS)}
    assert all(len(unit.seeds) <= SEEDS for unit in units.values())
    spec = read_spec({**TWO, "seeds": 4})
    assert [seeds_per_unit(spec, cores) for cores in (1, 4, 5, 64)] == [2, 2, 1, 1]
    spec = comparison("A-v0", COMPARED, {})  # of 24 members
    sizes = [seeds_per_unit(spec, cores) for cores in (2, 8, 9, 12, 13, 64)]
    assert sizes == [3, 3, 2, 2, 1, 1]


@pytest.mark.parametrize(
    "settings", [{"seeds": 6}, {"steps": 1e6}, {"steps": 1_000_000, "seeds": [0, 1, 2, 3, 4, 5]}]
)
def test_however_its_settings_are_written_a_comparison_is_the_same(settings: dict) -> None:
    plain, other = comparison("A-v0", COMPARED, {}), comparison("A-v0", COMPARED, settings)
    assert plain.name == other.name
    assert {u.name for u in units_of(plain, SEEDS)} == {u.name for u in units_of(other, SEEDS)}
    changed = comparison("A-v0", COMPARED, {"steps": 999_999})
    assert changed.name != plain.name
    assert not {u.name for u in units_of(changed, SEEDS)} & {u.name for u in units_of(plain, SEEDS)}


def test_its_units_are_those_of_a_study_with_the_same_settings() -> None:
    ours = comparison("Hopper-v5", ("ppo", "sauna"), {"threshold": 0.8})
    fig3 = {u.name for u in units_of(load_spec("fig3"), SEEDS)}
    assert {u.name for u in units_of(ours, SEEDS)} < fig3


@pytest.mark.parametrize("env", ["CartPole-v1", "HalfCheetah-v5", "LunarLander-v3"])
def test_the_command_of_a_cell_trains_what_the_cell_is_of(env: str) -> None:
    """Also where `sauna train ENV` alone would pick another preset, and other steps."""
    spec = comparison(env, ("ppo", "target-kl"), {"steps": 4096} if env == "CartPole-v1" else {})
    for arm in spec.arms:
        _, task, *flags = cell_command(arm, env).removeprefix("sauna ").split()
        names = [name.removeprefix("--").replace("-", "_") for name in flags[::2]]
        typed = {"env": task, **dict(zip(names, flags[1::2], strict=True))}
        again = resolve_run(pick(typed).overrides).config
        assert to_json(again) == to_json(check(arm, env))


def test_each_arm_is_checked_with_the_spaces_that_its_wrappers_show() -> None:
    """`small-cnn` fits the pictures of the second arm, and not the vectors of the first."""
    arms = (
        {"label": "plain", "arm": "ppo"},
        {"label": "pictures", "arm": "ppo", "wrap": "wrappers:Pictured", "network": "small-cnn"},
    )
    study = {"name": "both", "tasks": ["CartPole-v1"], "baseline": "plain", "arms": list(arms)}
    _check_runs(read_spec(study))
    study["arms"][1]["wrap"] = "wrappers:broken"
    with pytest.raises(BadInput, match="wrappers:broken cannot wrap the environment"):
        _check_runs(read_spec(study))


def test_the_default_control_differs_from_its_arm_in_the_control_alone() -> None:
    spec = comparison("A-v0", COMPARED, {"threshold": 0.8, "keep_rate_target": 0.0})
    control, arm = (to_json(check(spec.arms[i], "A-v0")) for i in (2, 3))
    assert {name for name in arm if arm[name] != control[name]} == {"arm", "control"}
    assert (arm["control"], control["control"]) == ("none", "random")


def rows_of(out: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted((out / "units").rglob("metrics.jsonl"))
    }


def folder_of(out: Path) -> Path:
    (found,) = [p for p in out.iterdir() if p.name != "units"]
    return found


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compared")
    done = sauna_here("compare", "small_envs:Scripted", "--out", str(out), *FLAGS)
    assert done.returncode == 0, done.stderr
    (out / "stdout.txt").write_text(done.stdout)
    return out


FLAGS = [*small_flags(seeds=2), "--processes=2"]


def test_a_comparison_trains_every_arm_and_says_what_it_found(compared: Path) -> None:
    messages = (compared / "stdout.txt").read_text()
    place = next(p for p in compared.iterdir() if p.name.startswith("compare_"))
    results = json.loads((place / "results.json").read_text())
    summary = json.loads((place / "summary.json").read_text())
    assert summary == summarize(results)
    assert [c["label"] for c in results["cells"]] == ["ppo", "vex-head", "sauna+random", "sauna"]
    for cell in results["cells"]:
        assert [(m["seed"], m["status"]) for m in cell["members"]] == [
            (seed, "complete") for seed in range(2)
        ]
        for member in cell["members"]:
            assert 128 - 32 < member["env_steps"] <= 128
            assert member["curve"]["env_steps"][-1] == member["env_steps"]
    assert "too few seeds" in messages and "report:" in messages
    assert (place / "report.html").read_text().count("too few seeds") >= 3
    assert (place / "figures" / "learning_curves.png").read_bytes()[:4] == b"\x89PNG"


def test_the_control_begins_as_its_arm_does_and_learns_otherwise(compared: Path) -> None:
    """One seed begins alike: with no update behind them both keep the same number of steps."""
    rows: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for path in (compared / "units").rglob("metrics.jsonl"):
        for row in run_directory.rows(path.parent):
            rows.setdefault((row["arm"], row["seed"]), []).append(row)
    for seed in range(2):
        arm, control = rows["sauna", seed], rows["sauna+random", seed]
        assert arm[0]["keep_rate"] == control[0]["keep_rate"]
        assert arm[-1]["policy_loss"] != control[-1]["policy_loss"]


def test_in_processes_as_a_user_starts_them_the_rows_are_the_same(
    compared: Path, tmp_path: Path
) -> None:
    flags = [*small_flags(seeds=2), "--processes=1", "--arms=ppo"]
    done = sauna("compare", "small_envs:Scripted", "--out", str(tmp_path), *flags)
    assert done.returncode == 0, done.stderr
    expected, got = rows_of(compared), rows_of(tmp_path)
    assert len(got) == 1
    for name, rows in got.items():
        assert rows == expected[name]


def stamps(out: Path) -> dict[Path, int]:
    files = (out / "units").rglob("*/*")
    return {path: path.stat().st_mtime_ns for path in files if path.is_file()}


def test_running_again_repeats_nothing(compared: Path) -> None:
    before = stamps(compared)
    done = sauna_here("compare", "small_envs:Scripted", "--out", str(compared), *FLAGS)
    assert done.returncode == 0
    assert stamps(compared) == before


def test_python_finds_what_the_command_made(compared: Path) -> None:
    before = stamps(compared)
    summary = compare(
        "small_envs:Scripted", seeds=2, out=compared, processes=2, quiet=True, **QUICK
    )
    assert stamps(compared) == before
    place = next(p for p in compared.iterdir() if p.name.startswith("compare_"))
    assert json.loads((place / "summary.json").read_text()) == summary
    with pytest.raises(BadInput, match="env: other processes cannot import it"):
        compare(lambda: None, out=compared)


def test_in_python_quiet_is_quiet_also_from_a_thread(compared: Path, capfd) -> None:
    found: list[Any] = []
    settings = {"seeds": 2, "out": compared, "processes": 2, "quiet": True, **QUICK}
    thread = threading.Thread(
        target=lambda: found.append(compare("small_envs:Scripted", **settings))
    )
    thread.start()
    thread.join()
    assert found[0]["table"] and capfd.readouterr().out == ""
    with pytest.raises(BadInput, match="processes: must be"):
        compare("small_envs:Scripted", out=compared / "none", processes=-1)
    assert not (compared / "none").exists()


def test_the_command_that_repeats_a_comparison() -> None:
    settings = {"seeds": [3], "env_kwargs": {"a": "b c"}, "hidden": [8]}
    command = compare_command("A-v0", ("ppo", "sauna"), settings, "my runs")
    typed = shlex.split(command)
    assert typed[:5] == ["sauna", "compare", "A-v0", "--arms", "ppo,sauna"]
    flags = dict(zip(typed[5::2], typed[6::2], strict=True))
    assert parse("seeds", flags["--seeds"]) == (3,)
    assert parse("hidden", flags["--hidden"]) == (8,)
    assert json.loads(flags["--env-kwargs"]) == {"a": "b c"} and flags["--out"] == "my runs"


@pytest.mark.slow
def test_killed_at_any_moment_it_continues_to_the_same_bytes(compared: Path, tmp_path) -> None:
    """SIGKILL leaves no orphan behind; SIGTERM saves and exits 143."""
    command = [
        sys.executable,
        "-m",
        "sauna",
        "compare",
        "small_envs:Scripted",
        "--out",
        str(tmp_path),
        *FLAGS,
    ]
    for number, pause in ((signal.SIGKILL, 6.0), (signal.SIGTERM, 9.0)):
        started = subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True)
        time.sleep(pause)
        started.send_signal(number)
        assert started.wait(60) in (-9, 143, 0)
        wait_for_units(tmp_path)
    done = sauna("compare", "small_envs:Scripted", "--out", str(tmp_path), *FLAGS)
    assert done.returncode == 0, done.stderr
    expected = rows_of(compared)
    got = rows_of(tmp_path)
    assert expected.keys() == got.keys()
    for name, rows in expected.items():
        assert got[name] == rows, name


def wait_for_units(out: Path) -> None:
    """Until no process holds a run any more."""
    deadline = time.monotonic() + 30
    for path in (out / "units").rglob(".lock"):
        while True:
            try:
                run_directory.lock(path.parent).close()
                break
            except BadInput:
                assert time.monotonic() < deadline, f"{path} is still held"
                time.sleep(0.1)


@pytest.mark.slow
def test_a_failed_seed_is_shown_and_the_others_go_on(tmp_path: Path) -> None:
    """Seed 1 of every arm fails twice; its unit is split."""
    arms: list[dict[str, Any]] = [{"label": "sauna"}, {"label": "sauna+random"}]
    text = {"tasks": ["small_envs:Unlucky"], "seeds": 3, "arms": arms, **QUICK}
    lines = [f"{k} = {json.dumps(v)}" for k, v in text.items() if k != "arms"]
    lines += [f"[[arms]]\nlabel = {json.dumps(arm['label'])}" for arm in arms]
    (tmp_path / "unlucky.toml").write_text("\n".join(lines))
    done = sauna("study", "unlucky.toml", "--trust", "--out=out", "--processes=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "FAILED: small_envs:Unlucky, sauna, seed 1" in done.stdout
    results = json.loads((tmp_path / "out" / "unlucky" / "results.json").read_text())
    sauna_cell, control_cell = results["cells"]
    assert [m["status"] for m in sauna_cell["members"]] == ["complete", "failed", "complete"]
    assert [m["status"] for m in control_cell["members"]] == ["complete", "failed", "complete"]
    assert "out of luck" in sauna_cell["members"][1]["error"]
    assert "out of luck" in control_cell["members"][1]["error"]
    table = json.loads((tmp_path / "out" / "unlucky" / "summary.json").read_text())["table"]
    assert [(row["seeds"], row["failed"]) for row in table] == [(2, 1), (2, 1)]
    page = (tmp_path / "out" / "unlucky" / "report.html").read_text()
    assert "out of luck" in page
    again = sauna("study", "unlucky.toml", "--trust", "--out=out", "--processes=2", cwd=tmp_path)
    assert again.returncode == 0 and "FAILED" not in again.stdout


def test_a_complete_run_counts_even_if_the_unit_was_split(tmp_path: Path) -> None:
    unit = units_of(read_spec(TWO), SEEDS)[0]
    mark_split(unit, tmp_path)
    assert len(parts(unit, tmp_path)) == 3
    unit.run(tmp_path).mkdir()
    run_directory.write_json(unit.run(tmp_path) / "summary.json", {"complete": True})
    assert parts(unit, tmp_path) == [unit]


def test_a_second_study_in_the_same_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "units").mkdir()
    with run_directory.lock(tmp_path / "units"):
        done = sauna_here("compare", "small_envs:Scripted", "--out", str(tmp_path), *FLAGS)
    assert done.returncode == 2 and "is in use by process" in done.stderr
    assert {path.name for path in tmp_path.rglob("*")} == {"units", ".lock"}


def test_where_a_file_is_in_the_way_nothing_is_made(tmp_path: Path) -> None:
    spec = comparison("small_envs:Scripted", COMPARED, {"seeds": 4, **QUICK})
    (tmp_path / spec.name).write_text("")
    with pytest.raises(BadInput, match="is no folder"):
        compare("small_envs:Scripted", out=tmp_path, seeds=4, quiet=True, **QUICK)
    assert [path.name for path in tmp_path.iterdir()] == [spec.name]


def test_lines_that_are_no_messages_are_passed_over(tmp_path: Path, monkeypatch) -> None:
    """Something prints before the unit has taken over its output."""
    (tmp_path / "sitecustomize.py").write_text("print('hello')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    messages: list[Any] = []
    ended = threading.Event()

    def send(message: Any) -> None:
        messages.append(message)
        if message is None:
            ended.set()

    process = UnitProcess(
        {"out": str(tmp_path / "run"), "env": "NoSuch-v0"}, tmp_path / "log", send
    )
    assert ended.wait(60)
    assert "exit code 1" in process.end()
    assert "NoSuch-v0" in messages[-2]["error"]


def test_what_a_run_would_refuse_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    done = sauna_here("compare", "CartPole-v1", "--log-std-init", "0.5", cwd=tmp_path)
    assert done.returncode == 2 and "it needs continuous actions" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_study_without_any_result_exits_1(tmp_path: Path) -> None:
    flags = [*small_flags(seeds="1,"), "--arms=ppo", "--processes=1"]
    done = sauna("compare", "small_envs:Unlucky", "--out", str(tmp_path), *flags)
    assert done.returncode == 1 and "no training ended well" in done.stderr


def test_another_study_of_the_same_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    run_directory.write_json(
        tmp_path / "one" / "study.json", {"study": {"x": 1}, "seeds_per_unit": 3}
    )
    (tmp_path / "one.toml").write_text('tasks = ["CartPole-v1"]\n[[arms]]\nlabel = "ppo"\n')
    done = sauna_here("study", "one.toml", "--out", ".", cwd=tmp_path)
    assert done.returncode == 2 and "another study of this name" in done.stderr
