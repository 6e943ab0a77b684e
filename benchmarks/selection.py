"""How much of the time a rule saves: `results/selection.json`.

    python benchmarks/selection.py [--rounds 5]      (some minutes)
    python benchmarks/selection.py --only "CNN"      one case; the others stay as they are

One member's update is timed at the kept shares 1, 0.5, 0.25 and 0.1 (`top-advantage`, mode
`fewer`) beside plain PPO's, in blocks that take turns, by CPU time of this process. The bound that
has to hold is `time(k) <= (1.15 k + 0.05) time(PPO)`. The least time of all rounds counts: the work
is always the same, and what else the machine does can only add to it. `on the device` is the update
inside the device's one program, which draws its own order. `Pong, whole training` compares
trainings.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sauna.system.jax_setup import configure_jax
from sauna.training.prepare import has_gpu

# `--wall` is for a GPU, if there is one.
configure_jax(device="gpu" if "--wall" in sys.argv and has_gpu() else "cpu")

import jax  # noqa: E402
from turns import Trainer, in_turn  # noqa: E402

from sauna.algorithm.learner.program import make_learner, make_parts  # noqa: E402
from sauna.algorithm.learner.update import minibatch_order  # noqa: E402
from sauna.algorithm.policy.policy import make_policy  # noqa: E402
from sauna.algorithm.types import Batch, Hypers, Rollout, member_keys, selection_key  # noqa: E402
from sauna.config.presets import resolve  # noqa: E402
from sauna.config.settings import Config  # noqa: E402
from sauna.envs.spaces import Spaces  # noqa: E402
from sauna.training.loop.device_program import IterationParts, learn_from  # noqa: E402
from sauna.training.loop.job import Setting  # noqa: E402

PATH = Path(__file__).resolve().parent / "results" / "selection.json"
SHARES = (1.0, 0.5, 0.25, 0.1)
BLOCK = 0.5  # seconds
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


def random_rollout(config: Config, spaces: Spaces) -> Rollout:
    """Random samples of the right shapes."""
    rng, shape = np.random.default_rng(0), (config.rollout_steps, config.envs)
    normal = lambda *more: rng.normal(size=(*shape, *more)).astype(np.float32)  # noqa: E731
    if spaces.observation_kind == "image":
        observation = rng.integers(0, 256, (*shape, *spaces.observation_shape), np.uint8)
    else:
        observation = normal(*spaces.observation_shape)
    if spaces.action_kind == "discrete":
        action = rng.integers(0, spaces.action_sizes[0], (*shape, 1), np.int32)
        log_prob = np.full(shape, -np.log(spaces.action_sizes[0]), np.float32)
    else:
        action = normal(spaces.action_width)
        log_prob = (-0.5 * action**2 - 0.5 * np.log(2 * np.pi)).sum(-1)
    no, yes = np.zeros(shape, bool), np.ones(shape, bool)
    columns: Any = (
        observation,
        action,
        log_prob,
        *(normal() for _ in range(4)),
        *(no, no, yes, yes),
    )
    return Rollout(*columns)


def one_update(
    config: Config, spaces: Spaces, on_device: bool, clock_of: Callable[[], float]
) -> Callable[[], float]:
    """A function that runs one update on random samples and returns its seconds by a clock."""
    policy, rollout = make_policy(config, spaces), random_rollout(config, spaces)
    learner, keys = make_learner(config, policy, spaces), member_keys(0)
    values: dict[str, Any] = {n: np.float32(getattr(config, n)) for n in Hypers._fields}
    hypers, key = Hypers(**values), selection_key(keys, 0)
    batch: Batch = jax.block_until_ready(learner.make_batch(rollout, hypers, key))
    state = learner.init(keys.init)
    order = minibatch_order(config, 0, 0)
    no_env: Any = None
    parts = IterationParts(config, no_env, policy, make_parts(config, policy, spaces))
    setting = Setting(keys, hypers, np.int32(config.steps))
    inside = jax.jit(
        lambda state, rollout: learn_from(parts, state, rollout, setting, hypers, np.int32(0)),
        donate_argnums=0,
    )

    def call() -> float:
        nonlocal state
        clock = clock_of()
        if on_device:
            state, metrics = inside(state, rollout)
        else:
            state, metrics = learner.learn(state, rollout, batch, hypers, order, key)
        jax.block_until_ready(metrics)
        return clock_of() - clock

    call()
    return call


def least_of_a_block(call: Callable[[], float]) -> float:
    """Calls again and again for `BLOCK` seconds, at least once; returns the least time."""
    spent = least = call()
    while spent < BLOCK:
        seconds = call()
        spent, least = spent + seconds, min(least, seconds)
    return least


def measure(
    name: str, rounds: int, on_device: bool, clock_of: Callable[[], float]
) -> dict[str, Any]:
    settings, spaces = CASES[name]
    calls = {"ppo": one_update(config_of(settings, spaces), spaces, on_device, clock_of)}
    for share in SHARES:
        rule = {
            "sampler": "top-advantage",
            "sampler_kwargs": {"share": share},
            "normalize_over": "rollout",
        }
        config = config_of(settings, spaces, **rule)
        calls[str(share)] = one_update(config, spaces, on_device, clock_of)
    least = dict.fromkeys(calls, math.inf)
    for _ in range(rounds):
        for label, call in calls.items():
            least[label] = min(least[label], least_of_a_block(call))
    return {
        "ppo_seconds": least["ppo"],
        "ratio": {str(share): least[str(share)] / least["ppo"] for share in SHARES},
        "bound": {str(share): 1.15 * share + 0.05 for share in SHARES},
    }


def measure_pong(rounds: int) -> dict[str, Any]:
    """How much faster a whole training is that keeps half of its samples."""
    common = {"env": "ALE/Pong-v5", "preset": "atari", "arm": "top-advantage"}
    trainers = {
        str(share): Trainer({**common, "sampler_kwargs": {"share": share}}, 1)
        for share in (1.0, 0.5)
    }
    seconds = in_turn(trainers, rounds)
    least = {share: min(values) for share, values in seconds.items()}
    return {"cpu_seconds_per_iteration": least, "faster_at_0.5": least["1.0"] / least["0.5"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--wall", action="store_true", help="time by the wall; on a GPU, if any")
    parser.add_argument("--out", type=Path, help=f"default: {PATH.name}; what is there stays")
    options = parser.parse_args()
    rounds, path = options.rounds, options.out or PATH
    clock_of = time.perf_counter if options.wall else time.process_time
    cases = {name: partial(measure, name, rounds, False, clock_of) for name in CASES}
    if not options.wall:
        for name in CASES:
            cases[f"{name}, on the device"] = partial(measure, name, rounds, True, clock_of)
        cases["Pong, whole training"] = partial(measure_pong, rounds)
    result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    result["command"] = "python benchmarks/selection.py" + " --wall" * options.wall
    if options.wall:
        result["device"] = jax.devices()[0].device_kind
    for name, measured in cases.items():
        if options.only in name:
            result[name] = {"rounds": rounds, **measured()}
            print(name, json.dumps(result[name]), flush=True)
            path.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
