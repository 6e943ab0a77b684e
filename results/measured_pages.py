"""The pages of studies that measure checkpoints: gradient noise, threshold sweep, posture."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from studies import TITLES, WHY, command_of, former_controls, markdown, page, shown_label

from sauna.experiments.measure import coverage_report, noise_report, posture_report
from sauna.experiments.statistics import ALPHA, holm

FRAMES = """![Frames of one pair of seeds](figures/fig5_stills.png)

*One pair, chosen for its contrast: the first seed of which only `sauna 0.8` is on its feet.*"""


def noise_page(measured: Mapping[str, Any]) -> str:
    """Signal and noise of the policy gradient: kept, dropped, and random steps."""
    head = [
        "Task",
        "Arm",
        "Keep rate",
        "Variance of dropped steps, control = 1",
        "Signal to noise, dropped - control",
        "By variance",
        "By signal to noise",
    ]
    full = noise_report.text_table(measured)[1:]
    rows = [
        [row[0], shown_label(row[1]), row[3], row[14], row[7], *_noise_kinds(row)] for row in full
    ]
    return page(
        "noise",
        command=measured["command"],
        title=TITLES["noise"],
        why=WHY["noise"],
        table=markdown([head, *rows]),
        answer=noise_answer(measured),
        kept=_listed_and(
            f"{row[12].split(' ')[0]} ({row[0]}, {shown_label(row[1])})" for row in full
        ),
        everything=_full_noise(full),
    )


def _listed_and(parts: Iterable[str]) -> str:
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def _full_noise(full: list[list[str]]) -> str:
    """All columns of the report, as rows: there are more measurements than arms."""
    arms = [[row[0], shown_label(row[1]), *row[2:]] for row in full]
    return markdown([list(row) for row in zip(noise_report.HEAD, *arms, strict=True)])


def _noise_kinds(row: list[str]) -> tuple[str, str]:
    """What the intervals of a row say of the dropped steps: by variance, by signal to noise."""
    return _kind(row[14], 1.0, ("noisier", "less noisy")), _kind(
        row[7], 0.0, ("less noisy", "noisier")
    )


def _kind(text: str, equal: float, words: tuple[str, str]) -> str:
    """`words` for an interval above or below `equal`; `text` is `value [low, high]`."""
    numbers = [float(x) for x in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", text)]
    if len(numbers) < 3:
        return "-"
    _, low, high = numbers
    return words[0] if low > equal else words[1] if high < equal else "not decided"


def noise_answer(measured: Mapping[str, Any]) -> str:
    """Answers in a word only if all cases agree; else it says what each case decides."""
    kinds = [_noise_kinds(row) for row in noise_report.text_table(measured)[1:]]
    answers = []
    for place, name in ((0, "by variance"), (1, "by signal to noise")):
        found = [kind[place] for kind in kinds]
        counts = [(word, found.count(word)) for word in ("noisier", "less noisy", "not decided")]
        said = ", ".join(f"{word} in {n} of {len(found)}" for word, n in counts if n)
        answer = {"noisier": "**yes**", "less noisy": "**no**"}.get(found[0], "**not decided**")
        agree = len(set(found)) == 1
        answers.append(f"{answer} {name} ({said} cases)" if agree else f"{name} {said} cases")
    return "; ".join(answers)


def sweep_page(measured: Mapping[str, Any]) -> str:
    """Entropy, coverage and return against the threshold."""
    correlations = [["Task", "Entropy", "State coverage", "Final return", "Exploration rises"]]
    controls = [
        ["Task", "Threshold", "Entropy", "State coverage", "Final return", "Pairs", "Differs in"]
    ]
    for task in coverage_report.tasks_of(measured):
        marks = coverage_report.marks(measured, task)
        correlations.append([task, *_correlations(marks)])
        controls += [[task, *row] for row in _beside_controls(marks)]
    head = [
        "Task",
        "Arm",
        "Members",
        "Threshold",
        "Keep rate",
        "Entropy",
        "State coverage",
        "Final return",
    ]
    arms = [
        [row[0], shown_label(row[1]), *row[2:]] for row in coverage_report.text_table(measured)[1:]
    ]
    return page(
        "threshold_sweep",
        command=command_of("dial"),
        title=TITLES["dial"],
        why=WHY["dial"],
        correlations=markdown(correlations),
        controls=markdown(controls),
        former=former_controls(measured["cells"], ["dial"]),
        arms=markdown([head, *arms]),
    )


def _correlations(marks: Any) -> list[str]:
    found = {key: coverage_report.correlation(marks, key) for key in coverage_report.ASKED}
    if any(value is None for value in found.values()):
        return ["-", "-", "-", "not decided"]
    p_values = dict(zip(found, holm([value[1] for value in found.values()]), strict=True))
    shown, signs = [], {}
    for key, (rho, _, _) in found.items():
        p = p_values[key]
        shown.append(f"{rho:.2f} (p {'< 0.001' if p < 0.001 else f'= {p:.3f}'})")
        signs[key] = int(np.sign(rho)) if p < ALPHA else 0
    entropy, coverage = (signs[key] for key in coverage_report.ASKED[:2])
    return [*shown, "yes" if entropy == coverage == 1 else "not decided"]


def _beside_controls(marks: Any) -> list[list[str]]:
    arms = {mark.label: mark for mark in marks}
    rows = []
    for control in marks:
        if control.drops_like not in arms:
            continue
        arm, shown, apart = arms[control.drops_like], [], []
        for key, name in zip(coverage_report.ASKED, ("entropy", "coverage", "return"), strict=True):
            estimate = coverage_report.beside_control(arm, control, key)
            shown.append(noise_report.shown(estimate))
            if estimate.low is not None and not estimate.low <= 0 <= estimate.high:
                apart.append(name)
        key = coverage_report.ASKED[1]
        pairs = {s for s, _ in arm.members[key]} & {s for s, _ in control.members[key]}
        rows.append([arm.label, *shown, str(len(pairs)), ", ".join(apart) or "nothing decided"])
    return rows


def sweep_answer(measured: Mapping[str, Any]) -> str:
    tasks = coverage_report.tasks_of(measured)
    yes = [t for t in tasks if _correlations(coverage_report.marks(measured, t))[-1] == "yes"]
    if not yes:
        return "**not decided**"
    answer = f"**yes on {len(yes)} of {len(tasks)}**, {_listed_and(yes)}"
    rows = [row for task in yes for row in _beside_controls(coverage_report.marks(measured, task))]
    if rows and all("coverage" not in row[-1] and "entropy" not in row[-1] for row in rows):
        answer += "; no difference from a matched random control is decided there"
    return answer


def posture_page(measured: Mapping[str, Any], stills: bool) -> str:
    """Shares of seeds that run on their feet."""
    (_, *rows) = posture_report.text_table(measured)
    head = [
        "Arm",
        "Seeds",
        "On its feet [95%]",
        "Between",
        "Return on its feet",
        "Return on its back",
    ]
    pairs = [["Arm", "Against", "Pairs", "Only the arm on its feet", "Only the other", "p"]]
    for pair in posture_report.pairs(measured):
        counts = (str(pair.seeds), str(pair.gained), str(pair.lost), f"{pair.p:.3f}")
        pairs.append([pair.label, pair.baseline, *counts])
    return page(
        "posture",
        command=measured["command"],
        title=TITLES["fig5"],
        why=WHY["fig5"],
        table=markdown([head, *rows]),
        pairs=markdown(pairs),
        answer=posture_answer(measured),
        frames=FRAMES if stills else "",
    )


def posture_answer(measured: Mapping[str, Any]) -> str:
    feet = {cell["label"]: posture_report.postures(cell) for cell in measured["cells"]}
    pair = next(posture_report.pairs(measured), None)
    if pair is None:
        return "**not decided**"
    counts = [
        f"{sum(one.on_feet for one in feet[label])} of {len(feet[label])} seeds ({label})"
        for label in (pair.label, pair.baseline)
    ]
    word = "not decided"
    if pair.p < ALPHA:
        word = "yes" if pair.gained > pair.lost else "no"
    return f"**{word}**: {counts[0]} against {counts[1]}"


def fine_tuning_page(found: Mapping[str, Any]) -> str:
    """What a run that starts from the weights of another gains, `results/fine_tuning.json`."""
    rows = [["Training", "Return of each seed", "Mean", "Length", "Speed of each seed, m/s"]]
    for arm, unit in found["arms"].items():
        shown = ", ".join(f"{value:,.0f}" for value in unit["returns"])
        speeds = ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in unit["speeds"])
        mean, length = np.mean(unit["returns"]), np.mean(unit["lengths"])
        rows.append([arm, shown, f"{mean:,.0f}", f"{length:,.0f}", speeds])
    return page(
        "fine_tuning",
        steps=f"{found['steps']:,}",
        episodes=found["episodes"],
        table=markdown(rows),
        commands="\n".join(dict.fromkeys(unit["command"] for unit in found["arms"].values())),
    )
