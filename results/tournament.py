"""How often does a tournament call an arm better that is not? `results/tournament.json`.

    python results/tournament.py      (a few minutes)

Tournaments of `sauna.experiments.sequential` are played on made-up returns whose truth is known:
normal, skewed, bimodal as HalfCheetah's, and capped as CartPole's. In the first kind no arm differs
from the baseline, and every "better" is false. In the second one arm is better by a stated
probability of improvement. Seeds used are those of all arms, as a share of giving every arm all.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sauna.experiments.sequential import DESIGN, LEVEL, tournament

PATH = Path(__file__).resolve().parent / "tournament.json"
ARMS, TOURNAMENTS, MOST = 12, 500, DESIGN[-1].seeds
Draw = Callable[[np.random.Generator, int, float], np.ndarray]


def normal(random: np.random.Generator, number: int, shift: float) -> np.ndarray:
    return random.normal(shift, 1.0, number)


def skewed(random: np.random.Generator, number: int, shift: float) -> np.ndarray:
    return np.exp(random.normal(shift, 1.0, number))


def bimodal(random: np.random.Generator, number: int, shift: float) -> np.ndarray:
    """Most seeds near 1400, some near 2800; a shift moves seeds to the upper mode."""
    upper = random.random(number) < 0.25 + 0.35 * min(shift, 2.0)
    return np.where(upper, 2800.0, 1400.0) + random.normal(0, 80.0, number)


def capped(random: np.random.Generator, number: int, shift: float) -> np.ndarray:
    """Many seeds reach the largest return there is, so that scores tie."""
    return np.minimum(500.0, 470.0 + 40.0 * random.normal(shift, 1.0, number))


KINDS: dict[str, Draw] = {"normal": normal, "skewed": skewed, "bimodal": bimodal, "capped": capped}


def played(kind: Draw, shift: float, seed: int) -> tuple[bool, bool, float]:
    """Whether a false "better" came out; whether the arm that differs was found; seeds used."""
    random = np.random.default_rng([seed, len(str(shift))])
    draw = {"ppo": kind(random, MOST, 0.0)}
    draw |= {f"arm {i}": kind(random, MOST, shift if i == 0 else 0.0) for i in range(ARMS)}
    ended = tournament(draw, "ppo")
    better = {arm for arm, standing in ended.items() if standing.verdict == "better"}
    used = sum(standing.seeds for standing in ended.values()) / (ARMS * MOST)
    true = {"arm 0"} if shift else set()
    return bool(better - true), bool(better & true), used


def main() -> None:
    result = {
        "command": "python results/tournament.py",
        "design": [look._asdict() for look in DESIGN],
        "level": LEVEL,
        "arms": ARMS,
        "tournaments": TOURNAMENTS,
        "cases": [],
    }
    for name, kind in KINDS.items():
        for shift in (0.0, 1.0, 2.0):
            rows = [played(kind, shift, seed) for seed in range(TOURNAMENTS)]
            false, found, used = (float(np.mean(column)) for column in zip(*rows, strict=True))
            case = {"returns": name, "shift": shift, "false_better": false, "seeds_used": used}
            if shift:
                case["found"] = found
            result["cases"].append(case)
            print(case, flush=True)
    PATH.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
