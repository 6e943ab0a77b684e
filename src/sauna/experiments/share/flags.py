"""`sauna export` as a command: its arguments, and what runs them."""

from __future__ import annotations

import os
from typing import Any

from sauna.config.parsing import whole_number

TRUST = "run the code that the run names, even if another user named it"


def add_commands(commands: Any) -> None:
    """Adds the commands to the subparsers of `sauna`."""
    text = "write one policy as a folder of its own, also as ONNX or numpy"
    export = commands.add_parser("export", help=text, allow_abbrev=False)
    _add_export(export)
    export.add_argument("--to", metavar="DIR", required=True, help="the folder, new or empty")


def _add_export(command: Any) -> None:
    """Adds what says which policy is written, and how."""
    text = "run directory, or an exported policy"
    command.add_argument("run", metavar="RUN", help=text)
    command.add_argument(
        "--member", default="0", help="name (sauna/0) or index; default: the first"
    )
    text = "as it was at its best evaluation during training"
    command.add_argument("--best", action="store_true", help=text)
    text = "also as ONNX, from the raw observation to the most likely action"
    command.add_argument("--onnx", action="store_true", help=text)
    text = "also as a Python file that needs numpy and safetensors alone"
    command.add_argument("--numpy", action="store_true", help=text)
    text = "episodes of the model card's return, of the most likely actions (default 20; 0: none)"
    command.add_argument("--episodes", default="20", help=text)
    text = "seed of their first episode (default 1000)"
    command.add_argument("--seed", default="1000", help=text)
    command.add_argument("--trust", action="store_true", help=TRUST)


def export_from_flags(values: dict[str, Any]) -> None:
    """Runs `sauna export`.

    Raises:
      BadInput: as `export`.
    """
    values |= {name: whole_number(values, name, 0) for name in ("episodes", "seed")}
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("PJRT_NPROC", "1")
    from sauna.experiments.share.export import export

    folder = export(**values)
    print(f"policy: {folder}")


COMMANDS = {"export": export_from_flags}
