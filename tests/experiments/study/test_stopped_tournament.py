"""A tournament that is stopped in the middle of a look and goes on: the table of one left alone."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from clusters import needs_ray, on_ray, timeless, until
from command_line import small_flags
from sauna.system import run_directory

pytestmark = pytest.mark.slow

STEPS = 19_200  # 300 iterations of a seed
SMALL = {"rollout_steps": 64, "steps": STEPS, "seeds": 6, "checkpoint_every": 20}
COMPARE = ["compare", "CartPole-v1", "--rules=spo,gigaflow", *small_flags(**SMALL)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What the tournament comes to if nobody stops it: its output and its folder."""
    path = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patched, on_ray(path, patched) as place:
        said = place.finish(place.start(*COMPARE, "--processes=2", folder="whole"))
    return said, path / "whole"


@pytest.mark.parametrize("on", ["local", pytest.param("ray", marks=needs_ray)])
def test_stopped_in_the_second_look_it_ends_with_the_same_table(
    on: str, whole: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "look 2 of 2" in whole[0], "nothing was open after the first look"
    with on_ray(tmp_path, monkeypatch) as place:
        monkeypatch.delenv("RAY_AUTH_TOKEN_PATH")
        command = [*COMPARE, "--processes=2", f"--on={on}"]
        started = place.start(*command, folder="cut")
        runs = place.path / "cut" / "runs"
        saved = "units/*_3-5_*/run/checkpoints/00000020"
        until(lambda: place.runs(started) and list(runs.glob(saved)), 600)
        started.send_signal(signal.SIGINT)
        assert "stopped by SIGINT; continue with: sauna compare" in place.finish(started, 130)
        second = [path.parent for path in runs.glob("units/*_3-5_*/run/config.json")]
        assert any(run_directory.rows(run) for run in second)
        assert not all(run_directory.is_complete(run) for run in second)
        said = place.finish(place.start(*command, folder="cut"))
        until(lambda: not place.processes(), 60)
    assert "look 1 of 2" not in said and "look 2 of 2" in said
    assert table(said) == table(whole[0])
    for name in ("results.json", "summary.json"):
        one, other = (
            next(folder.glob(f"runs/compare_*/{name}")) for folder in (tmp_path / "cut", whole[1])
        )
        assert timeless(one) == timeless(other), name
    ranking = json.loads(one.read_text())["ranking"]
    assert {row["label"] for row in ranking} == {"spo", "gigaflow"}


def table(said: str) -> str:
    """The tables and verdicts at the end of an output, without the ratios of CPU seconds."""
    assert said.count("\ntask  ") == 2  # the table of the arms and the ranking
    return said[said.index("\ntask  ") :].partition("At equal compute.")[0]
