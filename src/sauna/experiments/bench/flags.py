"""`sauna bench` from its command-line flags."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sauna.config.accepted import translate
from sauna.config.choices import PEER_SCRIPTS
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
    rounds = whole_number("rounds", values["rounds"], 1)
    iterations = whole_number("iterations", values["iterations"], 2)
    against, file = values.pop("against"), values.pop("json")
    if file and not Path(file).resolve().parent.is_dir():
        raise BadInput(f"json: {Path(file).parent} is not a folder")
    script = _script(against, values["script"])
    for name in ("rounds", "iterations", "script"):
        del values[name]
    overrides = {"seeds": 6, **translate({"arm": "ppo", **values})}
    native = place(resolve_run(plain(overrides))).config.backend == "device"
    if native and scale:
        result = scale_on_device(overrides, rounds, iterations, say)
    elif native:
        result = bench_on_device(
            overrides, rounds=rounds, iterations=iterations, against=against, script=script, say=say
        )
        print("\n".join(report_on_device(result)))
    elif scale:
        result = bench_scale(overrides, rounds, say)
    else:
        result = bench(
            overrides, rounds=rounds, iterations=iterations, against=against, script=script, say=say
        )
        print("\n".join(report(result)))
    if file:
        Path(file).write_text(json.dumps(result, indent=1) + "\n")
        print(f"figures: {file}")


def _script(against: str | None, script: str | None) -> Path | None:
    """The file that a peer is, where it is one.

    Raises:
      BadInput: the peer needs it, or does not read it, or it is not there.
    """
    if against not in PEER_SCRIPTS:
        if script:
            known = " and ".join(PEER_SCRIPTS)
            raise BadInput(f"script: read with --against {known} alone")
        return None
    if not script:
        wanted = f"your copy of its {PEER_SCRIPTS[against]}"
        raise BadInput(f"script: --against {against} needs --script FILE, {wanted}")
    path = Path(script)
    if not path.is_file():
        raise BadInput(f"script: {script} is not a file")
    if against == "purejaxrl" and not path.with_name("wrappers.py").is_file():
        raise BadInput(f"script: wrappers.py, which {path.name} imports, is not beside it")
    return path
