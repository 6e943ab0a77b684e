"""Trials: grouped, trained in lockstep, asked for the same after an interruption, told honestly."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from wsgiref.util import setup_testing_defaults

import numpy as np
import pytest

from command_line import sauna_here
from helpers import Silent
from sauna.api import train as train_run
from sauna.experiments.tune import command, search, storage
from sauna.experiments.tune.batch import prepared_batch
from sauna.experiments.tune.command import tune
from sauna.experiments.tune.fresh import fresh_spec, verdict
from sauna.experiments.tune.plan import make_plan
from sauna.system import run_directory
from sauna.system.errors import BadInput, Interrupted, SaunaError
from sauna.training.prepare import prepare
from tunings import GIVEN, SPACE, answers, tuned

optuna = pytest.importorskip("optuna")

HOW: dict[str, Any] = {
    "trials": 2,
    "lockstep": 2,
    "search": "tpe",
    "pruner": "none",
    "finalists": 4,
    "fresh": 2,
    "population": False,
    "exchange_every": 0,
}


pytestmark = pytest.mark.usefixtures("no_page")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Four trials in two batches, which nobody interrupted."""
    return tuned(tmp_path_factory.mktemp("whole"), trials=4, lockstep=2)


def test_a_trial_is_a_member_and_trains_as_it_would_alone(whole, tmp_path: Path) -> None:
    found, folder = whole
    assert [trial["state"] for trial in found["trials"]] == ["complete"] * 4
    names = [run_directory.read_config(p)["config"]["arm"] for p in folder.glob("batches/*/run")]
    assert sorted(names) == [["trial-0", "trial-1"], ["trial-2", "trial-3"]]
    best = found["best"]
    assert best["return"] == max(trial["return"] for trial in found["trials"])
    settings = json.loads((folder / "tuned.json").read_text())
    assert settings.pop("seal") and settings["learning_rate"] == best["searched"]["learning_rate"]
    alone = train_run(quiet=True, seeds=1, out=str(tmp_path / "alone"), **settings)
    (member,) = alone.summary.values()
    assert member["return_mean"] == best["return"]
    assert sum(t["env_steps"] for t in found["trials"]) == found["env_steps"]["trials"] == 4 * 128


def test_the_file_that_was_found_trains_from_the_command_line(whole, tmp_path: Path) -> None:
    found, folder = whole
    out = tmp_path / "run"
    file = str(folder / "tuned.json")
    done = sauna_here(
        "train", "--config", file, "--seeds", "1", "--processes", "1", "--out", str(out)
    )
    assert done.returncode == 0, done.stderr
    (member,) = json.loads((out / "summary.json").read_text())["members"].values()
    assert member["return_mean"] == found["best"]["return"]


@pytest.mark.slow
def test_optunas_dashboard_shows_the_trials(whole) -> None:
    dashboard = pytest.importorskip("optuna_dashboard", reason="needs `sauna-rl[tune]`")
    from optuna.storages.journal import JournalFileBackend, JournalStorage

    found, folder = whole
    app = dashboard.wsgi(JournalStorage(JournalFileBackend(str(folder / storage.FILE))))
    (study,) = asked(app, "/api/studies")["study_summaries"]
    assert study["study_name"] == storage.NAME
    shown = asked(app, f"/api/studies/{study['study_id']}")["trials"]
    assert [(t["number"], t["state"].lower()) for t in shown] == [(n, "complete") for n in range(4)]
    values = [float(trial["values"][0]) for trial in shown]
    assert values == [trial["return"] for trial in found["trials"]]


def asked(app: Callable[..., Any], path: str) -> Any:
    """What a WSGI application says at an address of its API."""
    request: dict[str, Any] = {"PATH_INFO": path, "QUERY_STRING": "after=0"}
    setup_testing_defaults(request)
    said: list[str] = []
    body = b"".join(app(request, lambda status, headers, exc_info=None: said.append(status)))
    assert said[0].startswith("200"), body
    return json.loads(body)


def test_the_first_trial_has_the_settings_that_all_start_from(whole) -> None:
    first, *others = whole[0]["trials"]
    assert first["searched"]["learning_rate"] == 3e-4 and first["searched"]["gamma"] == 0.99
    assert all(trial["searched"]["learning_rate"] != 3e-4 for trial in others)


def test_more_trials_go_on_behind_those_that_are_there(whole, tmp_path: Path) -> None:
    fewer, folder = tuned(tmp_path, trials=2, lockstep=2)
    stamps = {path: path.stat().st_mtime_ns for path in folder.glob("batches/0000/run/*.jsonl")}
    more, again = tuned(tmp_path, trials=4, lockstep=2)
    assert again == folder and answers(more)[:2] == answers(fewer)
    assert answers(more) == answers(whole[0])  # as if they had been asked for at once
    assert stamps == {path: path.stat().st_mtime_ns for path in stamps}


@pytest.mark.parametrize(
    "when",
    ["asking", "telling", pytest.param("training", marks=pytest.mark.slow)],
)
def test_an_interrupted_search_ends_as_one_that_nobody_interrupted(
    when: str, whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        _interrupt(when, patched)
        with pytest.raises(Interrupted, match="continue with: sauna tune"):
            tuned(tmp_path, trials=4, lockstep=2)
    found, folder = tuned(tmp_path, trials=4, lockstep=2)
    assert answers(found) == answers(whole[0])
    for path in whole[1].glob("batches/*/run/metrics.jsonl"):
        assert (folder / path.relative_to(whole[1])).read_bytes() == path.read_bytes()


def _interrupt(when: str, patched: pytest.MonkeyPatch) -> None:
    """Lets a signal come while the second batch is asked for, is trained, or has been."""
    target, name, number = {
        "asking": (optuna.Trial, "_suggest", 4 * 2 + 4 + 2),
        "training": (search, "train", 2),
        "telling": (optuna.Study, "tell", 4),
    }[when]
    real: Callable[..., Any] = getattr(target, name)
    calls: list[int] = []

    def counted(*given: Any, **named: Any) -> Any:
        calls.append(1)
        if len(calls) == number:
            raise Interrupted(2, "stopped")
        return real(*given, **named)

    patched.setattr(target, name, counted)


def test_a_trial_that_fails_is_shown_and_costs_the_others_nothing(
    whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = search.train

    def fails(prepared: Any, *more: Any) -> None:
        if "trial-1" in prepared.config.arm:
            raise SaunaError("trial-1/0: the update of iteration 3 is not finite")
        real(prepared, *more)

    monkeypatch.setattr(search, "train", fails)
    found, folder = tuned(tmp_path, trials=2, lockstep=2)
    good, bad = found["trials"]
    assert (good["state"], good["return"]) == answers(whole[0])[0][:2]
    assert bad["state"] == "fail" and "not finite" in bad["error"]
    text = (folder / "trials.txt").read_text()
    assert "failed: trial-1/0: the update of iteration 3 is not finite" in text


def test_settings_that_are_refused_are_failed_trials(tmp_path: Path) -> None:
    found, folder = tuned(tmp_path, trials=3, lockstep=2, space="minibatches = [5]\n")
    assert [trial["state"] for trial in found["trials"]] == ["fail"] * 3
    assert all("5 does not divide" in trial["error"] for trial in found["trials"])
    assert found["best"] is None and not (folder / "tuned.json").exists()
    assert found["env_steps"]["trials"] == 0


def test_a_trial_is_refused_what_rows_that_act_together_cannot_do(tmp_path: Path) -> None:
    start = prepare({**GIVEN, "envs": 2})
    agents = start._replace(found=start.found._replace(group=2))
    with pytest.raises(BadInput, match=r"^envs: 3 is no multiple of the 2 agents"):
        prepared_batch({"trial-0": {**GIVEN, "envs": 3}}, [0], agents, tmp_path)


def rows(returns: list[float], arm: str = "trial-0", seed: int = 0) -> list[dict[str, Any]]:
    """A member's rows, one at the end of each tenth of 1000 env steps."""
    return [
        {"arm": arm, "seed": seed, "env_steps": 100 * (i + 1), "return_mean": value}
        for i, value in enumerate(returns)
    ]


class Prepared:
    class config:  # noqa: N801
        steps, eval_every = 1000, 0


class Plan:
    seeds = (0, 1)


def test_a_trial_is_pruned_by_optuna_and_stops_at_the_same_step_again() -> None:
    study = optuna.create_study(direction="maximize", pruner=storage._pruner("median"))
    for _ in range(storage.PRUNED_AMONG):
        study.add_trial(
            optuna.trial.create_trial(
                value=1.0, intermediate_values={n: 1.0 for n in range(1, storage.REPORTS + 1)}
            )
        )
    trial = study.ask()
    watch = search.Watch({0: trial}, Plan, Prepared)  # type: ignore[arg-type]
    good, bad = rows([2.0] * 10), rows([-3.0] * 10, seed=1)
    stops = [(watch(one), watch(other)) for one, other in zip(good, bad, strict=True)]
    # The mean is -0.5, below the median 1; before a third of the budget nothing is pruned.
    assert trial.user_attrs[search.PRUNED] == 300
    assert stops[:3] == [(False, False)] * 2 + [(False, True)]
    assert all(pair == (True, True) for pair in stops[3:])
    values = study.trials[-1].intermediate_values
    assert values == {n: -0.5 for n in range(1, 7)}
    again = search.Watch({0: trial}, Plan, Prepared)  # type: ignore[arg-type]
    assert [again(one) for one in good[:4]] == [False, False, True, True]


def test_the_journal_is_mended_after_a_write_that_was_cut(whole, tmp_path: Path) -> None:
    text = (whole[1] / storage.FILE).read_bytes()
    path = tmp_path / storage.FILE
    path.write_bytes(text + b'{"op_code": 4, "wor')
    storage.cut(tmp_path)
    assert path.read_bytes() == text
    first = text.index(b"\n") + 1
    storage.cut(tmp_path, first + 3)
    assert path.read_bytes() == text[:first]


@pytest.mark.slow
def test_what_was_found_is_tried_on_fresh_seeds(tmp_path: Path, capsys) -> None:
    said: list[str] = []
    file = tmp_path / "space.toml"
    file.write_text(SPACE)
    options = {"space": str(file), "trials": 3, "lockstep": 3, "finalists": 2, "fresh_seeds": 2}
    given = {**GIVEN, "gamma": 0.5}
    found, folder = tune(given, tmp_path, display=Silent, say=said.append, jobs=1, **options)
    assert any("preset discrete cannot be trained with 128 env steps" in text for text in said)
    printed = capsys.readouterr().out
    assert printed.count("too few seeds") == 1 and "give at least --fresh-seeds 4" in printed
    table = {row["label"]: row for row in found["fresh"]["table"]}
    assert list(table) == ["start", "tuned"] and found["fresh_seeds"] == [1000, 1001]
    assert found["finalist_seeds"] == [1, 2, 3]
    assert found["env_steps"]["fresh"] == 2 * 2 * 128 + 2 * 3 * 128
    means = {row["label"]: row["final_mean"] for row in found["finalists"]["table"]}
    best = sorted(found["trials"], key=lambda trial: -trial["return"])[:2]
    assert [f"trial {trial['number']}" for trial in best] == list(means)
    assert f"trial {found['best']['number']}" == max(means, key=lambda label: means[label])
    assert (folder / found["fresh"]["report"]).is_file()
    better = table["tuned"]["improvement"][0] >= 0.5
    assert found["verdict"]["believed"] == better and "of start" in found["verdict"]["text"]


@pytest.mark.parametrize("chance, believed", [(0.5, True), (0.48, False), (None, None)])
def test_what_was_found_is_believed_by_its_probability_of_improvement(chance, believed) -> None:
    """Not by the mean, which one seed may decide."""
    preset = {"label": "preset mujoco", "final_mean": 1.0, "improvement": None}
    tuned = {"label": "tuned", "final_mean": 0.5, "improvement": [chance, chance, chance]}
    assert verdict({"table": [preset, tuned]})["believed"] is believed


def test_the_fresh_seeds_compare_with_the_preset_that_the_task_has_by_itself() -> None:
    given = {**GIVEN, "steps": 4096, "seeds": "3,2000"}
    plan, _, _ = make_plan(given, {"gamma": [0.5, 0.9]}, **HOW)
    spec = fresh_spec(plan, {"gamma": 0.5})
    assert [arm.label for arm in spec.arms] == ["preset discrete", "start", "tuned"]
    assert spec.arms[0].settings == {"preset": "discrete", "steps": 4096}
    assert all(arm.seeds == (2004, 2005) for arm in spec.arms)
    assert plan.finalist_seeds == [2001, 2002, 2003]
    assert spec.arms[2].settings == {**spec.arms[1].settings, "gamma": 0.5}
    same = fresh_spec(plan, {"gamma": 0.99})  # as the start has it
    assert [arm.label for arm in same.arms] == ["preset discrete", "start"]


@pytest.mark.parametrize(
    "flags, message",
    [
        ([], "no environment given"),
        (["A-v0", "--trials", "0"], "trials: must be at least 1"),
        (["A-v0", "--search", "grid"], "search: unknown value 'grid'"),
        (["A-v0", "--pruner", "mean"], "pruner: unknown value 'mean'"),
        (["A-v0", "--exchange-every", "5"], "only read with population_based"),
        (["A-v0", "--population-based", "--pruner", "none"], "pruner: not read with population"),
        (["A-v0", "--population-based", "--trials", "1"], "needs at least 2 members"),
        (["A-v0", "--space", "none.toml"], "no file none.toml"),
        (["A-v0", "--address", "auto"], "address: read with --on ray only"),
        (["CartPole-v1", "--arm", "ppo,sauna"], "arm: a tuning has one arm"),
        (["CartPole-v1", "--init-from", "runs/x"], "init_from: not read by a tuning"),
        (["CartPole-v1", "--stop", "none:such"], "stop: "),
        (["CartPole-v1", "--tirals", "3"], "unknown argument"),
    ],
)
def test_bad_input_is_one_line_and_creates_nothing(flags, message, tmp_path: Path) -> None:
    done = sauna_here("tune", *flags, cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr and len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_space_that_the_arm_fixes_or_nothing_reads_is_refused(tmp_path: Path) -> None:
    for space, message in (
        ("vex_coef = [0.1, 0.5]", "vex_coef is fixed by arm ppo"),
        ("desired_kl = [0.01, 0.02]", "not read by the trials; it needs learning_rate_schedule kl"),
        ("minibatches = [1]\nbatch_size = [8]", "either batch_size or minibatches"),
    ):
        with pytest.raises(BadInput, match=message):
            tuned(tmp_path, trials=1, space=space)
    assert [path.name for path in tmp_path.iterdir()] == ["space.toml"]


def test_the_command_continues_the_tuning(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    given = {"env": "my module:Env", "steps": 100, "clip_value": False}
    options = {**command.OPTIONS, "trials": 7, "population_based": True}
    text = command.tune_command(given, tmp_path / "runs", options)
    assert text == (
        "sauna tune 'my module:Env' --steps 100 --no-clip-value --trials 7 --population-based"
    )


def test_shares_of_importance_sum_to_one(whole) -> None:
    study = optuna.create_study(direction="maximize")
    for i in range(storage.STARTUP):
        trial = study.ask()
        x, y = trial.suggest_float("gamma", 0, 1), trial.suggest_float("epochs", 0, 1)
        study.tell(trial, x + 0 * y + i * 0)
    assert np.isclose(sum(storage.importance(study).values()), 1)
    assert storage.importance(optuna.create_study()) == {}
