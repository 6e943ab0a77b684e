"""`sauna bench`: the figures, a table of them, and a json file with the machine named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from sauna.config.presets import plain, resolve
from sauna.config.settings import FIELDS
from sauna.experiments.bench.peer_settings import LACKS, peer_settings
from sauna.experiments.bench.peers import peer_rate, prepare, script_digest, versions
from sauna.experiments.bench.rates import (
    WARM_UP,
    alternate,
    physics_rate,
    ratio,
    simulator,
    training_rate,
)
from sauna.experiments.bench.scale import scale
from sauna.system import run_directory
from sauna.system.errors import SaunaError

RECORDS = ("checks", "logging", "checkpoints")  # what a trainer without them would save
EVALUATION = [name for name, field in FIELDS.items() if field.metadata["group"] == "evaluation"]
SECONDS = 15.0  # that a peer or the physics is measured in each round


def bench(
    overrides: Mapping[str, Any],
    *,
    iterations: int,
    rounds: int,
    against: str | None,
    script: Path | None,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Measures training with these settings on this machine.

    Args:
      iterations: of each round's training, beyond the warm-up.
      rounds: how often everything is measured, in turn.
      against: a peer, or None; script: the file that the peer `cleanrl` is.
      say: receives a line for each figure.

    Returns:
      the figures; rates are env steps per second, summed over all processes.

    Raises:
      BadInput: the settings or the peer are not usable.
    """
    overrides = plain(overrides)
    config = resolve(overrides)
    processes = config.processes or os.cpu_count() or 1
    processes = min(processes, len(config.seeds) * len(config.arm))
    batch = config.rollout_steps * config.envs
    overrides |= {"steps": batch * (iterations + WARM_UP), "processes": processes}
    measures = {"training": lambda: training_rate(overrides)}
    if simulator(config.env):
        kwargs = json.loads(config.env_kwargs)
        measures["physics"] = lambda: physics_rate(config.env, kwargs, processes, SECONDS / 3)
    result: dict[str, Any] = {
        "env": config.env,
        "arm": list(config.arm),
        "preset": config.preset,
        "members": len(config.seeds) * len(config.arm),
        "processes": processes,
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
        "git": run_directory.git_revision(),
    }
    if against:
        settings = peer_settings(against, config)
        python = prepare(against, say)
        measures[against] = partial(
            peer_rate, against, python, script, settings, processes, SECONDS
        )
        lacks = {name: getattr(config, name) for name in LACKS.get(against, ())}
        result["peer"] = {
            "name": against,
            "processes": processes,
            "versions": versions(python),
            "settings": settings,
            "measured_without": lacks,
            **script_digest(script),
        }
        if lacks:
            say(f"{against} is measured without {', '.join(lacks)}, which it does not have")
    result["rates"] = rates = alternate(measures, rounds, say)
    result["ratios"] = {
        name: ratio(rates["training"], others)
        for name, others in rates.items()
        if name != "training"
    }
    say("where the time goes, in one process")
    share = -(-result["members"] // processes)
    result["split"] = _split_elsewhere({**overrides, "steps": batch * 100}, share)
    result |= start_and_memory(overrides)
    return result


def bench_scale(
    overrides: Mapping[str, Any], rounds: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Returns the rate against members, environments, width and processes, with the machine named.

    Raises:
      BadInput: the settings are not usable.
    """
    overrides = plain(overrides)
    config = resolve(overrides)
    return {
        "env": config.env,
        "arm": list(config.arm),
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
        "git": run_directory.git_revision(),
        "scale": scale(overrides, rounds, say),
    }


def _split_elsewhere(overrides: Mapping[str, Any], share: int) -> dict[str, float]:
    """`split` in a process that is set up as a training worker is."""
    device = "gpu" if resolve(overrides).device == "gpu" else "cpu"
    code = (
        "import json, sys; from sauna.system.jax_setup import configure_jax; "
        f"configure_jax(device={device!r}); "
        "from sauna.experiments.bench.split import split; "
        "print(json.dumps(split(json.loads(sys.argv[1]), int(sys.argv[2]))))"
    )
    command = [sys.executable, "-W", "ignore", "-c", code, json.dumps(overrides), str(share)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def two_iterations(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Returns settings for `sauna train`: the bench's preset, two iterations, no evaluations."""
    config = resolve(overrides)
    values = {name: value for name, value in overrides.items() if name not in EVALUATION}
    return values | {"preset": config.preset, "steps": 2 * config.rollout_steps * config.envs}


def start_and_memory(overrides: Mapping[str, Any]) -> dict[str, float]:
    """Seconds from the command to the end of the first iteration, and the memory of one process.

    A second run of the same settings, so that the compilation cache is warm. The first env step
    comes before the first row does; the time reported is the later one.
    """
    values = two_iterations(overrides)
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder) / "settings.json"
        settings.write_text(json.dumps({**values, "out": os.path.join(folder, "run")}))
        # Trusted: whoever called this has named the code in the settings.
        command = [sys.executable, "-m", "sauna", "train", "--config", str(settings), "--trust"]
        clock = time.time()
        started = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        log = Path(folder) / "run" / "timing.jsonl"
        peak = 0
        while started.poll() is None:
            peak = max(peak, _largest_worker(started.pid))
            if not (log.exists() and log.read_text()):
                first = time.time() - clock
            time.sleep(0.02)
        if started.returncode:
            raise SaunaError(f"bench: sauna train with these settings: exit {started.returncode}")
        rows = [json.loads(line) for line in log.read_text().splitlines()]
    return {
        "seconds_to_first_row": first,
        "seconds_to_first_env_step": first - rows[0]["seconds"],
        "peak_memory_mib": peak / 1024,
    }


def _largest_worker(parent: int) -> int:
    """KiB that the largest child of a process has used at its peak (Linux; elsewhere 0)."""
    largest = 0
    for place in Path("/proc").glob("[0-9]*"):
        try:
            stat = (place / "stat").read_text().rpartition(")")[2].split()
            if int(stat[1]) == parent:
                status = (place / "status").read_text()
                largest = max(largest, int(status.split("VmHWM:")[1].split()[0]))
        except (OSError, IndexError):
            continue  # it ended meanwhile
    return largest


def report(result: Mapping[str, Any]) -> list[str]:
    """Returns the figures as lines of text."""
    rates, lines = result["rates"], []
    middle = {name: sorted(values)[len(values) // 2] for name, values in rates.items()}
    lines.append(
        f"{result['env']}, {', '.join(result['arm'])}, {result['members']} members in "
        f"{result['processes']} processes: {middle['training']:,.0f} env steps/s"
    )
    for name, found in result["ratios"].items():
        text = f"{name} in as many processes"
        if name == "physics":
            text = simulator(result["env"]) or name
        lines.append(
            f"  {found['median']:.2f} times {text} ({found['low']:.2f} to {found['high']:.2f}; "
            f"{middle[name]:,.0f} per second)"
        )
    total = sum(result["split"].values())
    lines.append(f"  one process, {total:.1f} us per env step:")
    for name, value in result["split"].items():
        lines.append(f"    {name:14} {value:6.2f} us  {value / total:5.1%}")
    records = sum(result["split"][name] for name in RECORDS) / total
    lines.append(f"  of it for records and safety ({', '.join(RECORDS)}): {records:.1%}")
    lines.append(
        f"  first env step after {result['seconds_to_first_env_step']:.1f} s, at most "
        f"{result['peak_memory_mib']:.0f} MiB in one process"
    )
    return lines
