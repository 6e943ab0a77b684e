"""The pages of studies that measure checkpoints: gradient noise, threshold sweep, posture."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from studies import TITLES, WHY, folded, joined, listed, markdown, shown_label

from sauna.experiments.measure import coverage_report, noise_report, posture_report
from sauna.experiments.statistics import ALPHA, holm


def noise_page(measured: Mapping[str, Any]) -> str:
    """Signal and noise of the policy gradient, kept against dropped against random."""
    rows = [
        [
            "Task",
            "Arm",
            "Keep rate",
            "Variance of dropped steps, control = 1",
            "Signal to noise, dropped - control",
            "By variance",
            "By signal to noise",
        ]
    ]
    full = noise_report.text_table(measured)
    for row in full[1:]:
        by_variance, by_signal = _noise_kinds(row)
        rows.append([row[0], shown_label(row[1]), row[3], row[14], row[7], by_variance, by_signal])
    return joined(
        (
            f"# {TITLES['noise']}",
            WHY["noise"],
            "`sauna study noise`: 6 seeds per arm, 10^6 env steps, five checkpoints each. In "
            "brackets: 95% interval over the seeds.",
            markdown(rows),
            f"{noise_answer(measured)}. Variance is the trace of the gradient's covariance with raw "
            "advantages. Signal to noise is the squared length of the mean gradient over that trace, "
            "for one minibatch, with advantages as in training. The control drops as many steps at "
            "random.",
            "![Variance of a minibatch's gradient](figures/noise_variance.png)",
            "*The group's variance over the variance of what the random control keeps. Line: geometric "
            "mean of the members. Band: 95% interval.*",
            "With advantages standardised as in training, minibatches of kept steps have "
            + _listed_and(
                f"{row[12].split(' ')[0]} ({row[0]}, {shown_label(row[1])})" for row in full[1:]
            )
            + " times the variance of the control's.",
            folded("All measurements", _full_noise(full)),
            folded(
                "How it is measured",
                listed(
                    (
                        "At a checkpoint, 64 fresh and independent streams of env steps are collected with the "
                        "policy, the head and the normaliser of that time.",
                        "Half of the streams give the reference: the policy gradient of all steps.",
                        "Each of the others gives 64 minibatches of kept steps, of dropped steps, of steps "
                        "that a random control keeps, and of *shifted* ones.",
                        "Shifted steps are dropped by the filter's decisions moved in time: as many and as "
                        "bunched, but not chosen by the head.",
                        "The cosine compares a minibatch's gradient with the reference. The alignment is that "
                        "cosine for endless minibatches: below 1 means bias.",
                        "Intervals are Student's t over the seeds, each the mean of its checkpoints. They are "
                        "not corrected for their number.",
                    )
                ),
            ),
        )
    )


def _listed_and(parts: Iterable[str]) -> str:
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def _full_noise(full: list[list[str]]) -> str:
    head = [
        "Task",
        "Arm",
        "Members",
        "Keep rate",
        "SNR kept",
        "SNR control",
        "SNR dropped",
        "SNR dropped - control",
        "SNR dropped - shifted",
        "SNR per env step, kept - control",
        "Cosine dropped - control",
        "Alignment of kept, checkpoints",
        "Variance, kept / control",
        "Raw variance, kept / control",
        "Raw variance, dropped / control",
        "Raw variance, dropped / shifted",
    ]
    rows = zip(*[head, *([row[0], shown_label(row[1]), *row[2:]] for row in full[1:])], strict=True)
    turned = [list(row) for row in rows]
    return markdown([turned[0], *turned[1:]])


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
    kinds = [_noise_kinds(row) for row in noise_report.text_table(measured)[1:]]
    answers = []
    for place, name in ((0, "by variance"), (1, "by signal to noise")):
        found = [kind[place] for kind in kinds]
        counts = [(found.count(word), word) for word in ("noisier", "less noisy")]
        said = ", ".join(f"{word} in {n} of {len(found)}" for n, word in counts if n)
        yes, no = counts[0][0], counts[1][0]
        word = "yes" if yes and not no else "no" if no and not yes else "mixed" if yes else ""
        answers.append(f"**{word or 'not decided'}** {name}" + (f" ({said})" if said else ""))
    return ", ".join(answers)


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
    arms = coverage_report.text_table(measured)
    arms[0] = [
        "Task",
        "Arm",
        "Members",
        "Threshold",
        "Keep rate",
        "Entropy",
        "State coverage",
        "Final return",
    ]
    return joined(
        (
            f"# {TITLES['dial']}",
            WHY["dial"],
            "`sauna study dial`: 4 seeds per arm, 10^6 env steps. The entropy is the mean over "
            "training, in nats. The return is the training return of the last 100 episodes.",
            markdown(correlations),
            "Rank correlation of each quantity with the threshold, over the members of arms with a "
            "constant threshold. The p value is corrected by Holm's method for the three quantities.",
            "![State coverage against the threshold](figures/dial_coverage.png)",
            "*State coverage: the entropy of the visited observations, by nearest neighbours, in one "
            "scale for all arms. Point: mean of the members. Band: 95% interval.*",
            "## Is it the threshold, or only fewer updates?",
            "A higher threshold keeps fewer steps, so it also learns from fewer. The matched random "
            "control drops as many steps at random.",
            markdown(controls),
            "Threshold minus random control, mean over pairs with the same drop rates, 95% interval. "
            "*Differs in* names the quantities whose interval leaves out 0. Nothing corrects their "
            "number.",
            folded(
                "All arms",
                markdown([arms[0], *([r[0], shown_label(r[1]), *r[2:]] for r in arms[1:])]),
            ),
        )
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
            estimate = coverage_report.beside_coin(arm, control, key)
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
    pairs += [
        [
            pair.label,
            pair.baseline,
            str(pair.seeds),
            str(pair.gained),
            str(pair.lost),
            f"{pair.p:.3f}",
        ]
        for pair in posture_report.pairs(measured)
        if pair.seeds
    ]
    return joined(
        (
            f"# {TITLES['fig5']}",
            WHY["fig5"],
            "`sauna study fig5`: HalfCheetah-v5, 30 seeds per arm, 10^6 env steps. The finished policy "
            "plays five episodes with sampled actions and a frozen normaliser.",
            markdown([head, *rows]),
            "A seed is on its feet if the cosine of the torso's pitch is positive in more than half of "
            "the states. *Between*: upright in 10% to 90% of the states. The interval is Wilson's.",
            markdown(pairs),
            f"Seeds are paired: both arms of a pair begin with the same weights and resets. The test "
            f"is McNemar's exact test. The answer: {posture_answer(measured)}.",
            "![Frames of one pair of seeds](figures/fig5_stills.png)" if stills else "",
            "*One pair, chosen for its contrast: the first seed of which only `sauna 0.8` is on its "
            "feet.*"
            if stills
            else "",
        )
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
