"""Population-based training: who copies whom, what is copied, and exact continuation."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import SMALL, Silent
from sauna.experiments.tune import population
from sauna.experiments.tune.command import tune
from sauna.experiments.tune.population import copied, exchanges
from sauna.experiments.tune.space import read_space
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput, Interrupted

GIVEN = {"env": "small_envs:MatchingAction", **{k: v for k, v in SMALL.items() if k != "seeds"}}
GIVEN |= {"preset": "discrete", "steps": 192}  # 6 iterations of 32 steps
SPACE = "learning_rate = {low = 1e-4, high = 1e-1, log = true}\ngamma = [0.5, 0.9, 0.99]\n"


pytestmark = pytest.mark.usefixtures("no_page")


def trained(folder: Path, **changes: Any) -> tuple[dict[str, Any], Path]:
    file = folder / "space.toml"
    file.write_text(changes.pop("space", SPACE))
    options = {"trials": 3, "exchange_every": 64, "space": str(file), **changes}
    return tune(
        {**GIVEN, **options.pop("given", {})},
        folder,
        display=Silent,
        say=lambda text: None,
        jobs=1,
        finalists=1,
        fresh_seeds=0,
        population_based=True,
        **options,
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Three members, which exchange at iterations 2 and 4."""
    return trained(tmp_path_factory.mktemp("population"))


def test_the_worst_fifth_copies_the_best_fifth() -> None:
    space = read_space({"learning_rate": {"low": 1e-4, "high": 1e-1, "log": True}})
    settings = [{"learning_rate": 10.0 ** -(i / 4 + 1)} for i in range(10)]
    scores = [5.0, 1.0, 9.0, math.nan, 2.0, 8.0, 7.0, 6.0, 4.0, 3.0]
    made = exchanges(scores, settings, space, np.random.default_rng(0), 4, 128)
    assert [one.member for one in made] == [1, 4]  # of nine that have a score
    assert {one.source for one in made} <= {2, 5}
    for one in made:
        assert one.copied == settings[one.source] and one.settings != one.copied
        assert (one.score, one.source_score) == (scores[one.member], scores[one.source])
    assert made == exchanges(scores, settings, space, np.random.default_rng(0), 4, 128)


@pytest.mark.parametrize("scores", [[1.0, 1.0, 1.0], [math.nan, math.nan, 1.0], [math.nan] * 3])
def test_nobody_copies_one_that_is_not_better(scores: list[float]) -> None:
    space = read_space({"gamma": [0.9, 0.99]})
    settings = [{"gamma": 0.9}] * 3
    assert exchanges(scores, settings, space, np.random.default_rng(0), 1, 32) == []


def test_what_is_learned_is_copied_and_the_rest_stays_its_own() -> None:
    names = {
        "params/policy/kernel": True,
        "adam/mean": True,
        "optimizer/0": True,
        "sampler/0": True,
        "learning_rate": True,
        "observation_moments/mean": True,
        "reward_moments/count": True,
        "collect/observation_moments/mean": True,
        "collect/reward_moments/mean": True,
        "collect/observation": False,
        "counters/env_steps": False,
        "envs/0/actions": False,
        "evaluation/best": False,
        "best/params/x": False,
    }
    arrays = {f"a/0/{name}": np.ones(1) for name in names} | {"b/0/params/x": np.zeros(1)}
    assert set(copied(arrays, "a/0", "b/0")) == {
        f"b/0/{n}" for n, learned in names.items() if learned
    }


def test_a_population_exchanges_and_logs_it(whole) -> None:
    found, folder = whole
    assert found["exchanges"] and {one["iteration"] for one in found["exchanges"]} <= {2, 4}
    rows = run_directory.rows(folder / "population" / "run")
    assert len(rows) == 3 * 6 and all(t["env_steps"] == 192 for t in found["trials"])
    of = {(row["iteration"], row["arm"]): row for row in rows}
    for one in found["exchanges"]:
        rate = of[one["iteration"], f"member-{one['member']}"]["learning_rate"]
        left = 1 - one["env_steps"] / 192
        assert rate == pytest.approx(one["settings"]["learning_rate"] * left, rel=1e-5)
    best = max(found["trials"], key=lambda trial: trial["return"])
    assert found["best"]["number"] == best["number"]


def test_the_changed_checkpoint_holds_what_the_source_had(tmp_path: Path, monkeypatch) -> None:
    saved: list[tuple[dict[str, Any], dict[str, Any]]] = []
    real = population.Population._save

    def noted(self: Any, newest: Any, arrays: Any, *more: Any) -> None:
        saved.append((newest.arrays, dict(arrays)))
        real(self, newest, arrays, *more)

    monkeypatch.setattr(population.Population, "_save", noted)
    found, _ = trained(tmp_path)
    for before, after in saved:
        changed = {
            name.split("/")[0] for name in after if not np.array_equal(before[name], after[name])
        }
        assert changed <= {f"member-{one['member']}" for one in found["exchanges"]}
    one = found["exchanges"][0]
    before, after = saved[0]
    source, member = (f"member-{one[who]}/0/" for who in ("source", "member"))
    for name, array in checkpoint.under(source, before).items():
        own, now = before[member + name], after[member + name]
        assert np.array_equal(now, array if name.startswith(("params", "adam")) else now)
        assert np.array_equal(now, own) or not name.startswith(("counters", "envs", "collect"))


@pytest.mark.parametrize(
    "when",
    [
        "renamed",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("between", "logged", "second")),
    ],
)
def test_a_killed_population_ends_as_one_that_nobody_killed(
    when: str, whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, name, number = {
        "between": (population, "exchanges", 1),  # after training, before the exchange
        "logged": (population.Population, "_save", 1),
        "renamed": (population.checkpoint, "save_checkpoint", 1),
        "second": (population, "train", 2),
    }[when]
    real, calls = getattr(target, name), []

    def counted(*given: Any, **named: Any) -> Any:
        calls.append(1)
        if len(calls) == number:
            raise Interrupted(2, "stopped")
        return real(*given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(target, name, counted)
        if when == "renamed":  # not in the run itself, which saves by the same function
            patched.setattr(population, "train", _unpatched(real, target, name, patched))
        with pytest.raises(Interrupted):
            trained(tmp_path)
    found, folder = trained(tmp_path)
    assert found["exchanges"] == whole[0]["exchanges"] and found["trials"] == whole[0]["trials"]
    metrics = Path("population") / "run" / "metrics.jsonl"
    assert (folder / metrics).read_bytes() == (whole[1] / metrics).read_bytes()


def _unpatched(real: Any, target: Any, name: str, patched: pytest.MonkeyPatch) -> Any:
    """Trains with `target.name` as it really is."""
    train, changed = population.train, getattr(target, name)

    def training(*given: Any) -> None:
        patched.setattr(target, name, real)
        train(*given)
        patched.setattr(target, name, changed)

    return training


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"space": "epochs = [1, 2]\n"}, "epochs shapes the program, which a population shares"),
        ({"exchange_every": 192}, "would come after the last iteration"),
        ({"given": {"seeds": 2}}, "a population has one, which all its members share"),
        ({"given": {"arm": "sauna", "dropped": "replace"}}, "give mask"),
        ({"given": {"eval_every": 1, "stop_at": 0.0}}, "stop_at: a population trains to its end"),
        ({"given": {"learning_rate_schedule": "kl"}}, "not read after the start of a population"),
    ],
)
def test_what_a_population_cannot_do_is_refused(changes, message, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=message):
        trained(tmp_path, **changes)
    assert [path.name for path in tmp_path.iterdir()] == ["space.toml"]
