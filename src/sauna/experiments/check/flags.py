"""`sauna check` as a command."""

from __future__ import annotations

from typing import Any

from sauna.config.parsing import whole_number
from sauna.system.errors import SaunaError, printable

STEPS = 1000


def add_command(commands: Any) -> None:
    """Adds the command to the subparsers of `sauna`."""
    text = "what is wrong with an environment, and how to mend it"
    check = commands.add_parser("check", help=text, allow_abbrev=False)
    text = "Gymnasium id, or module:function that makes an environment"
    check.add_argument("env", metavar="ENV", help=text)
    text = "keyword arguments of the environment, as a JSON object"
    check.add_argument("--env-kwargs", metavar="JSON", help=text)
    text = f"env steps that are played with random actions (default {STEPS})"
    check.add_argument("--steps", default=str(STEPS), help=text)


def check_from_flags(values: dict[str, Any]) -> None:
    """Runs `sauna check`.

    Raises:
      BadInput: the environment cannot be made.
      SaunaError: something is wrong with it.
    """
    from sauna.experiments.check.findings import WRONG, check

    steps = whole_number("steps", values["steps"], 1)
    found = check(values["env"], values["env_kwargs"] or {}, steps)
    print("\n".join(map(printable, found.facts)))
    for finding in found.findings:
        print(printable(f"{finding.kind}: {finding.text}"))
        print(printable(f"  fix: {finding.fix}"))
    wrong = sum(finding.kind == WRONG for finding in found.findings)
    if wrong:
        raise SaunaError(f"{values['env']}: {wrong} thing{'s' * (wrong > 1)} wrong, see above")
    print("nothing is wrong" if not found.findings else "nothing is wrong that stops a training")
