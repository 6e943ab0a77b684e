"""How much of an update's time a rule saves: `results/selection.json`.

    python benchmarks/selection.py [--rounds 5]      (some minutes)

One member's update is timed at the kept shares 1, 0.5, 0.25 and 0.1 (`top-advantage`, mode
`fewer`) beside plain PPO's, in turn, round after round, by CPU time of this process. The bound that
has to hold is `time(k) <= (1.15 k + 0.05) time(PPO)`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sauna.system.jax_setup import configure_jax

configure_jax()

import jax  # noqa: E402

from sauna.algorithm.learner.program import make_learner  # noqa: E402
from sauna.algorithm.learner.update import minibatch_order  # noqa: E402
from sauna.algorithm.policy.policy import make_policy  # noqa: E402
from sauna.algorithm.types import Batch, Hypers, Rollout, member_keys, selection_key  # noqa: E402
from sauna.config.presets import resolve  # noqa: E402
from sauna.config.settings import Config  # noqa: E402
from sauna.envs.spaces import Spaces  # noqa: E402

PATH = Path(__file__).resolve().parent / "results" / "selection.json"
SHARES = (1.0, 0.5, 0.25, 0.1)
CHEETAH = Spaces("vector", (17,), "continuous", (6,), "", "")
PONG = Spaces("image", (84, 84, 4), "discrete", (6,), "", "")
CASES: dict[str, tuple[dict[str, Any], Spaces]] = {
    "MLP 64-64": ({}, CHEETAH),
    "MLP 512-256-128": ({"hidden": "512,256,128"}, CHEETAH),
    "Nature CNN": ({"preset": "atari"}, PONG),
}


def config_of(settings: dict[str, Any], spaces: Spaces, **rule: Any) -> Config:
    import dataclasses

    config = resolve({"env": "none", "arm": "ppo", **settings, **rule})
    network = "nature-cnn" if spaces.observation_kind == "image" else "mlp"
    return dataclasses.replace(config, network=network)


def one_update(
    config: Config, spaces: Spaces, clock_of: Callable[[], float]
) -> Callable[[], float]:
    """A function that runs one update on random samples and returns its seconds by a clock."""
    learner = make_learner(config, make_policy(config, spaces), spaces)
    rng, shape = np.random.default_rng(0), (config.rollout_steps, config.envs)
    keys = member_keys(0)
    normal = lambda *more: rng.normal(size=(*shape, *more)).astype(np.float32)  # noqa: E731
    if spaces.observation_kind == "image":
        observation = rng.integers(0, 256, (*shape, *spaces.observation_shape), np.uint8)
        action = rng.integers(0, spaces.action_sizes[0], (*shape, 1), np.int32)
        log_prob = np.full(shape, -np.log(spaces.action_sizes[0]), np.float32)
    else:
        observation, action = normal(*spaces.observation_shape), normal(spaces.action_width)
        log_prob = (-0.5 * action**2 - 0.5 * np.log(2 * np.pi)).sum(-1)
    no, yes = np.zeros(shape, bool), np.ones(shape, bool)
    rollout = Rollout(
        observation, action, log_prob, normal(), normal(), normal(), normal(), no, no, yes, yes
    )
    values = {name: np.float32(getattr(config, name)) for name in Hypers._fields}
    hypers = Hypers(**values)
    key = selection_key(keys, 0)
    batch: Batch = jax.block_until_ready(learner.make_batch(rollout, hypers, key))
    state = learner.init(keys.init)
    order = minibatch_order(config, 0, 0)

    def call() -> float:
        nonlocal state
        clock = clock_of()
        state, metrics = learner.learn(state, rollout, batch, hypers, order, key)
        jax.block_until_ready(metrics)
        return clock_of() - clock

    call()
    return call


def measure(
    name: str, rounds: int, clock_of: Callable[[], float] = time.process_time
) -> dict[str, Any]:
    settings, spaces = CASES[name]
    calls = {"ppo": one_update(config_of(settings, spaces), spaces, clock_of)}
    for share in SHARES:
        rule = {
            "sampler": "top-advantage",
            "sampler_kwargs": {"share": share},
            "normalize_over": "rollout",
        }
        calls[str(share)] = one_update(config_of(settings, spaces, **rule), spaces, clock_of)
    seconds: dict[str, list[float]] = {label: [] for label in calls}
    for _ in range(rounds):
        for label, call in calls.items():
            seconds[label].append(call())
    ratios = {
        label: [t / p for t, p in zip(seconds[label], seconds["ppo"], strict=True)]
        for label in calls
        if label != "ppo"
    }
    return {
        "ppo_seconds": statistics.median(seconds["ppo"]),
        "ratio": {label: statistics.median(values) for label, values in ratios.items()},
        "bound": {str(share): 1.15 * share + 0.05 for share in SHARES},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--wall", action="store_true", help="time by the wall, as on a GPU")
    parser.add_argument("--out", type=Path, help=f"default: {PATH.name}, if every case is timed")
    options = parser.parse_args()
    clock_of = time.perf_counter if options.wall else time.process_time
    command = f"python benchmarks/selection.py --rounds {options.rounds}"
    result: dict[str, Any] = {"command": command + " --wall" * options.wall}
    for name in (name for name in CASES if options.only in name):
        result[name] = measure(name, options.rounds, clock_of)
        print(name, json.dumps(result[name]), flush=True)
    if path := options.out or (None if options.only else PATH):
        path.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
