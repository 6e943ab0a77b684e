"""The page of the study of selection rules: rule x task, the pilots, every arm of every task."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from selection_arms import arms
from selection_stage import stage_of, stage_text
from selection_standing import planned_of, standing, standing_text
from selection_trainings import is_control, seeds_said
from selection_words import Cell, coloured, words_of
from studies import folded, load, markdown, page

from sauna.config.presets import RANDOM_CONTROL
from sauna.experiments.study.spec import load_spec
from sauna.experiments.study.summary import summarize
from sauna.experiments.study.tables import unversioned

PILOTS = ("selection-pilot-hopper", "selection-pilot-breakout")
SCREENS = tuple(
    f"selection-screen-{name}" for name in ("mujoco", "minatar", "cartpole", "lunarlander")
)
SELECTION = (*PILOTS, *SCREENS)
# Quantities of a curve that are committed, and points of it: there are many arms.
CURVES = ("return_mean", "samples_backward", "learner_cpu_seconds")
POINTS = 20
NOTHING = "The screen has not been trained yet."
Summarized = tuple[Mapping[str, Any], Mapping[str, Any]]  # a result file, and its summary


def _summarized(results: Mapping[str, Any]) -> Summarized:
    return results, summarize(results)


def selection_page() -> str | None:
    """Writes the page; None if nothing has been trained yet."""
    found = {name: results for name in SELECTION if (results := load(name))}
    if not found:
        return None
    screens = [results for name, results in found.items() if name in SCREENS]
    pilots = [results for name, results in found.items() if name in PILOTS]
    summaries = [*map(_summarized, screens)]
    return page(
        "selection",
        screen=_screen(summaries),
        details=_details(summaries),
        pilots=_pilots(pilots),
        points=str(POINTS),
    )


def _screen(summaries: Sequence[Summarized]) -> str:
    if not summaries:
        return NOTHING
    studies, cells = [results for results, _ in summaries], _cells(summaries)
    return "\n\n".join(
        [
            "## The screen: rule by task",
            f"{_seeds(studies).capitalize()} of each arm. A cell shows the word at equal env steps "
            "and the probability of improvement over `ppo`, then the learner compute that the arm "
            "takes to reach PPO's final return, then what else a reader has to know "
            "([how to read it](#how-to-read-the-tables)).",
            _table(cells, _shown, controls=False),
            folded("The matched random controls", _table(cells, _shown, controls=True)),
        ]
    )


def _details(summaries: Sequence[Summarized]) -> str:
    """What follows from the screen's table, and every arm behind it."""
    if not summaries:
        return ""
    planned, studies = planned_of(map(load_spec, SCREENS)), [results for results, _ in summaries]
    parts = [
        "## What the tests decide",
        stage_text(stage_of(studies, planned)),
        "## Standing after the screen so far",
        standing_text(standing(studies, planned), planned),
        "## Every arm, task by task",
        *(_task(task, r, s) for r, s in summaries for task in s["curves"]),
    ]
    return "\n\n".join(parts)


def _cells(summaries: Iterable[Summarized]) -> dict[tuple[str, str], Cell]:
    """What the screen has found of each arm and task."""
    found: dict[tuple[str, str], Cell] = {}
    for results, summary in summaries:
        found |= words_of(results, summary)
    return found


def _table(
    cells: Mapping[tuple[str, str], Cell],
    shown: Callable[[Cell, str], str],
    controls: bool,
    prefix: str = "",
) -> str:
    """Tabulates rule by task, of rules or of controls.

    Args:
      shown: writes a cell, from it and the address of what is behind it.
      prefix: path from the page that shows the table to this study's page.
    """
    links = {task: f"{prefix}#{_anchor(task)}" for _, task in cells}
    labels = dict.fromkeys(label for label, _ in cells if is_control(label) == controls)
    head = ["Rule", *(f"[{_short(task)}]({link})" for task, link in links.items())]
    rows = [
        [
            f"`{label}`",
            *(
                shown(cells[label, task], link) if (label, task) in cells else "-"
                for task, link in links.items()
            ),
        ]
        for label in labels
    ]
    return markdown([head, *rows])


def _shown(cell: Cell, link: str) -> str:
    return cell.shown


def glance() -> str:
    """Tabulates rule by task in two words a cell, for the first page; says so if there is none."""
    studies = [results for name in SCREENS if (results := load(name))]
    if not studies:
        return NOTHING
    cells = _cells(map(_summarized, studies))
    return _table(with_controls(cells), _words, controls=False, prefix="selection.md")


def with_controls(cells: Mapping[tuple[str, str], Cell]) -> dict[tuple[str, str], Cell]:
    """Says of each rule that is better at equal compute if its random control is, too."""
    found = dict(cells)
    for (label, task), cell in cells.items():
        control = cells.get((label + RANDOM_CONTROL, task))
        if control is not None and cell.compute == control.compute == "better":
            found[label, task] = cell._replace(compute="better, as its control")
    return found


def _words(cell: Cell, link: str) -> str:
    both = f"[{coloured(cell.word)}<br>{coloured(cell.compute)}]({link})"
    return both + "<br>drops under 1%" * cell.idle


def screen_answer() -> str | None:
    """Says in a sentence what the screen has found so far; None if nothing is trained."""
    studies = [results for name in SCREENS if (results := load(name))]
    cells: dict[str, dict[str, Cell]] = {}
    for (label, task), cell in _cells(map(_summarized, studies)).items():
        if not is_control(label):
            cells.setdefault(label, {})[task] = cell
    if not cells:
        return None
    specs = [load_spec(name) for name in SCREENS]
    planned = [task for spec in specs for task in spec.tasks]
    tasks = [task for task in planned if any(task in found for found in cells.values())]
    whole = [
        task
        for task in tasks
        if all(
            task in cells.get(label, {})
            for label, of_task in planned_of(specs)
            if of_task == task and label != "ppo" and not is_control(label)
        )
    ]
    better = [f"`{label}`" for label, found in cells.items() if _is_better(found.values())]
    worse = [x for x, found in cells.items() if any(c.word == "worse" for c in found.values())]
    part = f", some on {len(tasks) - len(whole)} more" if len(tasks) > len(whole) else ""
    gains = f"better on a task: {', '.join(better)}" if better else "no rule beats `ppo`"
    return (
        f"**not decided**. All rules are trained on {len(whole)} of {len(planned)} tasks{part}, "
        f"with {_seeds(studies)}. By the intervals {gains}, and {len(worse)} of {len(cells)} "
        "scored worse on a task"
    )


def _is_better(cells: Iterable[Cell]) -> bool:
    """Returns whether a rule is better on a task where its choice can have the credit."""
    return any(cell.word == "better" and not cell.idle for cell in cells)


def _seeds(studies: Sequence[Mapping[str, Any]]) -> str:
    return seeds_said([cell for results in studies for cell in results["cells"]])


def _task(task: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Every arm of a task, folded, below a heading that the table links to."""
    command = f"`{results['command']}`, preset `{_preset(results, task)}`."
    text = f"{command}\n\n{arms(task, results, summary)}"
    return f"### {_short(task)}\n\n{folded('All arms', text)}"


def _pilots(studies: Sequence[Mapping[str, Any]]) -> str:
    if not studies:
        return ""
    members = [m for results in studies for cell in results["cells"] for m in cell["members"]]
    failed = sum(m["status"] == "failed" for m in members)
    parts = [
        "## The pilot: does every rule train?",
        f"{_seeds(studies).capitalize()} of each arm, and a fraction of the usual env steps. The "
        f"pilot decides nothing. Of {len(members)} trainings {failed or 'none'} failed.",
    ]
    for results in studies:
        summary = summarize(results)
        for task in summary["curves"]:
            steps = int(float(load_spec(results["name"]).text["steps"]))
            parts += [
                f"### {_short(task)}, pilot",
                f"`{results['command']}`: {steps:,} env steps, preset `{_preset(results, task)}`.",
                arms(task, results, summary),
            ]
    return "\n\n".join(parts)


def _preset(results: Mapping[str, Any], task: str) -> str:
    return str(next(cell["preset"] for cell in results["cells"] if cell["task"] == task))


def _short(task: str) -> str:
    return unversioned(task).removeprefix("gymnax/").removesuffix("-MinAtar")


def _anchor(task: str) -> str:
    return _short(task).lower()
