"""What finite checks, logging, hashing and checkpoints cost of a training: results/checks.json.

    python tests/faults/cost.py        minutes

On the host it is the shares that `sauna bench` gives, of several runs. What is compiled into a
program cannot be timed from outside: the program is compiled a second time without its checks, and
both are called in turn. Of CPU seconds the fewest count: others on the machine only add to them.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]
RESULTS = ROOT / "results" / "checks.json"
HOST = {"env": "HalfCheetah-v5", "arm": "ppo", "steps": 1_000_000}
MEMBERS = (1, 3)
ROUNDS = 5
DEVICE = {
    "env": "gymnax/CartPole-v1",
    "arm": "ppo",
    "envs": 16,
    "rollout_steps": 128,
    "minibatches": 32,
    "steps": 10_000_000,
}
# What `helpers.make_job` would make small otherwise.
PRESET = {"minibatches": 32, "epochs": 10, "hidden": "64,64", "rollout_steps": 2048}
TURNS = 300


def of_the_host(members: int) -> dict[str, float]:
    """Shares of the time of a training, each the median of the rounds."""
    from sauna.experiments.bench.command import RECORDS
    from sauna.experiments.bench.split import split

    rounds = [split(HOST, members) for _ in range(ROUNDS)]
    shares = {name: [found[name] / sum(found.values()) for found in rounds] for name in RECORDS}
    shares["all"] = [sum(part) for part in zip(*shares.values(), strict=True)]
    return {name: float(np.median(values)) for name, values in shares.items()}


def in_turn(checked: Callable[[], Any], unchecked: Callable[[], Any]) -> float:
    """The share of `checked`'s CPU seconds that `unchecked` saves."""
    seconds: dict[Any, list[float]] = {checked: [], unchecked: []}
    for _ in range(TURNS):
        for call, spent in seconds.items():
            clock = time.process_time()
            call()
            spent.append(time.process_time() - clock)
    with_, without = map(min, seconds.values())
    return 1.0 - without / with_


def of_the_update() -> float:
    """The check in the compiled update of one member, on a rollout of `HOST`."""
    import jax

    from helpers import make_job
    from sauna.algorithm.learner.program import make_learner
    from sauna.algorithm.learner.update import minibatch_order
    from sauna.algorithm.rollout.host import HostCollector
    from sauna.algorithm.rollout.program import make_program
    from sauna.algorithm.types import Hypers, member_keys
    from sauna.training.loop.host import make_envs

    job = make_job(**{**PRESET, **HOST})
    key, member = member_keys(0), job.members[0]
    hypers = Hypers(*(np.float32(getattr(member.config, name)) for name in Hypers._fields))
    order = minibatch_order(job.config, 0, 0)

    def compiled() -> Callable[[], Any]:
        program = make_program(job.config, job.spaces)
        envs = make_envs(job)
        collector = HostCollector(program, job.spaces, envs, [key])
        collector.start()
        learner = make_learner(job.config, program.policy, job.spaces)
        state = learner.init(key.init)
        limit = np.array([job.config.rollout_steps])
        (collected,) = collector.collect(np.asarray(state.params)[None], [hypers], 0, limit)
        envs.close()
        batch = learner.make_batch(collected.rollout, hypers, key.order)

        def call() -> None:
            nonlocal state  # used up by each call
            state, metrics = learner.learn(
                state, collected.rollout, batch, hypers, order, key.order
            )
            jax.block_until_ready(metrics)

        call()
        return call

    return in_turn(compiled(), without_checks(compiled))


def of_the_device() -> float:
    """The checks in a whole iteration of `DEVICE`, whose environment costs next to nothing."""
    from helpers import make_job
    from sauna.training.loop.device import make_population

    job = make_job(**{**PRESET, **DEVICE})

    def compiled() -> Callable[[], Any]:
        population = make_population(job)
        population.compile()
        iteration = iter(range(10**9))
        return lambda: population.run(next(iteration), 1)

    return in_turn(compiled(), without_checks(compiled))


def without_checks(compiled: Callable[[], Callable[[], Any]]) -> Callable[[], Any]:
    import jax.numpy as jnp

    with patch("jax.numpy.isfinite", lambda x: jnp.ones(jnp.shape(x), bool)):
        return compiled()


def main() -> int:
    from sauna.system import run_directory
    from sauna.system.jax_setup import configure_jax

    configure_jax()
    found = {
        "host": {"env": HOST["env"], "members": {str(n): of_the_host(n) for n in MEMBERS}},
        "update": of_the_update(),
        "device": {"env": DEVICE["env"], "envs": DEVICE["envs"], "share": of_the_device()},
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
    }
    print(json.dumps(found, indent=1))
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    shares = [part["all"] for part in found["host"]["members"].values()]
    return int(max(*shares, found["device"]["share"]) > 0.02)


if __name__ == "__main__":
    sys.exit(main())
