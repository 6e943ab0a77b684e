"""`sauna tune`'s flags, and from them to a tuning. Nothing here imports Optuna or JAX."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sauna.config.flags import add_fields
from sauna.config.parsing import whole_number
from sauna.config.settings import FIELDS, fields_with, flag
from sauna.system.errors import BadInput, SaunaError

_WHOLE = ("trials", "lockstep", "finalists", "fresh_seeds", "exchange_every")
_TUNING: dict[str, dict[str, Any]] = {
    "trials": {
        "default": "50",
        "metavar": "INT",
        "help": "settings to try, with those that were tried before (default 50); with "
        "--population-based, the members",
    },
    "space": {
        "default": "",
        "metavar": "FILE",
        "help": "a TOML file of what is searched, lists of choices or {low, high, log} (default: "
        "learning rate, clip range, discount, rollout and the like)",
    },
    "lockstep": {
        "default": "4",
        "metavar": "INT",
        "help": "trials that are trained in one program, which share what shapes it (default 4)",
    },
    "search": {
        "default": "tpe",
        "metavar": "tpe|random",
        "help": "Optuna's, which chooses the values (default tpe)",
    },
    "pruner": {
        "default": "median",
        "metavar": "median|hyperband|none",
        "help": "Optuna's, which ends trials early (default median)",
    },
    "finalists": {
        "default": "4",
        "metavar": "INT",
        "help": "best trials that are trained with three further seeds, to choose among them "
        "(default 4; 1: the best score decides)",
    },
    "fresh_seeds": {
        "default": "5",
        "metavar": "INT",
        "help": "seeds on which what was found is trained beside the task's preset (default 5)",
    },
    "population_based": {
        "action": "store_true",
        "help": "population-based training instead of trials: the worst copy the best and change "
        "its settings while they train",
    },
    "exchange_every": {
        "default": "0",
        "metavar": "INT",
        "help": "env steps of a member between two exchanges (default 0: a tenth of the budget)",
    },
}


def add_tune(commands: Any, values: Mapping[str, Any], place: Mapping[str, Any]) -> None:
    """Adds the parser of `sauna tune`.

    Args:
      commands: where parsers are added.
      values: the defaults that its help shows.
      place: the flags of where it trains.
    """
    text = "search settings for ENV, and try what was found on fresh seeds"
    usage = "sauna tune ENV [--OPTION VALUE ...]"
    tune: argparse.ArgumentParser = commands.add_parser(
        "tune", help=text, usage=usage, allow_abbrev=False
    )
    tune.add_argument("env", nargs="?", metavar="ENV", help=FIELDS["env"].metadata["help"])
    group = tune.add_argument_group("tuning")
    for name, how in _TUNING.items():
        group.add_argument(flag(name), **how)
    tune.add_argument("--trust", action="store_true", help="run the code that --space names")
    add_fields(tune, [n for n in FIELDS if n not in fields_with("decided_by_study")], values)
    where = tune.add_argument_group("where it trains")
    for name, how in place.items():
        where.add_argument(flag(name), **how)


def tune_from_flags(values: dict[str, Any], say: Callable[[str], None]) -> None:
    """Tunes as the flags say, and prints what was found.

    Raises:
      BadInput: flags that cannot be used.
      SaunaError: no trial ended well.
    """
    from sauna.experiments.tune.command import tune
    from sauna.experiments.tune.results import PAGE, lines

    options = {name: values.pop(name) for name in _TUNING}
    options |= {name: whole_number(name, options[name], 0) for name in _WHOLE}
    jobs = whole_number("processes", values["processes"], 0)
    own = ("processes", "on", "address", "out", "trust", "accept_changed_code")
    where = {name: values.pop(name) for name in own}
    if not values["env"]:
        raise BadInput("env: no environment given; try `sauna tune Pendulum-v1`")
    found, folder = tune(
        values,
        Path(where["out"]),
        trust=where["trust"],
        jobs=jobs,
        on=where["on"],
        address=where["address"],
        accept_changed_code=where["accept_changed_code"],
        say=say,
        **options,
    )
    print("\n".join(lines(found, folder)))
    print(f"page: {folder / PAGE}")
    if found["best"] is None:
        raise SaunaError("no trial ended well; the table above says why")
