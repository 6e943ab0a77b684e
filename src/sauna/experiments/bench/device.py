"""Rates of a population on the device: physics alone, collecting, updating, whole iterations.

Each round runs in a process of its own, so that nothing of it stays on the device:

    python -m sauna.experiments.bench.device '{"env": "playground/CheetahRun", ...}' ITERATIONS
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from sauna.config.presets import plain, resolve, resolve_run
from sauna.config.settings import Config
from sauna.experiments.bench.command import SECONDS
from sauna.experiments.bench.peer_settings import GYMNAX_PEERS, peer_settings
from sauna.experiments.bench.peers import peer_rate, prepare, script_digest, versions
from sauna.experiments.bench.rates import ratio
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.system.jax_setup import configure_jax
from sauna.training.prepare import MAX_STEPS, examine, place

# Numbers of environments that `--scale` tries, and of members.
ENVS = {"cpu": (8, 32, 128), "gpu": (256, 512, 1024, 2048, 4096, 8192, 16384)}
MEMBERS = {"cpu": (1, 4, 16), "gpu": (1, 4, 16, 64)}


def bench_on_device(
    overrides: Mapping[str, Any],
    *,
    iterations: int,
    rounds: int,
    against: str | None,
    script: Path | None,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Measures a population on the device.

    Args:
      iterations: of each round.
      rounds: how often everything is measured, in turn.
      against: `brax`, `rejax`, `purejaxrl` or None; script: the file that `purejaxrl` is.
      say: receives a line for each figure.

    Returns:
      the figures; rates are env steps per second of all members and environments.

    Raises:
      BadInput: the settings or the peer are not usable.
    """
    overrides = _on_device(overrides, 100 * iterations)
    config = place(resolve_run(overrides)).config
    measures: dict[str, Callable[[], dict[str, float]]] = {
        "sauna": lambda: _elsewhere("sauna.experiments.bench.device", overrides, iterations)
    }
    about_peer = {}
    if against == "brax":
        _check_brax(config)
        measures["brax"] = lambda: _elsewhere(
            "sauna.experiments.bench.peer_brax", overrides, iterations
        )
    elif against:
        measures[against], about_peer["peer"] = _gymnax_peer(against, config, script, say)
    found: list[dict[str, float]] = []
    for number in range(rounds):
        round_: dict[str, float] = {}
        for name, measure in measures.items():
            round_ |= measure()
            say(f"round {number + 1} of {rounds}: {name}: {_text(round_, name)}")
        found.append(round_)
    rates = {name: [each[name] for each in found] for name in found[0] if name not in _APART}
    return {
        "env": config.env,
        "arm": list(config.arm),
        "members": len(config.seeds) * len(config.arm),
        "envs": config.envs,
        "rollout_steps": config.rollout_steps,
        "minibatches": config.minibatches,
        "epochs": config.epochs,
        "hidden": list(config.hidden),
        "device": config.device,
        "machine": {**run_directory.machine(), "device": device_name(config)},
        "versions": run_directory.versions(),
        "git": run_directory.git_revision(),
        **about_peer,
        "rates": rates,
        "ratios": {n: ratio(rates["whole"], r) for n, r in rates.items() if n != "whole"},
        "compile_seconds": [each["compile_seconds"] for each in found],
        "peak_memory_mib": max(each["peak_memory_mib"] for each in found),
    }


def _gymnax_peer(
    peer: str, config: Config, script: Path | None, say: Callable[[str], None]
) -> tuple[Callable[[], dict[str, float]], dict[str, Any]]:
    """What measures a peer in an environment of its own, and what is noted of it.

    Raises:
      BadInput: it cannot train likewise; the field is named.
      SaunaError: it cannot be installed.
    """
    if peer not in GYMNAX_PEERS:
        known = ", ".join(("brax", *GYMNAX_PEERS))
        raise BadInput(f"against: {peer} has no environments on the device; {known} have")
    settings = peer_settings(peer, config)
    _check_one_member(peer, config)
    if config.device != "cpu" or config.devices > 1:
        raise BadInput(f"against: {peer} is run on one CPU; give --device cpu --devices 1")
    python = prepare(peer, say)

    def measure() -> dict[str, float]:
        return {peer: peer_rate(peer, python, script, settings, 1, SECONDS)}

    about = {"name": peer, "versions": versions(python), "settings": settings}
    return measure, {**about, **script_digest(script)}


def _check_one_member(peer: str, config: Config) -> None:
    if len(config.seeds) * len(config.arm) > 1:
        raise BadInput(f"against: {peer} trains one member; give --seeds 1")


def _check_brax(config: Config) -> None:
    """Refuses what Brax's PPO cannot do likewise.

    Raises:
      BadInput: naming the field.
    """
    if config.algorithm != "ppo":
        raise BadInput(f"against: brax is run with PPO, not with {config.algorithm}")
    if config.env.split("/")[0] not in ("brax", "playground"):
        raise BadInput(f"against: brax cannot train {config.env}")
    _check_one_member("brax", config)
    if config.envs % config.minibatches:
        raise BadInput(
            f"minibatches: brax shares environments over them, and {config.envs} are "
            f"not divisible by {config.minibatches}"
        )


_APART = ("compile_seconds", "peak_memory_mib")  # of a round, and not a rate


def _on_device(overrides: Mapping[str, Any], iterations: int) -> dict[str, Any]:
    overrides = plain({"backend": "device", **overrides})
    for name in ("processes", "distributed"):
        if name in overrides:
            raise BadInput(f"{name}: not read by a benchmark on the device, which is one process")
    config = resolve({**overrides, "steps": MAX_STEPS})  # room for a rollout of any size
    steps = config.rollout_steps * config.envs * iterations
    return {**overrides, "steps": min(steps, MAX_STEPS // config.max_env_steps_factor)}


def _text(round_: Mapping[str, float], name: str) -> str:
    wanted = ("physics", "collect", "update", "whole") if name == "sauna" else (name,)
    return ", ".join(f"{part} {round_[part]:,.0f}" for part in wanted) + " env steps/s"


def _elsewhere(module: str, overrides: Mapping[str, Any], iterations: int) -> dict[str, float]:
    command = [sys.executable, "-W", "ignore", "-m", module, json.dumps(overrides), str(iterations)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise SaunaError(f"{module}: {lines[-1]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def device_name(config: Config) -> str:
    """Names the device as the driver calls it."""
    if config.device != "gpu":
        return "CPU"
    command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    names = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    return f"{len(names)} x {names[0]}"


def scale_on_device(
    overrides: Mapping[str, Any], rounds: int, iterations: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Rates against the number of environments and of members, with the machine named.

    Raises:
      BadInput: the settings are not usable.
    """
    config = place(resolve_run(_on_device({**overrides, "seeds": 1}, 1))).config
    points = [("envs", n, {"envs": n, "seeds": 1}) for n in ENVS[config.device]]
    points += [("members", n, {"seeds": n}) for n in MEMBERS[config.device]]
    found: dict[str, dict[int, list[dict[str, float]]]] = {"envs": {}, "members": {}}
    for number in range(rounds):
        for axis, value, settings in points:
            each = _elsewhere(
                "sauna.experiments.bench.device",
                _on_device({**overrides, **settings}, 100 * iterations),
                iterations,
            )
            found[axis].setdefault(value, []).append(each)
            say(f"round {number + 1} of {rounds}: {value} {axis}: {_text(each, 'sauna')}")
    return {
        "env": config.env,
        "arm": list(config.arm),
        "device": config.device,
        "machine": {**run_directory.machine(), "device": device_name(config)},
        "versions": run_directory.versions(),
        "git": run_directory.git_revision(),
        "scale": {
            axis: [
                {"value": value, **{n: median(e[n] for e in each) for n in each[0]}, "rounds": each}
                for value, each in points.items()
            ]
            for axis, points in found.items()
        },
    }


def measure(overrides: Mapping[str, Any], iterations: int) -> dict[str, float]:
    """One round, in this process."""
    placed = place(resolve_run(overrides))
    config = placed.config
    configure_jax(config.devices if config.device == "cpu" else 0, config.device)
    import jax

    from sauna.training.loop.device import make_population

    job = examine(placed, overrides).job()
    config = job.config
    population = make_population(job)
    compile_seconds = population.compile()
    population.run(0, 1)
    whole = _whole(population, iterations)
    memory = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    rates = {"whole": whole, **_parts(population, config, iterations)}
    return {**rates, "compile_seconds": compile_seconds, "peak_memory_mib": memory / 2**20}


def _whole(population: Any, iterations: int) -> float:
    """Env steps per second of that many whole iterations, a device's call of them at a time."""
    from sauna.training.loop.device_program import MAX_PER_CALL

    first, steps, clock = 1, 0, time.perf_counter()
    while first <= iterations:
        number = min(MAX_PER_CALL, iterations + 1 - first)
        reports = population.run(first, number)
        steps += sum(int(report.env_steps[report.ran].sum()) for report in reports)
        first += number
    return steps / (time.perf_counter() - clock)


def _parts(population: Any, config: Config, iterations: int) -> dict[str, float]:
    """Rates of what an iteration is made of, of all members one after the other or together."""
    import jax
    import jax.numpy as jnp

    from sauna.algorithm.rollout.collected import capacity
    from sauna.algorithm.rollout.device import collect
    from sauna.training.loop.device_program import learn_from

    parts = population.parts
    state, setting = population.example()
    over = population.over_members
    limit = jnp.int32(capacity(config))

    def collecting(state: Any, setting: Any) -> Any:
        return collect(
            parts.collecting,
            state.learner.params,
            state.collect,
            setting.keys,
            setting.hypers,
            jnp.int32(0),
            limit,
        )

    collect_all = jax.jit(over(collecting))
    rollout = collect_all(state, setting)[1]
    learn_all = jax.jit(
        over(lambda s, c, r: learn_from(parts, s.learner, r, c, c.hypers, jnp.int32(0)))
    )
    physics_all = jax.jit(over(partial(_physics, parts.collecting.env, config.rollout_steps)))
    each = {
        "physics": (lambda: physics_all(state, setting), config.rollout_steps * config.envs),
        "collect": (lambda: collect_all(state, setting), None),
        "update": (lambda: learn_all(state, setting, rollout), None),
    }
    members, tried = population.in_one_call, float(jnp.sum(rollout.valid))
    rates = {}
    for name, (run, steps) in each.items():
        jax.block_until_ready(run())
        clock = time.perf_counter()
        for _ in range(iterations):
            jax.block_until_ready(run())
        taken = time.perf_counter() - clock
        rates[name] = iterations * (steps * members if steps else tried) / taken
    return rates


def _physics(env: Any, steps: int, state: Any, setting: Any) -> Any:
    """Env steps of one member's environments with random actions; nothing is reset or learned."""
    import jax

    inner = state.collect.envs.state
    space = env.action_space

    def step(inner: Any, key: Any) -> tuple[Any, Any]:
        number = state.collect.discounted_return.shape
        if hasattr(space, "n"):
            action = jax.random.randint(key, (*number, 1), 0, int(space.n))
        else:
            action = jax.random.uniform(key, (*number, space.shape[0]), minval=-1.0, maxval=1.0)
        after = jax.vmap(env.step)(inner, action)
        return after.state, after.reward

    return jax.lax.scan(step, inner, jax.random.split(setting.keys.env, steps))


def report_on_device(result: Mapping[str, Any]) -> list[str]:
    """Returns the figures as lines of text."""
    rates = {name: median(values) for name, values in result["rates"].items()}
    lines = [
        f"{result['env']}, {', '.join(result['arm'])}, {result['members']} members of "
        f"{result['envs']} environments on {result['machine']['device']}: "
        f"{rates['whole']:,.0f} env steps/s"
    ]
    names = {
        "physics": "physics alone",
        "collect": "collecting alone",
        "update": "updating alone",
        "brax": "Brax's PPO",
        "rejax": "rejax's PPO",
        "purejaxrl": "PureJaxRL's script",
    }
    for name, found in result["ratios"].items():
        lines.append(
            f"  {found['median']:.2f} times {names[name]} ({found['low']:.2f} to "
            f"{found['high']:.2f}; {rates[name]:,.0f} per second)"
        )
    lines.append(f"  compiled in {median(result['compile_seconds']):.1f} s")
    return lines


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[1]), int(sys.argv[2]))))
