"""`sauna bench` from its command-line flags."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sauna.config.accepted import translate
from sauna.config.parsing import whole_number
from sauna.config.presets import plain, resolve_run
from sauna.experiments.bench.command import bench, bench_scale, report
from sauna.experiments.bench.device import bench_on_device, report_on_device, scale_on_device
from sauna.system.errors import BadInput
from sauna.training.prepare import place


def bench_from_flags(values: dict[str, Any], say: Callable[[str], None]) -> None:
    """Measures what the flags of `sauna bench` ask for, and prints the figures.

    Raises:
      BadInput: flags that do not go together.
    """
    scale = values.pop("scale")
    fixed = ("iterations", "seed", "seeds", "processes", "envs", "rollout_steps", "hidden")
    unread = [name for name in fixed if name in values] + ["against"] * bool(values["against"])
    if scale and unread:
        raise BadInput(f"{unread[0]}: not read with --scale")
    values.setdefault("iterations", "50")
    rounds, iterations = whole_number(values, "rounds", 1), whole_number(values, "iterations", 2)
    against, file = values.pop("against"), values.pop("json")
    if file and not Path(file).resolve().parent.is_dir():
        raise BadInput(f"json: {Path(file).parent} is not a folder")
    script = values["script"]
    if (against == "cleanrl") != bool(script) or (script and not Path(script).is_file()):
        raise BadInput("script: --against cleanrl needs --script FILE, and nothing else reads it")
    for name in ("rounds", "iterations", "script"):
        del values[name]
    overrides = {"seeds": 6, **translate({"arm": "ppo", **values})}
    native = place(resolve_run(plain(overrides))).config.backend == "device"
    if native and scale:
        result = scale_on_device(overrides, rounds, iterations, say)
    elif native:
        result = bench_on_device(
            overrides, rounds=rounds, iterations=iterations, against=against, say=say
        )
        print("\n".join(report_on_device(result)))
    elif scale:
        result = bench_scale(overrides, rounds, say)
    else:
        path = Path(script) if script else None
        result = bench(
            overrides, rounds=rounds, iterations=iterations, against=against, script=path, say=say
        )
        print("\n".join(report(result)))
    if file:
        Path(file).write_text(json.dumps(result, indent=1) + "\n")
        print(f"figures: {file}")
