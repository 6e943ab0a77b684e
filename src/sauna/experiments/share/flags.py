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
    text = "upload one policy to the Hugging Face Hub, with its model card"
    push = commands.add_parser("push", help=text, allow_abbrev=False)
    _add_export(push)
    push.add_argument("repo", metavar="USER/NAME", help="the repository; made if there is none")
    text = "if the repository is made, only its owner sees it"
    push.add_argument("--private", action="store_true", help=text)
    push.add_argument("--revision", help="a branch, made if there is none (default: the main one)")
    text = "fetch a policy from the Hugging Face Hub; nothing of it is executed"
    pull = commands.add_parser("pull", help=text, allow_abbrev=False)
    pull.add_argument("name", metavar="USER/NAME[@REVISION]", help="the repository")
    pull.add_argument("to", metavar="DIR", help="the folder, new or empty")


def _add_export(command: Any) -> None:
    """Adds what says which policy is written, and how."""
    text = "run directory, or an exported policy"
    command.add_argument("run", metavar="RUN", help=text)
    command.add_argument("--member", help="name (sauna/0) or index; default: the first")
    text = "as it was at its best evaluation during training"
    command.add_argument("--best", action="store_true", help=text)
    text = "also as ONNX, from the raw observation to the most likely action"
    command.add_argument("--onnx", action="store_true", help=text)
    text = "also as a Python file that needs numpy and safetensors alone"
    command.add_argument("--numpy", action="store_true", help=text)
    text = "episodes of the model card's return, of the most likely actions (default 20; 0: none)"
    command.add_argument("--episodes", help=text)
    text = "seed of their first episode (default 1000)"
    command.add_argument("--seed", help=text)
    command.add_argument("--trust", action="store_true", help=TRUST)


def export_from_flags(values: dict[str, Any]) -> None:
    """Runs `sauna export`.

    Raises:
      BadInput: as `export`.
    """
    from sauna.experiments.share.card import listing
    from sauna.experiments.share.export import export

    folder = export(**_read(values))
    print("\n".join([f"policy: {folder}", *listing(folder)]))


def _read(values: dict[str, Any]) -> dict[str, Any]:
    """Reads what was given of an export, and keeps JAX to one thread of the CPU."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("PJRT_NPROC", "1")
    given = {name: value for name, value in values.items() if value not in (None, False)}
    return given | {n: whole_number(n, given[n], 0) for n in ("episodes", "seed") if n in given}


def push_from_flags(values: dict[str, Any]) -> None:
    """Runs `sauna push`.

    Raises:
      BadInput, SaunaError: as `push`.
    """
    from sauna.experiments.share.exchange import push

    print(f"pushed: {push(**_read(values))}")


def pull_from_flags(values: dict[str, Any]) -> None:
    """Runs `sauna pull`.

    Raises:
      BadInput, SaunaError: as `pull`.
    """
    from sauna.experiments.share.exchange import pull

    print(f"policy: {pull(**values)}")


COMMANDS = {"export": export_from_flags, "push": push_from_flags, "pull": pull_from_flags}
