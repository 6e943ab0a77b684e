"""The studies whose results are in the repository, and how their pages are put together."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sauna.config.presets import RANDOM_CONTROL
from sauna.experiments.measure import coverage_report, noise_report, posture_report
from sauna.experiments.study.spec import FORMER_STUDIES, load_spec

ROOT = Path(__file__).parent.parent
STUDIES = (
    "fig3",
    "cheetah30",
    "release",
    "a2c",
    "minatar",
    "pong",
    "actions-mountain-car",
    "actions-bipedal",
    "memory",
    "invalid-actions",
    "picture-and-number",
    "late-collapse",
    "vex-head",
    "fig4a-cpu",
    "fig4b-cpu",
    "fig4c-cpu",
)
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
    "memory": "Two tasks that need a memory",
    "pong": "Pong, one seed",
    "actions-mountain-car": "Distributions of actions on MountainCarContinuous",
    "actions-bipedal": "Distributions of actions on BipedalWalker",
    "invalid-actions": "Masks of invalid actions",
    "picture-and-number": "A picture and a number together",
    "late-collapse": "Late collapse on InvertedDoublePendulum",
    "vex-head": "The Vex head alone, 30 fresh seeds",
    "fig4a-cpu": "HumanoidFlagrunHarder: 64-64, 32 actors",
    "fig4b-cpu": "HumanoidFlagrunHarder: 512-256-128, 32 actors",
    "fig4c-cpu": "HumanoidFlagrunHarder: 512-256-128, 128 actors",
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
    "actions-mountain-car": "The goal is found by chance alone, so that the return depends on how "
    "actions are drawn. All else is the preset, whose numbers were chosen for the Gaussian.",
    "actions-bipedal": "A robot that walks, in a short training: 8 environments and rollouts of "
    "512 steps, else the preset, whose numbers are RL Zoo's. `gsde` keeps its noise for 4 steps.",
    "memory": "A cue has to be recalled nine env steps later, and a pendulum swings up whose "
    "velocity is not observed. `mlp` has no memory; `lstm` and `gru` have a cell of width 64 "
    "after each trunk and learn from sequences of 32 env steps.",
    "invalid-actions": "A knight's tour on a board of 5 x 5 squares: 25 actions, at most 8 of them "
    "valid, and 1 for each new square. Without masks an invalid action ends the episode.",
    "picture-and-number": "The right answer follows from a picture and a number together. Who sees "
    "one of them alone gets 4 of 16 by chance.",
    "pong": "One seed is no comparison. It shows how far a million env steps go on Atari.",
    "late-collapse": "Some seeds of PPO lose late what they had learned. Do they update too often? "
    "`target-kl` ends an update early (limit 0.01), and one arm takes half of the epochs.",
    "vex-head": "The head helped on two tasks with six seeds, undecided. Thirty seeds that no "
    "other study used decide it.",
    "fig4a-cpu": "The paper's Figure 4a in a fifth of its env steps. The paper says that SAUNA "
    "learns faster and scores higher there (section 4.3).",
    "fig4b-cpu": "The paper's Figure 4b in a tenth of its env steps. The paper says that SAUNA is "
    "faster at the beginning, and that PPO reaches it later.",
    "fig4c-cpu": "The paper's Figure 4c in a tenth of its env steps. The paper says that SAUNA "
    "learns faster and scores higher there.",
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


@functools.cache
def load(name: str) -> dict[str, Any] | None:
    """`results/NAME.json`, which nobody changes in memory; None if there is none."""
    path = ROOT / "results" / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def page_of(name: str) -> str:
    return f"{FILES.get(name, name)}.md"


def shown_label(label: str) -> str:
    return LABELS.get(label, label)


def command_of(name: str) -> str:
    """The command that trains a study today."""
    return f"sauna study {FORMER_STUDIES.get(name, name)}"


def former_controls(cells: Iterable[Mapping[str, Any]], studies: Iterable[str]) -> str:
    """Says which random controls are of an earlier form of these studies, and what is trained now.

    Empty if there is none.
    """
    arms = {cell["label"]: cell["rates_of"] for cell in cells if cell.get("rates_of")}
    if not arms:
        return ""
    those = [f"`{shown_label(label)}` those of `{shown_label(arms[label])}`" for label in arms]
    every = [arm for name in studies for arm in load_spec(name).arms]
    now = dict.fromkeys(f"`{arm.label}`" for arm in every if arm.arm.endswith(RANDOM_CONTROL))
    return (
        "Random controls in these tables are of an earlier form of the study. They repeated the "
        f"drop rates of other runs, seed by seed: {', '.join(those)}. Today the command trains "
        f"{' and '.join(now)} instead. Such a control needs no other run: it asks the filter how "
        "many steps it would keep, and keeps as many at random."
    )


def listed(sentences: Iterable[str]) -> str:
    return "\n".join(f"- {text}" for text in sentences)


def markdown(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def folded(title: str, text: str) -> str:
    """`text` behind a line to click on; GitHub and the site both show it."""
    return f'<details markdown="1"><summary>{title}</summary>\n\n{text}\n\n</details>'


def page(template: str, **parts: str) -> str:
    """`templates/TEMPLATE.md` with its `{parts}` filled in; an empty part leaves no gap."""
    text = (Path(__file__).parent / "templates" / f"{template}.md").read_text().format(**parts)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"
