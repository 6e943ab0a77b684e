"""Runs that exist, read from each kind of file, drawn and compared."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image

from command_line import sauna
from sauna.experiments.report import curve
from sauna.experiments.report.curve import draw_curve, plot
from sauna.experiments.report.sources import Curve, Source, read_scalars, read_sources
from sauna.experiments.study.existing import compare_existing, results_of
from sauna.system.errors import BadInput
from sauna.system.metrics_csv import NAME, MetricsCsv


def write_csv(path: Path, top: float, end: int, seeds: int = 4, head: str = "seed,step,return"):
    """Returns that climb by `top` in 20,000 env steps, a little apart for each seed."""
    rows = [head]
    for seed in range(seeds):
        rows += [f"{seed},{x},{top * x / 20_000 + 0.1 * seed}" for x in range(0, end + 1, 1000)]
    path.write_text("\n".join(rows) + "\n")
    return path


def write_run(path: Path, arms: tuple[str, ...] = ("ppo", "sauna")) -> Path:
    """A run directory of two arms and two seeds, as far as its curves are read."""
    path.mkdir()
    (path / "config.json").write_text(json.dumps({"config": {"env": "A-v0", "preset": "mujoco"}}))
    rows = [
        {
            "arm": arm,
            "seed": seed,
            "member": f"{arm}/{seed}",
            "iteration": x // 100 - 1,
            "env_steps": x,
            "kept_steps": x // 2,
            "return_mean": float(x * (1 + place)),
        }
        for x in (100, 200, 300)
        for place, arm in enumerate(arms)
        for seed in (0, 1)
    ]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_a_csv_file_with_excels_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "marked.csv"
    path.write_bytes(b"\xef\xbb\xbfstep,return\n10,1.5\n20,2.5\n")
    [source] = read_sources([path])
    np.testing.assert_array_equal(source.seeds[0].x, [10, 20])


def test_a_csv_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(
        "# made by hand\nstep,seed,return,more\n20,3,2.5,x\n10,3,1.5,\n20,3,4.5,\n30,3,,\n"
    )
    [source] = read_sources([path])
    assert (source.label, source.task, list(source.seeds)) == ("mine", "", [3])
    np.testing.assert_array_equal(source.seeds[3].x, [10, 20])  # in order, one value for each
    np.testing.assert_array_equal(source.seeds[3].y, [1.5, 3.5])
    others = write_csv(tmp_path / "other.csv", 1.0, 2000, head="seed,global_step,episodic_return")
    assert read_sources([others])[0].seeds[0].x.tolist() == [0, 1000, 2000]


def test_a_curve_that_cannot_be_drawn_costs_no_training(tmp_path: Path, capsys) -> None:
    run = write_run(tmp_path / "run")
    (tmp_path / "elsewhere").mkdir()
    (run / "figures").symlink_to(tmp_path / "elsewhere")
    assert draw_curve(run) is None
    said = capsys.readouterr().err
    assert said.startswith("warning: no learning curve was drawn: Untrusted") and "link" in said
    assert said.count("\n") == 1 and not list((tmp_path / "elsewhere").iterdir())
    (run / "figures").unlink()
    assert draw_curve(run) == run / "figures" / "learning_curve.png"


def test_the_table_of_a_run_gives_the_curves_of_the_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    MetricsCsv(run, print)
    for of_run, of_table in zip(read_sources([run]), read_sources([run / NAME]), strict=True):
        assert of_run.label == of_table.label and list(of_run.seeds) == list(of_table.seeds)
        for seed in of_run.seeds:
            np.testing.assert_array_equal(of_run.seeds[seed][:2], of_table.seeds[seed][:2])


@pytest.mark.parametrize(
    "text, message",
    [
        ("seed,step\n0,1\n", "needs a column 'return'"),
        ("seed,return\n0,1\n", "needs a column 'step'"),
        ("seed,step,return\n0,1,x\n", "row 1 has something that is no number"),
        ("seed,step,return\n0,1,2\n", "no seed has two points"),
        ("", "needs a column 'step'"),
    ],
)
def test_mistakes_of_csv_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(text)
    with pytest.raises(BadInput, match=message):
        read_sources([path])


def test_tensorboard_files_of_other_trainers_are_read(tmp_path: Path) -> None:
    """What tensorboardX has written; one folder for each seed."""
    tensorboardx = pytest.importorskip("tensorboardX")
    for seed in (0, 1):
        writer = tensorboardx.SummaryWriter(str(tmp_path / "sb3" / f"PPO_{seed}"))
        for step in (0, 64, 128):
            writer.add_scalar("rollout/ep_rew_mean", 0.5 * step + seed, step)
            writer.add_scalar("train/loss", 9.0, step)
        writer.close()
    [source] = read_sources([tmp_path / "sb3"])
    assert source.label == "sb3" and list(source.seeds) == [0, 1]
    assert source.seeds[1].x.tolist() == [0, 64, 128]
    assert source.seeds[1].y.tolist() == [1.0, 33.0, 65.0]
    assert read_sources([tmp_path / "sb3"], "train/loss")[0].seeds[0].y.tolist() == [9.0] * 3
    with pytest.raises(BadInput, match=r"no tag 'x' \(tags: rollout/ep_rew_mean, train/loss\)"):
        read_sources([tmp_path / "sb3"], "x")
    [file] = (tmp_path / "sb3" / "PPO_0").iterdir()
    whole = list(read_scalars(file))
    file.write_bytes(file.read_bytes()[:-3])  # still being written
    assert list(read_scalars(file)) == whole[:-1]
    file.write_bytes(b"\xff" * 64)
    with pytest.raises(BadInput, match="no TensorBoard file, or is damaged"):
        list(read_scalars(file))


def test_run_directories_are_read_arm_by_arm(tmp_path: Path) -> None:
    one, two = (write_run(tmp_path / name) for name in ("one", "two"))
    found = read_sources([one])
    assert [(s.label, s.arm) for s in found] == [("ppo", "ppo"), ("sauna", "sauna")]
    assert {s.task for s in found} == {"A-v0"}
    assert found[1].seeds[0].y.tolist() == [200.0, 400.0, 600.0]
    assert found[0].seeds[0].keep_rate == 0.5
    labels = [source.label for source in read_sources([one, two])]
    assert labels == ["ppo (one)", "sauna (one)", "ppo (two)", "sauna (two)"]
    with pytest.raises(BadInput, match="given twice"):
        read_sources([one, tmp_path / "." / "one"])
    (one / "metrics.jsonl").write_text("")
    with pytest.raises(BadInput, match="no episode has finished"):
        read_sources([one])


def test_evaluations_are_drawn_beside_the_training_return(tmp_path: Path, monkeypatch) -> None:
    drawn: list[tuple[str, list[float]]] = []

    def note(axes, label, members, look) -> None:
        axes.plot([0], [0], label=label)
        drawn.append((label, [y for _, line in members.values() for y in line]))

    monkeypatch.setattr(curve, "_draw_arm", note)
    rows = [
        {"arm": "ppo", "member": "ppo/0", "seed": 0, "iteration": i, "env_steps": 10 * i}
        | {"return_mean": float(i)}
        | ({"eval_return_mean": 7.0} if i == 2 else {})
        for i in range(3)
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (tmp_path / "config.json").write_text(json.dumps({"config": {"env": "A", "preset": "p"}}))
    assert plot([tmp_path]) == tmp_path / "figures" / "learning_curve.png"
    assert drawn == [("ppo", [0.0, 1.0, 2.0]), ("ppo, evaluations", [7.0])]


def test_only_steps_that_all_curves_have_are_compared() -> None:
    """The longer curve is cut where the shorter one ends; the last tenth of that is the score."""
    x = np.arange(0.0, 2001.0, 100.0)
    long = Source("a", "A-v0", "", Path("a"), {}, {0: Curve(x, x)})
    short = Source("b", "A-v0", "", Path("b"), {}, {0: Curve(x[:11], 3 * x[:11])})
    members = [cell["members"][0] for cell in results_of([long, short], "")["cells"]]
    assert [member["final_return"] for member in members] == [950.0, 2850.0]
    assert [member["auc"] for member in members] == [500.0, 1500.0]
    assert [member["curve"]["env_steps"][-1] for member in members] == [1000.0, 1000.0]
    later = Source("c", "A-v0", "", Path("c"), {}, {0: Curve(x + 5000, x)})
    with pytest.raises(BadInput, match="no env steps in common"):
        results_of([long, later], "")


def test_runs_of_different_tasks_are_not_compared() -> None:
    x = np.arange(0.0, 2001.0, 100.0)
    one = Source("a", "A-v0", "", Path("a"), {}, {0: Curve(x, x)})
    other = Source("b", "B-v0", "", Path("b"), {}, {0: Curve(x, x)})
    with pytest.raises(BadInput, match="runs of different tasks cannot be compared: A-v0, B-v0"):
        results_of([one, other], "")


def test_a_comparison_says_where_each_arm_ends_and_writes_a_report(tmp_path: Path) -> None:
    low, high = (
        write_csv(tmp_path / name, top, end)
        for name, top, end in (("low.csv", 100.0, 20_000), ("high.csv", 200.0, 18_000))
    )
    said = compare_existing([low, high], out=str(tmp_path / "out"))
    assert said[0] == "compared up to 18k env steps; the arms end: low at 20k, high at 18k"
    assert said[1].startswith("final return here: mean of the returns from 16.2k to 18k env steps")
    assert any("high: better than low" in line and "exact p = 0.029" in line for line in said)
    [report] = (tmp_path / "out").glob("*/report.html")
    page = report.read_text()
    assert "<title>Is high better than low on the task?</title>" in page
    assert said[0] in page and "Returns as the files hold them." in page
    assert "sauna compare" in page and "which every seed reaches" in page
    with pytest.raises(BadInput, match="steps: not read for runs that exist"):
        compare_existing([low, high], out=str(tmp_path / "none"), steps="5")
    with pytest.raises(BadInput, match="give two runs or more"):
        compare_existing([low], out=str(tmp_path / "none"))
    assert not (tmp_path / "none").exists()


def test_evaluations_of_runs_are_compared_up_to_the_same_env_steps(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    of_ppo = [row for row in rows if row["arm"] == "ppo" and row["env_steps"] > 100]
    for row in of_ppo:
        row["eval_return_mean"] = row["env_steps"] + 10.0 * row["seed"]
    rows.remove(of_ppo[-1])  # the other seed is cut at 200 env steps, too
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    results = results_of(read_sources([run]), "")
    ppo, sauna = (cell["members"] for cell in results["cells"])
    assert [one["evaluations"]["env_steps"] for one in ppo] == [[200], [200]]
    assert [one["eval_return"] for one in ppo] == [200.0, 210.0]
    assert not any("evaluations" in one for one in sauna)


def test_runs_are_plotted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run, other = write_run(tmp_path / "run"), write_csv(tmp_path / "other.csv", 9.0, 3000)
    assert plot([run]) == run / "figures" / "learning_curve.png"
    assert plot([run, other]) == Path("learning_curves.png")
    assert image.imread("learning_curves.png").shape[1] > 500
    for label in ("ppo, mean of 2 seeds<", "other, mean of 4 seeds and 95% interval<"):
        assert label in plot([run, other], "mine.svg").read_text()
    with pytest.raises(BadInput, match=r"must end in \.png or \.svg"):
        plot([run], "mine.pdf")


def test_the_commands_answer_mistakes_in_one_line(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", 1.0, 3000)
    for command, message in (
        (("plot", "nothing"), "nothing does not exist"),
        (("compare", "a.csv", "b.csv"), "b.csv does not exist"),
        (("compare", "a.csv", "--seeds", "3"), "seeds: not read for runs that exist"),
        (("compare",), "env: no environment given"),
    ):
        done = sauna(*command, cwd=tmp_path)
        assert done.returncode == 2 and message in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_an_arm_of_one_row_is_left_out_beside_one_that_has_a_curve(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("arm,seed,env_steps,return_mean\nppo,0,1,2\nppo,0,2,3\nsauna,0,1,2\n")
    (found,) = read_sources([path])
    assert found.label == "ppo" and list(found.seeds[0][1]) == [2.0, 3.0]
    path.write_text("arm,seed,env_steps,return_mean\nppo,0,1,2\nsauna,0,1,2\n")
    with pytest.raises(BadInput, match="no seed has two points"):
        read_sources([path])
