"""The pages of `docs/results/`, made from the result files alone.

Every page begins with a table and one figure. Then come the decided comparisons. Everything else
is folded, task by task.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from claims import HEADER, Count, claims_rows, count, short_answer, told

from sauna.experiments.measure import coverage_report, noise_report, posture_report
from sauna.experiments.report.numbers import digits_of, digits_of_tasks, interval, number
from sauna.experiments.statistics import ALPHA, holm
from sauna.experiments.study.spec import load_spec
from sauna.experiments.study.tables import PAPER, unversioned

ROOT = Path(__file__).parent.parent
STUDIES = ("fig3", "cheetah30", "release", "a2c", "minatar", "pong")
CLAIMED = {  # the studies that the claims are judged by, and how the summary calls their tasks
    "fig3": "MuJoCo tasks",
    "cheetah30": "HalfCheetah with 30 seeds",
    "release": "tasks with the authors' settings",
    "minatar": "MinAtar games",
}
MEASURED = {"noise": noise_report, "dial": coverage_report, "fig5": posture_report}
FILES = {"dial": "threshold_sweep", "fig5": "posture"}  # a page's name where it is not the study's
DECIDED = ("better", "worse")

TITLES = {
    "fig3": "Six MuJoCo tasks, every arm",
    "cheetah30": "HalfCheetah with 30 seeds",
    "release": "The authors' training settings",
    "a2c": "A2C instead of PPO",
    "minatar": "Four MinAtar games",
    "pong": "Pong, one seed",
    "noise": "Are the dropped steps noisier?",
    "dial": "Threshold sweep: exploration against return",
    "fig5": "HalfCheetah: on its feet or on its back",
}
WHY = {
    "fig3": "The paper's Table 1 and its Figures 2 and 3, with two controls that the paper lacks: "
    "the head without the filter, and a matched random control.",
    "cheetah30": "The returns of HalfCheetah have two modes. Six seeds cannot tell them apart.",
    "release": "The authors' run script uses 15 epochs and a constant learning rate.",
    "a2c": "Does the effect of the filter depend on the algorithm?",
    "minatar": "The paper has no MinAtar games. At threshold 0.3 the filter drops a few percent "
    "here, so this study uses 0.8.",
    "pong": "One seed is no comparison. It shows how far a million env steps go on Atari.",
    "noise": "The paper says that the dropped samples are noisy. The policy gradient of dropped "
    "steps was measured at five checkpoints of each seed.",
    "dial": "The paper says that the threshold trades exploration for exploitation. Thresholds "
    "from 0 to 1.5 were trained, and two random controls.",
    "fig5": "The paper says that PPO often slides on its back, and SAUNA does not (section 4.4).",
}
# How a label of a result file is shown.
LABELS = {
    "coin like 0.8": "random control of 0.8",
    "coin like 1": "random control of 1",
    "keeps 3 in 4": "keep rate 0.75",
    "keeps 1 in 2": "keep rate 0.5",
}
# PPO's published means for 10^6 steps, for orientation: the paper's Table 1 and baselines on v2
# tasks, CleanRL on v4 tasks.
PUBLISHED = {
    "HalfCheetah-v5": ("2277", "1669", "1443"),
    "Hopper-v5": ("2106", "2316", "2383"),
    "InvertedDoublePendulum-v5": ("6100", "7103", "-"),
    "InvertedPendulum-v5": ("532", "809", "963"),
    "Reacher-v5": ("-7.5", "-6.7", "-"),
    "Swimmer-v5": ("99.5", "111", "-"),
}
# The summary's rows: what it says, the number of the claim, the arm that is judged.
CLAIM_ROWS = (
    ("SAUNA as the paper states it scores higher than PPO", 0, "sauna-paper"),
    ("SAUNA as the authors' code does it scores higher than PPO", 0, "sauna-reference"),
    ("The same with the budget in kept steps, as in their code", 0, "sauna-reference, kept steps"),
    ("SAUNA corrected (threshold 0.3) scores higher than PPO", 0, "sauna"),
    ("SAUNA at threshold 0.8, which drops more, scores higher than PPO", 0, "sauna 0.8"),
    ("SAUNA at threshold 0.8 learns sooner (AUC)", 1, "sauna 0.8"),
    ("Dropping steps helps, beyond the head trained beside it", 2, "sauna 0.8"),
    ("The head helps even if nothing is dropped", 3, "vex-head"),
    ("The filter chooses better than a matched random control", 4, "sauna 0.8"),
)


def load(name: str) -> dict[str, Any] | None:
    path = ROOT / "results" / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def page_of(name: str) -> str:
    return f"{FILES.get(name, name)}.md"


def shown_label(label: str) -> str:
    return LABELS.get(label, label)


def listed(sentences: Iterable[str]) -> str:
    return "\n".join(f"- {text}" for text in sentences)


def markdown(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def folded(title: str, text: str) -> str:
    """`text` behind a line to click on; GitHub and the site both show it."""
    return f'<details markdown="1"><summary>{title}</summary>\n\n{text}\n\n</details>'


def joined(parts: Iterable[str]) -> str:
    return "\n\n".join(part for part in parts if part) + "\n"


# The summary of all studies


def findings(prefix: str) -> str:
    """One table: what the paper says, a short answer, and the pages behind it.

    Args:
      prefix: path from the page that shows the table to `docs/results/`.
    """
    rows = [["Claim", "Answer", "Pages"]]
    for text, claim, label in CLAIM_ROWS:
        counts: dict[str, Count] = {}
        pages = []
        for name, tasks in CLAIMED.items():
            found = count(results, claim, label) if (results := load(name)) else None
            if found:
                counts[tasks] = found
                pages.append(_link(name, prefix))
        if counts:
            rows.append([f"{text} (`{label}`)", short_answer(counts), ", ".join(pages)])
    said: tuple[tuple[str, str, Callable[[Mapping[str, Any]], str]], ...] = (
        ("The dropped samples are noisier", "noise", noise_answer),
        ("The threshold trades exploration for exploitation", "dial", sweep_answer),
        ("HalfCheetah runs on its feet more often", "fig5", posture_answer),
    )
    for text, name, answer in said:
        if measured := load(name):
            rows.append([text, answer(measured), _link(name, prefix)])
    return markdown(rows)


def _link(name: str, prefix: str) -> str:
    return f"[{FILES.get(name, name).replace('_', ' ')}]({prefix}{page_of(name)})"


def index(covered: float) -> str:
    """`docs/results/index.md`."""
    return joined((
        "# Results",
        "Does SAUNA's filter help PPO? The table answers claim by claim. Each page begins with a "
        "table and a figure.",
        findings(""),
        "*Better* and *worse* mean a decided comparison of two arms: the exact test rejects after "
        "correction, and the interval leaves out one half "
        "([how](../concepts/statistics.md)). *Not decided* is no evidence of equality.",
        markdown([["Study", "Tasks", "Seeds", "Env steps", "Command"], *map(_scope, _all())]),
        "## How to read the numbers",
        listed((
            "A return is a **training return**: actions are sampled, and the mean is over the last "
            "100 episodes. No number here is a deterministic evaluation.",
            "The budget counts every env step, also the dropped ones. The label says so if an arm "
            "differs.",
            "**IQM** is the mean of the middle half of the seeds. Its interval is a bootstrap, "
            f"which is too narrow with six seeds: it holds the truth {covered:.0%} of the time "
            "(`python results/intervals.py`). No verdict uses it.",
            "The paper's numbers are of version 2 of the tasks and of kept steps. Compare arms "
            "within a table, not across.",
            "A family of tests is corrected by Holm's method. Nothing is corrected for the number "
            "of tables.",
        )),
        _revisions(),
        "`python results/make.py` makes these pages from the files in `results/`. "
        "`make results` trains what is missing first, which takes many hours.",
        "## The claims, study by study",
        *_claims(),
    ))  # fmt: skip


def _all() -> list[str]:
    return [name for name in (*STUDIES, *MEASURED) if load(name)]


def _scope(name: str) -> list[str]:
    spec = load_spec(name)
    seeds = {len(arm.seeds) for arm in spec.arms}
    tasks = list(dict.fromkeys(task for arm in spec.arms for task in arm.tasks))
    steps = load(name)["cells"][0].get("steps") or load(name)["settings"]["steps"]
    return [
        f"[{TITLES[name]}]({page_of(name)})",
        tasks[0] if len(tasks) == 1 else str(len(tasks)),
        str(max(seeds)),
        f"{int(steps):,}",
        f"`sauna study {name}`",
    ]


def _revisions() -> str:
    """Whether runs of several revisions of the package can be compared."""
    path = ROOT / "results" / "revisions.json"
    if not path.exists():
        return ""
    stored = json.loads(path.read_text())
    equal = sum(len(run["equal"]) for run in stored["runs"])
    number_of = sum(len(run["env_steps"]) for run in stored["runs"])
    return folded(
        "Several revisions of the package trained these runs",
        "Two runs of every study, arm and revision were begun again by revision "
        f"{stored['now']} (`{stored['command']}`). Up to the second point of the curves, {equal} "
        f"of {number_of} gave the same numbers. Random controls were left out, because they "
        "need whole runs of others.",
    )


def _claims() -> list[str]:
    about = (
        "Each row is a family of exact tests, one for each task, corrected by Holm's method. "
        "*By the interval* describes the tasks together: the 95% interval of the probability of "
        "improvement leaves out one half. That is no test, and nothing corrects it. A pair of arms "
        "is judged on the tasks that both have finished."
    )
    parts = [about]
    for name in CLAIMED:
        rows = claims_rows(results) if (results := load(name)) else []
        if rows:
            again = [False, *(row[0] == other[0] for row, other in itertools.pairwise(rows))]
            shown = [["", *row[1:]] if same else row for row, same in zip(rows, again, strict=True)]
            text = f"{listed(told(rows))}\n\n{markdown([HEADER, *shown])}"
            parts.append(folded(TITLES[name], text))
    return parts


# A study that compares returns


def study_page(name: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """A study's page: table, figure, decided comparisons; the rest is folded."""
    verdicts = [*summary["verdicts"], *summary["filtering"]]
    return joined((
        f"# {TITLES[name]}",
        WHY[name],
        _facts(results) + (f" {pong_text(results)}" if name == "pong" else ""),
        overview(results, summary),
        _legend(summary),
        f"![Learning curves: {TITLES[name]}](figures/{name}.svg)",
        "*Training return, mean of the last 100 episodes. Line: mean of the seeds. Band: 95% "
        "interval of the mean.*" if len(summary["table"]) > 1 else "",
        _decided(verdicts),
        _missing(name, results),
        _same_runs(results),
        *(_of_task(task, name, results, summary) for task in summary["curves"]
          if len(summary["table"]) > 1),
    ))  # fmt: skip


def _facts(results: Mapping[str, Any]) -> str:
    settings = results["settings"]
    preset = results["cells"][0]["preset"]
    seeds = f"{settings['seeds']} seed" + ("s" if settings["seeds"] != 1 else "")
    return (
        f"`{results['command']}`: {seeds} per arm, {int(settings['steps']):,} env steps each, "
        f"preset `{preset}`. Returns are training returns (sampled actions, last 100 episodes)."
    )


def overview(results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Arms against tasks: the IQM of the final return, marked where a comparison is decided."""
    table, digits = summary["table"], digits_of_tasks(summary["table"])
    tasks, labels = list(digits), list(dict.fromkeys(row["label"] for row in table))
    kinds = {(v["task"], v["label"]): v["kind"] for v in summary["verdicts"]}
    cells = {(row["task"], row["label"]): row for row in table}
    baselines = {row["label"]: row["baseline"] for row in table}
    head = ["Arm", *(unversioned(t).removeprefix("gymnax/").removesuffix("-MinAtar") for t in tasks),
            "Keep rate", "Compared with"]  # fmt: skip
    rows = [head]
    for label in labels:
        shown = []
        for task in tasks:
            cell, kind = cells.get((task, label)), kinds.get((task, label))
            text = number(cell["final_iqm"][0], digits[task]) if cell else "-"
            shown.append(f"**{text} {kind}**" if kind in DECIDED else text)
        rates = [c["keep_rate"] for t in tasks if (c := cells.get((t, label))) and c["keep_rate"]]
        baseline = baselines[label]
        rows.append([
            f"`{label}`",
            *shown,
            _range(rates),
            baseline or "-",
        ])  # fmt: skip
    return markdown(rows)


def _legend(summary: Mapping[str, Any]) -> str:
    if len(summary["table"]) < 2:
        return ""
    ends = any(row["label"] == "ppo, limits end" for row in summary["table"])
    return (
        "IQM of the seeds' final returns. **better** and **worse** mark decided comparisons with "
        "the arm in the last column. A keep rate of 1.000 means that nothing was dropped."
        + " In `ppo, limits end` a time limit counts as the end of the episode, as in the authors' "
        "code." * ends
    )


def _range(values: list[float]) -> str:
    if not values:
        return "-"
    low, high = f"{min(values):.3f}", f"{max(values):.3f}"
    return low if low == high else f"{low} to {high}"


def _decided(verdicts: list[dict[str, Any]]) -> str:
    if not verdicts:
        return ""
    decided = [verdict["text"] for verdict in verdicts if verdict["kind"] in DECIDED]
    head = f"## Decided comparisons: {len(decided)} of {len(verdicts)}"
    return f"{head}\n\n{listed(decided)}" if decided else f"{head}\n\nNone is decided."


def _of_task(task: str, name: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Every arm and every comparison of one task, folded."""
    verdicts = [v["text"] for v in summary["verdicts"] if v["task"] == task]
    controls = [v["text"] for v in summary["filtering"] if v["task"] == task]
    parts = [arms_table(task, name, results, summary)]
    if verdicts:
        parts += ["Against the baseline:", listed(verdicts)]
    if controls:
        parts += ["Ablation of the selection rule (against the head-only ablation and the matched "
                  "random control):", listed(controls)]  # fmt: skip
    return folded(f"{task}: all arms and comparisons", "\n\n".join(parts))


def arms_table(task: str, name: str, results: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """Every arm of one task, the paper's numbers beside it."""
    wanted = {arm.label: len(arm.seeds) for arm in load_spec(name).arms}
    digits = digits_of_tasks(summary["table"])[task]
    paper = results["settings"].get("algorithm", "ppo") == "ppo" and unversioned(task) in PAPER
    head = ["Arm", "Seeds", "Final return, IQM [95%]", "Mean ± std", "Keep rate",
            "Probability of improvement [95%]"]  # fmt: skip
    rows = [[*head, "Paper (v2)"] if paper else head]
    for row in summary["table"]:
        if row["task"] != task:
            continue
        label = row["label"]
        failed = f", {row['failed']} failed" if row["failed"] else ""
        mean, std = (number(row[key], digits) for key in ("final_mean", "final_std"))
        cells = [
            shown_label(label),
            f"{row['seeds']} of {wanted.get(label, row['seeds'])}{failed}",
            interval(row["final_iqm"], digits),
            f"{mean} ± {std}",
            number(row["keep_rate"], 3),
            interval(row["improvement"], 2),
        ]
        rows.append([*cells, _paper(task, label)] if paper else cells)
    return markdown(rows)


def _paper(task: str, label: str) -> str:
    """The paper's Table 1, beside its PPO and beside the variants of its method."""
    known = PAPER.get(unversioned(task), {})
    column = "PPO" if label.startswith("ppo") else "SAUNA" if label.startswith("sauna") else ""
    return f"{known[column][0]} ± {known[column][1]}" if column in known else "-"


def _same_runs(results: Mapping[str, Any]) -> str:
    """Names the arms whose runs are the same as far as both go: evidence that counts once."""
    said = []
    for task in dict.fromkeys(cell["task"] for cell in results["cells"]):
        cells = [cell for cell in results["cells"] if cell["task"] == task]
        said += [
            f"On {task} `{a['label']}` and `{b['label']}` are the same runs up to the point where "
            f"one of them stops. Count their evidence once."
            for a, b in itertools.combinations(cells, 2)
            if _agree(a, b)
        ]
    return listed(said)


def _agree(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    curves = [
        {
            m["seed"]: dict(zip(m["curve"]["env_steps"], m["curve"]["return_mean"], strict=True))
            for m in cell["members"]
        }
        for cell in (a, b)
    ]
    if not curves[0] or set(curves[0]) != set(curves[1]):
        return False
    for seed, one in curves[0].items():
        other = curves[1][seed]
        both = [step for step in set(one) & set(other) if one[step] is not None]
        if len(both) < 3 or any(one[step] != other[step] for step in both):
            return False
    return True


def _missing(name: str, results: Mapping[str, Any]) -> str:
    """Names what of a study is not trained yet."""
    done = {
        (c["task"], c["label"]): sum(m["status"] == "complete" for m in c["members"])
        for c in results["cells"]
    }
    missing = []
    for arm in load_spec(name).arms:
        tasks = [t for t in arm.tasks if done.get((t, arm.label), 0) < len(arm.seeds)]
        if tasks:
            every = len(tasks) == len(arm.tasks) > 1
            missing.append(f"{arm.label} ({'every task' if every else ', '.join(tasks)})")
    return f"Not trained to the end yet: {'; '.join(missing)}." if missing else ""


def ppo_table(results: Mapping[str, Any]) -> str:
    """PPO's final training returns beside published numbers."""
    rows = [["Task", "PPO here, mean ± std", "Seeds, lowest to highest", "Paper (v2)",
             "baselines (v2)", "CleanRL (v4)"]]  # fmt: skip
    for cell in results["cells"]:
        if cell["label"] not in ("ppo", "ppo, limits end"):
            continue
        complete = [m for m in cell["members"] if m["status"] == "complete"]
        final = sorted(m["final_return"] for m in complete if m["final_return"] is not None)
        if not final:
            continue
        mean, std = float(np.mean(final)), float(np.std(final, ddof=1))
        digits = digits_of([mean])
        task = cell["task"] + (", limits end" if cell["label"] != "ppo" else "")
        seeds = ", ".join(number(x, digits) for x in final)
        rows.append([task, f"{number(mean, digits)} ± {number(std, digits)}", seeds,
                     *PUBLISHED[cell["task"]]])  # fmt: skip
    return markdown(rows)


def ppo_page(results: Mapping[str, Any]) -> str:
    """`docs/results/ppo.md`."""
    return joined((
        "# PPO beside published numbers",
        "Preset `mujoco`, 10^6 env steps, 6 seeds, from the study `fig3`. The number is the mean "
        "training return of the last 100 episodes.",
        ppo_table(results),
        "The last three columns are published means on older versions of the tasks, for "
        "orientation only: their metrics and versions differ. *Limits end*: a time limit counts as "
        "the end of the episode, as in OpenAI baselines.",
    ))  # fmt: skip


# Studies that measure checkpoints


def noise_page(measured: Mapping[str, Any]) -> str:
    """Signal and noise of the policy gradient, kept against dropped against random."""
    rows = [["Task", "Arm", "Keep rate", "Variance of dropped steps, control = 1",
             "Signal to noise, dropped - control", "By variance", "By signal to noise"]]  # fmt: skip
    full = noise_report.text_table(measured)
    for row in full[1:]:
        by_variance, by_signal = _noise_kinds(row)
        rows.append([row[0], shown_label(row[1]), row[3], row[14], row[7], by_variance, by_signal])
    return joined((
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
        + _listed_and(f"{row[12].split(' ')[0]} ({row[0]}, {shown_label(row[1])})"
                      for row in full[1:])
        + " times the variance of the control's.",
        folded("All measurements", _full_noise(full)),
        folded("How it is measured", listed((
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
        ))),
    ))  # fmt: skip


def _listed_and(parts: Iterable[str]) -> str:
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def _full_noise(full: list[list[str]]) -> str:
    head = ["Task", "Arm", "Members", "Keep rate", "SNR kept", "SNR control", "SNR dropped",
            "SNR dropped - control", "SNR dropped - shifted", "SNR per env step, kept - control",
            "Cosine dropped - control", "Alignment of kept, checkpoints",
            "Variance, kept / control", "Raw variance, kept / control",
            "Raw variance, dropped / control", "Raw variance, dropped / shifted"]  # fmt: skip
    rows = zip(*[head, *([row[0], shown_label(row[1]), *row[2:]] for row in full[1:])], strict=True)
    turned = [list(row) for row in rows]
    return markdown([turned[0], *turned[1:]])


def _noise_kinds(row: list[str]) -> tuple[str, str]:
    """What the intervals of a row say of the dropped steps: by variance, by signal to noise."""
    return _kind(row[14], 1.0, ("noisier", "less noisy")), _kind(row[7], 0.0,
                                                                ("less noisy", "noisier"))  # fmt: skip


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
    controls = [["Task", "Threshold", "Entropy", "State coverage", "Final return", "Pairs",
                 "Differs in"]]  # fmt: skip
    for task in coverage_report.tasks_of(measured):
        marks = coverage_report.marks(measured, task)
        correlations.append([task, *_correlations(marks)])
        controls += [[task, *row] for row in _beside_controls(marks)]
    arms = coverage_report.text_table(measured)
    arms[0] = ["Task", "Arm", "Members", "Threshold", "Keep rate", "Entropy", "State coverage",
               "Final return"]  # fmt: skip
    return joined((
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
        folded("All arms", markdown([arms[0], *([r[0], shown_label(r[1]), *r[2:]]
                                                for r in arms[1:])])),
    ))  # fmt: skip


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
    head = ["Arm", "Seeds", "On its feet [95%]", "Between", "Return on its feet",
            "Return on its back"]  # fmt: skip
    pairs = [["Arm", "Against", "Pairs", "Only the arm on its feet", "Only the other", "p"]]
    pairs += [[pair.label, pair.baseline, str(pair.seeds), str(pair.gained), str(pair.lost),
               f"{pair.p:.3f}"] for pair in posture_report.pairs(measured) if pair.seeds]  # fmt: skip
    return joined((
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
        "feet.*" if stills else "",
    ))  # fmt: skip


def posture_answer(measured: Mapping[str, Any]) -> str:
    feet = {cell["label"]: posture_report.postures(cell) for cell in measured["cells"]}
    pair = next(posture_report.pairs(measured), None)
    if pair is None:
        return "**not decided**"
    counts = [f"{sum(one.on_feet for one in feet[label])} of {len(feet[label])} seeds ({label})"
              for label in (pair.label, pair.baseline)]  # fmt: skip
    word = "not decided"
    if pair.p < ALPHA:
        word = "yes" if pair.gained > pair.lost else "no"
    return f"**{word}**: {counts[0]} against {counts[1]}"


def pong_text(results: Mapping[str, Any]) -> str:
    """How the one seed of `pong` went, and its curve."""
    member = results["cells"][0]["members"][0]
    steps, score = (member["curve"][key] for key in ("env_steps", "return_mean"))
    known = [(n, x) for n, x in zip(steps, score, strict=True) if x is not None]
    if member["status"] != "complete" or not known:
        return f"The run failed (`{results['command']}`)."
    (early, low), (late, high) = known[0], known[-1]
    return (
        f"One seed of PPO (`{results['command']}`): the mean training score of the last 100 games "
        f"rises from {low:.1f} after {early:,} env steps to {high:.1f} after {late:,}."
    )
