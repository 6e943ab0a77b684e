"""The report: its numbers are the summary's, and it needs nothing but itself."""

from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import chromium
from sauna.experiments.report import style
from sauna.experiments.report.figures import (
    Line,
    Panel,
    Plot,
    _draw_panel,
    looks_of,
    plots_of,
)
from sauna.experiments.report.readout import read_out
from sauna.experiments.study import tables
from sauna.experiments.study.report import make_page, question, write_report
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.text import lines

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&$x$"
ERROR = "NotFinite: the loss of <member> is nan\n  at iteration 3"
METRICS = ("return_mean", "keep_rate", "vex_mean", "explained_variance")


def member(seed: int, level: float, keep_rate: float) -> dict[str, Any]:
    """A complete member whose return climbs to `level` plus a tenth of its seed."""
    final = level * (1 + 0.1 * seed)
    steps = list(range(10_000, 110_000, 10_000))
    curve: dict[str, list[Any]] = {"env_steps": steps}
    curve["return_mean"] = [None, *(final * (0.1 + 0.1 * i) for i in range(1, 10))]
    curve["keep_rate"] = [keep_rate] * 10
    curve["vex_mean"] = [None] * 10 if keep_rate == 1 else [0.05 * i for i in range(10)]
    curve["explained_variance"] = [0.5 + 0.01 * seed] * 10
    return {
        "seed": seed,
        "status": "complete",
        "error": None,
        "final_return": final,
        "auc": 0.6 * final,
        "env_steps": 100_000,
        "kept_steps": int(100_000 * keep_rate),
        "keep_rate": keep_rate,
        "episodes": 99,
        "explained_variance": 0.5,
        "curve": curve,
    }


def make_results(
    tasks: tuple[str, ...] = ("HalfCheetah-v5", "Reacher-v5"), seeds: int = 5, mark: str = ""
) -> dict[str, Any]:
    """Four labels on each task; one failed seed. `mark` is put into every text."""
    cells = []
    for task in tasks:
        for place, label in enumerate(("ppo", "vex-head", "sauna", "sauna 0.8")):
            level = -7.4 if "Reacher" in task else 1500.5 + 300 * place
            members = [member(seed, level, 1 - 0.2 * (place > 1)) for seed in range(seeds)]
            cells.append(
                {
                    "task": task + mark,
                    "label": label + mark,
                    "arm": label.split()[0],
                    "preset": "mujoco",
                    "members": members,
                    "config": {"steps": 1_000_000, "threshold": 0.1 * place, "note": mark},
                    "command": f"sauna train {task} --arm {label} {mark}",
                }
            )
    if seeds > 1:
        failed = {"status": "failed", "error": ERROR + mark, "final_return": None, "auc": None}
        cells[2]["members"][1].update(failed)
    return {
        "format": 1,
        "name": "compare" + mark,
        "command": "sauna compare --seeds 5 " + mark,
        "metric": "mean return of the last 100 episodes" + mark,
        "baseline": "ppo" + mark,
        "settings": {"steps": 100_000, "note": mark},
        "versions": {"sauna": "0.1.0"},
        "machine": {"cores": 2},
        "git": None,
        "cells": cells,
    }


class Page(HTMLParser):
    """A page's elements `(name, attributes)`, its tables as `row header -> cells`, its texts."""

    VOID = ("meta", "img", "br", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []  # the text of each cell, header cell first
        self.values: list[list[list[float]]] = []  # the exact numbers of each cell
        self.scripts: list[str] = []
        self._open: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        self.elements.append((name, found))
        if name not in self.VOID:
            self._open.append(name)
        if name == "tr":
            self.rows.append([])
            self.values.append([])
        elif name in ("td", "th"):
            self.rows[-1].append("")
            self.values[-1].append([])
        elif name == "script":
            self.scripts.append("")
        elif name == "data":
            self.values[-1][-1].append(float(found["value"] or "nan"))

    def handle_endtag(self, name: str) -> None:
        assert self._open.pop() == name, (name, self._open)

    def handle_data(self, text: str) -> None:
        self.text += text
        if {"td", "th"} & set(self._open):
            self.rows[-1][-1] += text
        if self._open and self._open[-1] == "script":
            self.scripts[-1] += text

    def exact(self, label: str) -> list[list[list[float]]]:
        """The numbers of the rows with this header, without the header."""
        pairs = zip(self.rows, self.values, strict=True)
        return [values[1:] for row, values in pairs if row[0] == label]


def written(results: dict[str, Any], folder: Path) -> tuple[Page, dict[str, Any]]:
    summary = summarize(results)
    text = write_report(results, summary, folder).read_text(encoding="utf-8")
    return Page(text), summary


def page_of(results: dict[str, Any]) -> tuple[Page, dict[str, Any]]:
    """The page alone: the files of its figures take most of a report's time."""
    summary = summarize(results)
    return Page(make_page(results, summary)), summary


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Page, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("report")
    return folder / "report.html", *written(make_results(), folder)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Page]:
    folder = tmp_path_factory.mktemp("hostile")
    results = make_results(("HalfCheetah-v5",), mark=HOSTILE)
    return folder / "report.html", written(results, folder)[0]


def expected(row: dict[str, Any]) -> list[list[float]]:
    """The cells of a row of the main table, as `summary.json` has them."""
    cells = (
        row["final_iqm"],
        row["improvement"] or [],
        row["auc_iqm"],
        [row["final_mean"], row["final_std"]],
        [row["keep_rate"]],
        [row["env_steps"]],
        [],
    )
    return [[value for value in cell if value is not None] for cell in cells]


def test_the_tables_numbers_are_the_summarys(report) -> None:
    _, page, summary = report
    for label in ("ppo", "vex-head", "sauna", "sauna 0.8"):
        rows = [row for row in summary["table"] if row["label"] == label]
        assert page.exact(label)[: len(rows)] == [expected(row) for row in rows]
    for row in summary["over_tasks"]:
        assert page.exact(row["label"])[2] == [[], row["improvement"]]
    shown = next(row for row in page.rows if row[0] == "sauna")
    assert shown[7] == "4 1 failed"
    assert re.fullmatch(r"2,\d{3} \[[12],\d{3}, [23],\d{3}\]", shown[1])


def test_the_verdict_is_first_and_whole(report) -> None:
    _, page, summary = report
    places = [page.text.index(verdict["text"]) for verdict in summary["verdicts"]]
    assert places == sorted(places) and len(places) == 6
    filter = [page.text.index(verdict["text"]) for verdict in summary["filtering"]]
    assert (
        places[-1] < page.text.index("Ablation of the selection rule") < filter[0]
        and len(filter) == 4
    )
    assert filter[-1] < page.text.index("Final return, IQM")
    chances = {(row["label"], row["task"]): row["improvement"] for row in summary["table"]}
    for label in ("vex-head", "sauna", "sauna 0.8"):
        of_tasks = [chances[label, task][:1] for task in ("HalfCheetah-v5", "Reacher-v5")]
        assert page.exact(f"{label} than ppo") == [of_tasks]


def test_what_an_arm_is_better_than_is_said() -> None:
    results = make_results()
    for cell in results["cells"]:
        if cell["label"] == "sauna 0.8":
            cell["baseline"] = "vex-head"
    page, _ = page_of(results)
    rows = [row for row in page.rows if row[0] == "sauna 0.8"]
    assert all(row[2].endswith(" than vex-head") for row in rows[:3])  # two tasks, and over both
    assert not any(" than " in cell for row in page.rows if row[0] == "sauna" for cell in row)
    assert len(page.exact("sauna 0.8 than vex-head")) == 1


def test_what_is_not_known_is_a_dash(tmp_path) -> None:
    page, summary = page_of(make_results(tasks=("Custom-v0",), seeds=1))
    row = next(row for row in page.rows if row[0] == "sauna")
    assert row == ["sauna", "2,100 -", "1.00 -", "1,260 -", "2,100 ± -", "0.800", "100,000", "1"]
    assert {verdict["kind"] for verdict in summary["verdicts"]} == {"underpowered"}
    assert "Beside the paper" not in page.text  # it does not have this task
    results = make_results(tasks=("Custom-v0",), seeds=1)
    for cell in results["cells"]:
        cell["members"][0].update(status="running", final_return=None, auc=None)
    page, _ = written(results, tmp_path / "new")
    row = next(row for row in page.rows if row[0] == "sauna")
    assert row == ["sauna", "-", "-", "-", "-", "-", "-", "0 1 running"]
    assert "4 not finished yet" in page.text and "nan" not in page.text.lower()
    assert "There is nothing to draw yet." in page.text


def test_failed_seeds_settings_and_commands_are_shown(report) -> None:
    _, page, _ = report
    assert ERROR in page.text and "1 failed" in page.text
    assert "sauna compare --seeds 5" in page.text
    assert page.text.count("sauna train ") == 8
    assert ["threshold", "0.2", "0.0"] in page.rows  # the last is where the baseline differs
    assert ["steps", "1000000", ""] in page.rows
    assert ["git revision", "-"] in page.rows
    assert sum(row[1:2] == ["failed"] for row in page.rows) == 1


def test_the_papers_numbers_stand_beside_ours(report) -> None:
    _, page, summary = report
    row = next(row for row in page.rows if row[1:2] == ["2,277 ± 432"])
    assert row[0] == "HalfCheetah-v5" and row[2] == "2,929 ± 169"
    ours = [[r["final_mean"], r["final_std"]] for r in summary["table"] if r["task"] == row[0]]
    assert page.values[page.rows.index(row)][3:] == ours
    assert next(row for row in page.rows if row[1:2] == ["\u22127.5 ± 0.8"])[0] == "Reacher-v5"


def test_the_papers_numbers_do_not_stand_beside_another_algorithm() -> None:
    cell = {"task": "Hopper-v5", "label": "a2c", "config": {"algorithm": "a2c"}}
    row = {"task": "Hopper-v5", "label": "a2c", "final_mean": 1.0, "final_std": 0.0}
    ppo = {"cells": [{**cell, "config": {"algorithm": "ppo"}}]}
    found = tables.paper(ppo, {"table": [row]})
    assert found is not None and found["rows"][0]["printed"][0].startswith("2,106")
    assert tables.paper({"cells": [cell]}, {"table": [row]}) is None
    short = {"cells": [{**cell, "config": {"steps": 100_000}}]}
    assert tables.paper(short, {"table": [row]}) is None  # the paper's has 10^6 steps


def test_nothing_is_fetched(report) -> None:
    path, page, _ = report
    for name, attributes in page.elements:
        assert name not in ("link", "iframe", "object", "embed", "base", "form")
        for key in ("src", "href", "srcset", "data", "action", "poster"):
            value = attributes.get(key) or "#"
            assert value.startswith(("#", "data:image/svg+xml;base64,")), (name, value)
    policy = next(a["content"] for n, a in page.elements if a.get("http-equiv"))
    assert policy is not None and policy.startswith("default-src 'none'; img-src data:;")
    assert "script-src" not in policy and not page.scripts
    text = path.read_text()
    css = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in css and "@import" not in css


def test_hostile_text_stays_text(hostile) -> None:
    _, page = hostile
    assert not page.scripts
    pictures = [attributes for name, attributes in page.elements if name == "img"]
    assert all((picture["src"] or "").startswith("data:") for picture in pictures)
    assert not any(key.startswith("on") for _, found in page.elements for key in found)
    for text in (f"compare{HOSTILE}", ERROR + HOSTILE, f"--seeds 5 {HOSTILE}"):
        assert text in page.text


def test_tables_and_figures_can_be_read_aloud(report) -> None:
    _, page, _ = report
    assert all(a.get("scope") for name, a in page.elements if name == "th")
    pictures = [a["alt"] or "" for name, a in page.elements if name == "img"]
    assert len(pictures) == 10  # a panel for each task
    assert "ppo 1801 at 100k" in pictures[0] and "Reacher-v5" in pictures[1]


def test_figures_hold_what_there_is(report) -> None:
    path, _, summary = report
    plots = {plot.name: plot for plot in plots_of(make_results(), summary)}
    names = ("learning_curves", "keep_rate", "vex", "explained_variance", "profiles")
    assert tuple(plots) == names
    assert [line.label for line in plots["vex"].panels[0].lines] == ["sauna", "sauna 0.8"]
    curves = {line.label: line for line in plots["learning_curves"].panels[0].lines}
    assert [seed for seed, _, _ in curves["sauna"].seeds] == [0, 2, 3, 4]  # 1 has failed
    assert curves["ppo"].y == summary["curves"]["HalfCheetah-v5"]["ppo"]["return_mean"]["mean"]
    files = {file.name for file in (path.parent / "figures").iterdir()}
    assert files == {f"{name}.{kind}" for name in names for kind in ("png", "svg")}


def test_evaluations_stand_beside_the_training_return() -> None:
    """Of three arms: one played its most likely actions, one sampled, one was not evaluated."""
    results = make_results(("HalfCheetah-v5",))
    for cell, mode, level in zip(results["cells"][:2], (True, False), (100.0, 400.0), strict=True):
        cell["config"] |= {"eval_deterministic": mode, "eval_episodes": 10}
        for one in cell["members"]:
            ends = [0.5 * level + one["seed"], level + 10 * one["seed"]]
            one["evaluations"] = {"env_steps": [50_000, 100_000], "return_mean": ends}
            one |= {"eval_return": ends[1], "eval_return_best": level + 50}
    page, summary = page_of(results)
    plots = plots_of(results, summary)
    assert [plot.name for plot in plots[:2]] == ["learning_curves", "evaluations"]
    ppo, head = plots[1].panels[0].lines
    assert (ppo.label, ppo.x, ppo.y) == ("ppo", [50_000, 100_000], [52.0, 120.0])
    assert head.y == [202.0, 420.0] and [seed for seed, *_ in head.seeds] == [0, 1, 2, 3, 4]
    assert "10 episodes with deterministic actions, the most likely ones (ppo)" in plots[1].caption
    assert "10 episodes with sampled actions (vex-head)" in plots[1].caption
    assert plots[1].caption in page.text
    row, none = summary["table"][0], summary["table"][2]
    assert row["eval_mean"] == 120.0 and row["eval_std"] == np.std([0, 10, 20, 30, 40], ddof=1)
    assert "eval_mean" not in none
    assert [120.0, row["eval_std"]] in page.exact("ppo")[0]
    assert "Last evaluation, mean ± std" in page.text and "Best evaluation" in page.text
    assert " last evaluation " in lines(summary)[0]
    plain, _ = page_of(make_results(("HalfCheetah-v5",)))
    assert "evaluation" not in plain.text.lower()


def test_the_same_input_gives_the_same_bytes(report, tmp_path) -> None:
    path, _, _ = report
    written(make_results(), tmp_path)
    for file in sorted(p.relative_to(path.parent) for p in path.parent.rglob("*.*")):
        assert (tmp_path / file).read_bytes() == (path.parent / file).read_bytes(), file


def test_no_two_labels_look_alike() -> None:
    results = make_results()
    looks = looks_of(results)
    assert looks["ppo"].colour == style.COLOURS["ppo"] and looks["ppo"].dash == ()
    assert looks["sauna"] == style.looks({"sauna": "sauna"})["sauna"]
    many = {f"sauna {i}": "sauna" for i in range(12)} | {arm: arm for arm in style.COLOURS}
    many |= {f"mine {i}": f"mine {i}" for i in range(8)}
    found = style.looks(many)
    assert list(found) == list(many)
    assert len({(look.colour, look.dash) for look in found.values()}) == len(many)
    assert found["sauna"].colour == style.COLOURS["sauna"]  # an arm's own name comes first


def test_a_rule_beside_ppo_has_another_marker_and_no_blue() -> None:
    arms = ("ppo", "top-advantage", "top-advantage+random", "gigaflow")
    found = style.looks({arm: arm for arm in arms})
    assert len({look.marker for look in found.values()}) == len(arms)
    red, _, blue = (int(found["top-advantage"].colour[i : i + 2], 16) for i in (1, 3, 5))
    assert red > blue


def line(label: str, x: list[float], y: list[float | None]) -> Line:
    return Line(label, [*x], y, [None] * len(x), [None] * len(x), [])


def test_lines_are_compared_only_where_all_have_values() -> None:
    """The longer line is read where the shorter one ends, between its points."""
    panel = Panel(
        "A-v0",
        [
            line("ppo", [0, 10_000, 20_000], [0.0, 10.0, 20.0]),
            line("sauna", [0, 10_000, 15_000, 20_000], [0.0, 4.0, 5.0, None]),
            line("nothing", [0, 10_000], [None, None]),
        ],
    )
    plot = Plot("learning_curves", "", "", "env steps", "return", None, [panel])
    found = read_out(plot, panel)
    assert found is not None
    assert found.caption == "At 15k env steps, the last that every line reaches"
    assert [(row.label, row.values[0], row.end) for row in found.rows] == [
        ("ppo", 15.0, 20_000),
        ("sauna", 5.0, 15_000),
    ]
    apart = Panel("A-v0", [line("a", [1.0, 2.0], [1.0, 1.0]), line("b", [3.0, 4.0], [1.0, 1.0])])
    never = read_out(plot, apart)
    assert never is not None and "no env step at which every line has a value" in never.caption
    assert [row.values[0] for row in never.rows] == [None, None]
    assert read_out(dataclasses.replace(plot, x_label="threshold"), panel) is None


def test_the_title_is_the_question_and_the_first_sentence_its_answer(tmp_path, report) -> None:
    _, page, summary = report
    title = "Are vex-head, sauna and sauna 0.8 better than ppo on 2 tasks?"
    body = page.text[page.text.index(title, page.text.index(title) + 1) :]  # behind <title>
    better = [v for v in summary["verdicts"] if v["kind"] == "better"]
    assert [(v["label"], v["task"]) for v in better] == [("sauna 0.8", "HalfCheetah-v5")]
    answer = "Better: sauna 0.8 on HalfCheetah-v5; not decided: 5 of 6 comparisons."
    assert body[len(title) :].lstrip().startswith(answer)
    own = make_results(tasks=("Reacher-v5",), seeds=1)
    own["cells"] = own["cells"][:2]
    assert question(own) == "Is vex-head better than ppo on Reacher-v5?"
    own["settings"]["question"] = "Does it help?"
    assert question(own) == "Does it help?"


def test_bands_of_two_seeds_do_not_hide_the_lines() -> None:
    """Student's t of two seeds is 13 standard errors wide: the seeds are drawn instead."""
    results = make_results(tasks=("HalfCheetah-v5",), seeds=2)
    summary = summarize(results)
    plot = plots_of(results, summary)[0]
    mean = [y for line in plot.panels[0].lines for y in line.y if y is not None]
    highs = [y for line in plot.panels[0].lines for y in line.high if y is not None]
    assert max(highs) > 1.25 * max(mean)
    axes = Figure().subplots()
    _draw_panel(axes, plot, plot.panels[0], looks_of(results))
    assert axes.get_ylim()[1] < 1.25 * max(mean)
    assert len(axes.get_lines()) == 4 + 2 + 2 + 2  # of sauna one seed failed


# In a browser.


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory):
    executable = chromium.find()
    if executable is None:
        pytest.skip(f"no Chromium is installed (looked for {', '.join(chromium.NAMES)})")
    page = chromium.Page(executable, tmp_path_factory.mktemp("profile"))
    yield page
    page.close()


SHOWN = """
Object.fromEntries([...document.querySelectorAll('#results tbody tr:not(.group)')].map((row, i) =>
  [i, [...row.querySelectorAll('td')].map(cell =>
    [...cell.querySelectorAll('data')].map(one => Number(one.value)))]))
"""


def test_the_page_in_a_browser(browser, report) -> None:
    path, _, summary = report
    browser.open(path, width=1280)
    assert not browser.complaints()
    assert browser.run("[...document.images].every(one => one.naturalWidth > 100)")
    assert browser.run("document.querySelectorAll('.panel img').length") == 10
    shown = list(browser.run(SHOWN).values())
    assert shown[: len(summary["table"])] == [expected(row) for row in summary["table"]]
    outside = [u for u in browser.requests() if not u.startswith(("data:", path.as_uri()))]
    assert not outside


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [360, 390])
def test_a_phone_shows_the_page_without_overflow(browser, report, hostile, width, dark) -> None:
    for path in (report[0], hostile[0]):
        browser.open(path, width=width, dark=dark)
        assert browser.run("document.documentElement.scrollWidth") == width
        back = browser.run("getComputedStyle(document.body).backgroundColor")
        assert back == ("rgb(22, 24, 27)" if dark else "rgb(255, 255, 255)")
        assert not browser.complaints()


def test_a_phone_shows_every_column_of_the_results(browser, report) -> None:
    """No cell of the main table lies outside the window, and each says what it is."""
    browser.open(report[0], width=400)
    cells = "[...document.querySelectorAll('#results .cards td')]"
    assert browser.run(f"Math.max(...{cells}.map(c => c.getBoundingClientRect().right))") <= 400
    assert browser.run(f"{cells}.every(c => c.clientWidth > 0)")
    names = browser.run(f"{cells}.slice(0, 7).map(c => getComputedStyle(c, '::before').content)")
    assert names[0] == '"Final return, IQM"' and names[-1] == '"Seeds"'
