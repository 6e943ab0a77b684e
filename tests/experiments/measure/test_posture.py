"""On its feet or on its back: the angle, the shares, the pairs, and whose runs are looked at."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from PIL import Image

from command_line import sauna
from sauna.experiments.measure import posture_report
from sauna.experiments.measure.posture import FRAMES, SIDE, clearest, pitch
from sauna.experiments.study.spec import load_spec, read_spec
from sauna.experiments.study.units import seeds_per_unit, units_of
from sauna.system.errors import BadInput

SPEC = {
    "name": "t",
    "measure": "posture",
    "tasks": ["HalfCheetah-v5"],
    "seeds": 6,
    "arms": [{"label": "ppo"}, {"label": "sauna"}],
}


def test_the_pitch_is_the_torsos_in_the_world() -> None:
    """Its own upright axis, as MuJoCo turns it, points up where the cosine is positive."""
    env = gymnasium.make("HalfCheetah-v5").unwrapped
    env.reset(seed=0)
    velocity = np.zeros_like(env.data.qvel)
    for angle in (0.0, 0.5, -1.0, 2.0, math.pi, 5.0, 2 * math.pi + 0.3, -9.0):
        position = env.init_qpos.copy()
        position[2] = angle
        env.set_state(position, velocity)
        up = env.data.body("torso").xmat.reshape(3, 3)[2, 2]
        assert abs(math.cos(pitch(env)) - up) < 1e-9
        assert -math.pi <= pitch(env) <= math.pi
        assert abs(math.remainder(pitch(env) - angle, math.tau)) < 1e-9
    env.close()


def test_its_runs_are_those_of_the_thirty_seeds() -> None:
    ours, theirs = load_spec("fig5"), load_spec("cheetah30")
    assert len(ours.arms) == 2 and all(len(arm.seeds) >= 20 for arm in ours.arms)
    for cores in (1, 2, 8, 16, 20):
        sizes = [seeds_per_unit(spec, cores) for spec in (ours, theirs)]
        names = [
            {unit.name for unit in units_of(spec, size)}
            for spec, size in zip((ours, theirs), sizes, strict=True)
        ]
        assert names[0] < names[1], cores


@pytest.mark.parametrize(
    "change, message",
    [
        ({"tasks": ["Hopper-v5"]}, "is of HalfCheetah, not of Hopper-v5"),
        ({"measure": "postur"}, "did you mean 'posture'"),
    ],
)
def test_what_has_no_posture_is_refused(change: dict, message: str) -> None:
    assert read_spec(SPEC).measure == "posture"
    with pytest.raises(BadInput, match=message):
        read_spec({**SPEC, **change})


def cell(label: str, upright: list[float], baseline: str | None, seeds: int = 30) -> dict[str, Any]:
    """Measured members 0, 1, ...; who is upright earns 3000, who is not 1000."""
    members = [
        {
            "seed": seed,
            "points": [
                {
                    "upright": share,
                    "frames": [*FRAMES],
                    "picture": f"{label}-{seed}.png",
                    "episodes": [{"return": 1000.0 + 2000.0 * (share > 0.5), "upright": share}] * 2,
                }
            ],
            "curve": {"env_steps": [10, 20], "explained_variance": [None, 0.1 * seed]},
        }
        for seed, share in enumerate(upright)
    ]
    return {
        "task": "HalfCheetah-v5",
        "label": label,
        "arm": label,
        "baseline": baseline,
        "seeds": seeds,
        "members": members,
    }


def measured(base: list[float], own: list[float], seeds: int = 30) -> dict[str, Any]:
    return {"cells": [cell("ppo", base, None, seeds), cell("sauna", own, "ppo", seeds)]}


def test_shares_and_pairs_by_hand() -> None:
    """Of 20 pairs: 3 upright in both, 9 only in the arm, 2 only in the baseline."""
    base = [1.0] * 3 + [0.0] * 9 + [0.9] * 2 + [0.2] * 6
    own = [1.0] * 3 + [0.7] * 9 + [0.0] * 2 + [0.5] * 6
    found = measured(base, own, 20)
    value, low, high = posture_report.share(posture_report.postures(found["cells"][0]))
    z, n, p = 1.959964, 20, 5 / 20
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    np.testing.assert_allclose((value, low, high), (p, middle - half, middle + half), rtol=1e-6)
    [pair] = posture_report.pairs(found)
    assert pair[:5] == ("sauna", "ppo", 20, 9, 2)
    assert math.isclose(pair.p, 2 * (1 + 11 + 55) / 2**11)
    said = posture_report.verdicts(found)
    assert said[0] == "ppo: on its feet in 5 of 20 seeds (25% [11%, 47%])."
    assert "not decided (20 pairs; only sauna on its feet in 9" in said[2]


def test_a_difference_is_told_and_equal_ones_are_not() -> None:
    [pair] = posture_report.pairs(measured([0.0] * 9, [1.0] * 9))
    assert math.isclose(pair.p, 2 / 2**9)
    assert (
        "sauna against ppo, seed by seed: more seeds on their feet"
        in posture_report.verdicts(measured([0.0] * 9, [1.0] * 9))[2]
    )
    assert "fewer seeds on their feet" in posture_report.verdicts(measured([1.0] * 9, [0.0] * 9))[2]
    same = [1.0, 0.0] * 5
    assert next(iter(posture_report.pairs(measured(same, same)))).p == 1.0
    assert next(iter(posture_report.pairs(measured(same, same[::-1])))).p == 1.0


def test_the_episode_shown_is_in_the_members_posture() -> None:
    assert clearest([0.1, 0.9, 1.0], 0.67) == 2
    assert clearest([0.9, 0.5, 0.0, 0.0], 0.35) == 2


def test_what_is_not_measured_yet_is_told() -> None:
    assert posture_report.verdicts({"cells": []}) == [
        "No seed is trained to its end and measured yet."
    ]
    alone = {"cells": [cell("ppo", [1.0, 0.0], None)]}
    assert posture_report.verdicts(alone) == [
        "ppo: on its feet in 1 of 2 seeds, of 30 in all, (50% [9%, 91%])."
    ]
    part = measured([0.0, 0.0, 1.0], [1.0])
    [pair] = posture_report.pairs(part)
    assert (pair.seeds, pair.gained, pair.lost) == (1, 1, 0)


def test_the_strip_is_of_a_pair_that_differs(tmp_path: Path) -> None:
    found = measured([0.9, 0.8, 0.1, 0.1], [0.9, 0.1, 0.2, 0.9])
    assert [one.seed for _, one in posture_report.shown_pair(found)] == [3, 3]
    assert [one.seed for _, one in posture_report.shown_pair(measured([0.9, 0.1], [0.9, 0.1]))] == [
        0,
        0,
    ]
    (tmp_path / "posture").mkdir()
    for label, level in (("ppo", 0), ("sauna", 200)):
        strip = Image.new("RGB", (SIDE * len(FRAMES), SIDE), (level, 50, 0))
        strip.save(tmp_path / "posture" / f"{label}-3.png")
    assert posture_report.chosen(found) == (
        "Chosen for the contrast: the first seed of which only sauna is on its feet "
        "(1 of 4; only ppo in 1)."
    )
    assert "failing that the first of all" in posture_report.chosen(
        measured([0.9, 0.1], [0.9, 0.1])
    )
    section = posture_report.report(found, tmp_path)
    assert section.image and section.image.png
    assert (
        "Chosen for the contrast" in section.image.caption and "Chosen" in section.plots[0].caption
    )
    picture = Image.open(tmp_path / "figures" / "frames.png")
    assert picture.width > picture.height
    drawn = np.asarray(picture.convert("RGB"))
    upper, lower = np.array_split(drawn, 2)
    assert (upper == (0, 50, 0)).all(-1).any() and (lower == (200, 50, 0)).all(-1).any()
    assert not (upper == (200, 50, 0)).all(-1).any()
    [plot] = section.plots
    assert [(line.label, line.y) for line in plot.panels[0].lines] == [
        ("ppo", [None, 0.1 * 3]),
        ("sauna", [None, 0.1 * 3]),
    ]
    assert "ppo seed 3, on its back (return 1,000), sauna seed 3, on its feet" in section.image.alt
    for one in found["cells"]:
        for member in one["members"]:
            member["points"][0] |= {"frames": [], "not_drawn": "no <display>"}
    assert posture_report.report(found, tmp_path).image == (None, "", "No frames: no <display>.")


@pytest.mark.slow
def test_a_study_measures_its_finished_members_once(tmp_path: Path, monkeypatch) -> None:
    text = """
name = "small"
measure = "posture"
tasks = ["HalfCheetah-v5"]
seeds = 2
steps = 256
rollout_steps = 64
hidden = [8]
env_kwargs = {max_episode_steps = 60}
[[arms]]
label = "ppo"
[[arms]]
label = "sauna 0.8"
arm = "sauna"
threshold = 0.8
"""
    (tmp_path / "small.toml").write_text(text)
    monkeypatch.setenv("MUJOCO_GL", "glfw")  # which needs a display
    monkeypatch.delenv("DISPLAY", raising=False)
    command = ("study", "small.toml", "--processes", "1")
    done = sauna(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "measuring posture: 4 members" in done.stdout
    assert "sauna 0.8 against ppo, seed by seed: not decided" in done.stdout
    place = tmp_path / "runs" / "small"
    [*files] = sorted((place / "posture").glob("*.json"))
    stored = [json.loads(file.read_text()) for file in files]
    assert len(stored) == 4
    for one in stored:
        assert one["mode"] == "sampled" and [e["length"] for e in one["episodes"]] == [60] * 5
        states = [61 * e["upright"] for e in one["episodes"]]
        np.testing.assert_allclose(states, np.round(states), atol=1e-9)
        assert math.isclose(one["upright"], sum(states) / 305)
        assert not one["frames"] and one["not_drawn"]
    assert "<p>No frames: " in (place / "report.html").read_text()
    before = [file.stat().st_mtime_ns for file in files]
    again = sauna(*command, cwd=tmp_path)
    assert again.returncode == 0 and "measuring" not in again.stdout
    assert [file.stat().st_mtime_ns for file in files] == before
    assert re.search(r"ppo: on its feet in \d of 2 seeds", again.stdout)
