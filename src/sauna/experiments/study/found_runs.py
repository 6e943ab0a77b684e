"""The runs that a study finds: of today's code, and with all their rows."""

from __future__ import annotations

import functools
import shlex
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from sauna.config.code import changed_code, code_of
from sauna.config.own_sources import newer_sources
from sauna.config.rule_sources import unknown_rules
from sauna.experiments.study.units import Unit, parts
from sauna.system import run_directory
from sauna.system.errors import BadInput
from sauna.system.logs import damage_of
from sauna.training.display import counted
from sauna.training.initial import weights_of

NAMED = 5  # runs in a warning


def check_same_code(
    units: list[Unit], folder: Path, accept: bool, say: Callable[[str], None]
) -> None:
    """Refuses to take results of other code for those of today's; a newer version is named.

    A built-in rule that was edited counts as other code, committed or not.

    Args:
      accept: the user has said that they count as today's; the runs note both.

    Raises:
      BadInput: naming what changed.
    """
    newer: Counter[str] = Counter()
    unsure: list[Path] = []  # of another version, which noted no source of its rule
    for unit in (part for whole in units for part in parts(whole, folder)):
        run = unit.run(folder)
        if not (run / "config.json").is_file():
            continue
        stored = run_directory.read_config(run)
        now = code_of(unit.settings)
        changed = changed_code(stored.get("code", now), now)
        if changed and not accept:
            raise BadInput(
                f"{run} was trained with other code: {changed}; --accept-changed-code takes such "
                f"runs as they are, another --out trains all runs anew, rm -r "
                f"{shlex.quote(str(run))} only this one"
            )
        if changed:
            run_directory.write_config(run, run_directory.with_code(stored, now))
        elif text := newer_sources(stored.get("code", {}), now):
            newer[text] += 1
            unsure += [run] * bool(unknown_rules(stored.get("code", {}), now))
    for text, number in newer.items():
        say(f"note: reused: {counted(number, 'run')} of {text}; another --out trains them anew")
    if unsure:
        named, more = shlex.join(map(str, unsure[:NAMED])), len(unsure) - NAMED
        say(
            f"warning: {counted(len(unsure), 'reused run')} did not note the source of the rule; "
            f"if you edited it since, train anew: rm -r {named}"
            + f" (and {more} more)"
            * (more > 0)
        )


def check_same_start(units: list[Unit], folder: Path) -> None:
    """Refuses to take results of other beginnings for those of today's `init_from`.

    Raises:
      BadInput: naming a run that began from one which has been trained further since.
    """
    now = functools.cache(weights_of)  # units often share their beginning
    for unit in (part for whole in units for part in parts(whole, folder)):
        run = unit.run(folder)
        if not unit.settings.get("init_from") or not (run / "config.json").is_file():
            continue
        origin = run_directory.read_config(run).get("initial", {})
        # Recorded episodes have no digest, and the run may be gone.
        if "sha256" in origin and now(origin["run"]) not in (None, origin["sha256"]):
            raise BadInput(
                f"{run} began from iteration {origin['iteration']} of {origin['run']}, which has "
                "other weights now; another --out trains all runs anew, "
                f"rm -r {shlex.quote(str(run))} only this one"
            )


def reopen_damaged(units: list[Unit], folder: Path, say: Callable[[str], None]) -> None:
    """Lets complete runs whose rows are not what was written be continued from before that."""
    for unit in (part for whole in units for part in parts(whole, folder)):
        run = unit.run(folder)
        if unit.is_complete(folder) and (damage := damage_of(run)):
            say(f"warning: {damage}; the run is continued from before that")
            (run / "summary.json").unlink()
