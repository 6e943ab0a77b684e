"""Makes everything under `results/` and the tables and figures that are made of it.

    python results/make.py             docs and figures from the result files
    python results/make.py --collect   takes what the studies in runs/ have found so far, first
    python results/make.py --train     trains first (many hours), continuing where it stopped;
                                       what a result file holds whole is not trained again

The runs stay in `runs/`, which is not in the repository; what is committed is each member's final
numbers and a thinned curve.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from clone_page import clone_text
from exports_page import exports_text
from measured_pages import fine_tuning_page, noise_page, posture_page, sweep_page
from pictures import store
from selection_page import CURVES as SELECTION_CURVES
from selection_page import POINTS as SELECTION_POINTS
from selection_page import SELECTION, selection_page
from studies import MEASURED, ROOT, STUDIES, load, page_of
from study_pages import pong_text, ppo_page, study_page
from summary_page import findings, index
from tune_page import tune_text
from zoo_page import draw_zoo, zoo_page

from sauna.experiments.report.figures import draw_plots, write_figures
from sauna.experiments.report.page import rounded
from sauna.experiments.study.results import cell_command, each_once, gather
from sauna.experiments.study.spec import Spec, built_in, load_spec
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.units import units_of

PAGES = ROOT / "docs" / "results"
FIGURES = PAGES / "figures"
STILLS = FIGURES / "fig5_stills.png"
CURVES_OF_RETURNS = "learning_curves"  # the figure's name
CURVES = ("return_mean", "keep_rate", "vex_mean", "explained_variance")
SHOWN_PLOTS = ("noise_variance", "sweep_coverage")  # of the measurements, those on a page
POINTS = 30  # of each curve that are committed
# Arms in the README's figure.
SHOWN = ("ppo", "vex-head", "random-drop", "sauna 0.8 random", "sauna 0.8")


def train(name: str) -> None:
    """Trains and measures what is missing; a failure is printed and kept in the results.

    Raises:
      SystemExit: it was interrupted.
    """
    study = remaining(name)
    if study is None:
        return
    command = [sys.executable, "-m", "sauna", "study", str(study), "--out", "runs"]
    code = subprocess.run(command).returncode
    if code in (130, 143) or code < 0:
        sys.exit(code)
    if code:
        print(f"{name}: exit code {code}", flush=True)


def remaining(name: str) -> Path | str | None:
    """The study without what `results/NAME.json` holds whole; None if it holds all.

    So a large study can be trained on several machines, or without the runs of before: arm by arm
    and task by task. A baseline is trained with each arm that it is the baseline of.
    """
    spec, stored = load_spec(name), load(name)
    if name in MEASURED or not stored or (ROOT / "runs" / name).exists():
        return name
    trained = {(cell["task"], cell["label"]): len(cell["members"]) for cell in stored["cells"]}
    missing = {
        arm.label: [t for t in arm.tasks if trained.get((t, arm.label), 0) < len(arm.seeds)]
        for arm in spec.arms
    }
    if not any(missing.values()):
        return None
    for arm in spec.arms:
        if arm.baseline is not None:
            missing[arm.baseline] += missing[arm.label]
    text = re.sub(r"^tasks = .*\n", "", built_in()[name], flags=re.M)
    head, *arms = text.split("[[arms]]\n")
    left = [
        f"[[arms]]\ntasks = {json.dumps([t for t in spec.tasks if t in missing[label]])}\n{arm}"
        for label, arm in zip(missing, arms, strict=True)
        if missing[label]
    ]
    path = ROOT / "runs" / f"{name}.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(head + "".join(left))
    return path


def collect(name: str) -> None:
    """`results/NAME.json` from what `runs/` holds of the study: finished members, thinned curves.

    The study may still be running, or have been interrupted. Cells that `runs/` does not hold stay
    as they are in the file.
    """
    stored = ROOT / "runs" / name / "study.json"
    if not stored.exists():
        return
    spec, size = load_spec(name), json.loads(stored.read_text())["seeds_per_unit"]
    folder = ROOT / "runs" / "units"
    results = gather(spec, units_of(spec, size), folder, f"sauna study {name}")
    chosen = (SELECTION_CURVES, SELECTION_POINTS) if name in SELECTION else (CURVES, POINTS)
    cells = [_thinned(cell, *chosen) for cell in results["cells"]]
    results["cells"] = [cell for cell in cells if cell["members"]]
    if not results["cells"]:
        return
    for cell in results["cells"]:
        del cell["config"]  # the command says what differs from the preset
    results = merged(load(name) or {}, results, spec)
    text = json.dumps(results, separators=(",", ":"))
    (ROOT / "results" / f"{name}.json").write_text(text.replace('{"task"', '\n{"task"') + "\n")


def merged(old: dict[str, Any], new: dict[str, Any], spec: Spec) -> dict[str, Any]:
    """`new` with the cells of `old` that it lacks, in the order of the study.

    A cell of settings that the study no longer has is left out.
    """
    cells = {
        (cell["task"], cell["label"]): cell
        for cell in (*old.get("cells", ()), *new["cells"])
        if _is_of(spec, cell)
    }
    order = [(task, arm.label) for task in spec.tasks for arm in spec.arms]
    made_with = {
        key: each_once([*_listed(old.get(key, [])), *_listed(new[key])])
        for key in ("versions", "machine", "git")
    }
    return {**new, **made_with, "cells": [cells[key] for key in order if key in cells]}


def _listed(value: Any) -> list[Any]:
    """What `each_once` was given, as far as it differed."""
    return value if isinstance(value, list) else [value]


def _is_of(spec: Spec, cell: dict[str, Any]) -> bool:
    """Whether a study still has a cell's arm, with the settings that it was trained with."""
    return any(
        cell["command"] == cell_command(arm, cell["task"])
        for arm in spec.arms
        if arm.label == cell["label"] and cell["task"] in arm.tasks
    )


def _thinned(cell: dict[str, Any], names: tuple[str, ...], points: int) -> dict[str, Any]:
    """Keeps the members that have ended, and `points` of some curves of theirs."""
    members = [m for m in cell["members"] if m["status"] in ("complete", "failed")]
    for member in members:
        curve, number = member["curve"], len(member["curve"]["env_steps"])
        chosen = (
            np.unique(np.linspace(0, number - 1, points).astype(int)).tolist() if number else []
        )
        member["curve"] = {
            key: [curve[key][i] for i in chosen] for key in ("env_steps", *names) if key in curve
        }
    return {**cell, "members": members}


def collect_measured(name: str) -> None:
    """`results/NAME.json`: what a study has measured of its members so far, to five digits."""
    place = ROOT / "runs" / name
    path = place / f"{load_spec(name).measure}.json"
    if path.exists():
        found = {**json.loads(path.read_text()), "command": f"sauna study {name}"}
        text = json.dumps(rounded(found), separators=(",", ":"))
        text = text.replace('{"task"', '\n{"task"') + "\n"
        (ROOT / "results" / f"{name}.json").write_text(text)
    if (place / "figures" / "frames.png").exists():
        STILLS.parent.mkdir(parents=True, exist_ok=True)
        store(place / "figures" / "frames.png", STILLS)


def insert(path: Path, name: str, text: str) -> None:
    """Puts `text` between the markers `NAME` of a Markdown file."""
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    whole = path.read_text()
    head, rest = whole.split(begin)
    path.write_text(f"{head}{begin}\n{text}\n{end}{rest.split(end)[1]}")


def figure(name: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
    """A study's learning curves as SVG, a picture that git stores in little room."""
    with tempfile.TemporaryDirectory() as folder:
        written = write_figures(results, summary, Path(folder))
        shutil.copy(written[CURVES_OF_RETURNS], FIGURES / f"{name}.svg")


def measured_figures(name: str, measured: Mapping[str, Any]) -> None:
    """The figures of a measurement that a page shows, as PNG."""
    extra = MEASURED[name].report(measured)
    plots = [plot for plot in extra.plots if plot.name in SHOWN_PLOTS]
    with tempfile.TemporaryDirectory() as folder:
        for path in draw_plots(plots, extra.looks, Path(folder)).values():
            store(path.with_suffix(".png"), FIGURES / f"{path.stem}.png")


def readmes_picture(results: dict[str, Any]) -> None:
    """Draws fig3's learning curves of the arms that decide."""
    shown = {**results, "cells": [cell for cell in results["cells"] if cell["label"] in SHOWN]}
    with tempfile.TemporaryDirectory() as folder:
        write_figures(shown, summarize(shown), Path(folder))
        picture = Path(folder) / "figures" / f"{CURVES_OF_RETURNS}.png"
        store(picture, ROOT / "docs" / "images" / picture.name)


def write_pages() -> None:
    """Writes `docs/results/` and the generated parts of other pages."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    for name in STUDIES:
        if results := load(name):
            summary = summarize(results)
            figure(name, results, summary)
            (PAGES / page_of(name)).write_text(study_page(name, results, summary))
    makers = {
        "noise": noise_page,
        "dial": sweep_page,
        "fig5": lambda measured: posture_page(measured, STILLS.exists()),
    }
    for name, make in makers.items():
        if measured := load(name):
            measured_figures(name, measured)
            (PAGES / page_of(name)).write_text(make(measured))
    if zoo := load("zoo"):
        draw_zoo(zoo["units"], FIGURES / "zoo.svg")
        (PAGES / "zoo.md").write_text(zoo_page(zoo["units"]))
    if found := load("fine_tuning"):
        (PAGES / "fine_tuning.md").write_text(fine_tuning_page(found))
    if text := selection_page():
        (PAGES / "selection.md").write_text(text)
    covered = json.loads((ROOT / "results" / "intervals.json").read_text())["iqm_of_normals"]["6"]
    (PAGES / "index.md").write_text(index(covered))
    insert(ROOT / "README.md", "findings", findings("docs/results/", short=True))
    if results := load("fig3"):
        readmes_picture(results)
        (PAGES / "ppo.md").write_text(ppo_page(results))
    if clones := load("clone"):
        text = clone_text(clones["tasks"])
        insert(ROOT / "docs" / "how-to" / "record_and_clone.md", "clone", text)
    if exported := load("exports"):
        insert(ROOT / "docs" / "how-to" / "deploy.md", "exports", exports_text(exported))
    if tuned := load("tune"):
        insert(ROOT / "docs" / "how-to" / "tune.md", "tune", tune_text(tuned))
    if results := load("pong"):
        insert(ROOT / "docs" / "how-to" / "atari.md", "pong", pong_text(results))


def main() -> None:
    os.chdir(ROOT)
    for name in (*STUDIES, *SELECTION):
        if "--train" in sys.argv:
            train(name)
        if "--train" in sys.argv or "--collect" in sys.argv:
            collect(name)
    for name in MEASURED:
        if "--train" in sys.argv:
            train(name)
        if "--train" in sys.argv or "--collect" in sys.argv:
            collect_measured(name)
    write_pages()


if __name__ == "__main__":
    main()
