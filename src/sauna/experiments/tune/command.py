"""`sauna tune`: searches settings, trains what was found on fresh seeds, says what came of it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sauna.config.trust import seal
from sauna.experiments.study.execute import ray_cluster
from sauna.experiments.study.results import typed
from sauna.experiments.tune import fresh, results, storage
from sauna.experiments.tune.batch import Tuning
from sauna.experiments.tune.on_cluster import ClusterSearch
from sauna.experiments.tune.plan import PRUNERS, SEARCHES, Plan, make_plan
from sauna.experiments.tune.population import Population, check_population
from sauna.experiments.tune.population_on_cluster import ClusterPopulation
from sauna.experiments.tune.search import Search
from sauna.experiments.tune.space import load_space
from sauna.system import run_directory
from sauna.system.errors import BadInput, Interrupted
from sauna.system.signals import handled
from sauna.system.working_folder import kept_folder
from sauna.training.display import Display, make_display

# The options of a tuning besides the settings of its trials, with their defaults.
OPTIONS: dict[str, Any] = {
    "trials": 50,
    "space": "",
    "lockstep": 4,
    "search": "tpe",
    "pruner": "median",
    "finalists": 4,
    "fresh_seeds": 5,
    "population_based": False,
    "exchange_every": 0,
}
OF_TRIALS = ("lockstep", "search", "pruner")  # not read by a population


class Where(NamedTuple):
    """Where a tuning trains; see `tune`."""

    jobs: int
    on: str
    address: str

    @property
    def flags(self) -> str:
        """What a user types to train there."""
        if self.on == "local":
            return ""
        return f" --on {self.on}" + (f" --address {self.address}" if self.address else "")


def tune(
    given: Mapping[str, Any],
    out: Path,
    *,
    trust: bool = False,
    jobs: int = 0,
    on: str = "local",
    address: str = "",
    accept_changed_code: bool = False,
    display: Callable[[], Display] = make_display,
    say: Callable[[str], None] = print,
    **options: Any,
) -> tuple[dict[str, Any], Path]:
    """Searches settings for a task, or continues to.

    Args:
      given: settings of a run, from which the trials start, `env` among them.
      out: the folder in which that of the tuning is made, named after its settings.
      trust: the space may name code.
      jobs: processes that share the trials of a batch, and fresh trainings at a time; on a cluster
        trainings at a time; 0: one per core.
      on: `local`, or `ray`: the Ray cluster at `address`, or a new one on this machine.
      address: of the cluster.
      accept_changed_code: continue runs whose code is not what it was.
      display: makes what shows a training.
      say: is called with each line of the output.
      **options: see `OPTIONS`.

    Returns:
      what `results.json` holds, and the folder of the tuning.

    Raises:
      BadInput: something cannot be used; nothing was created.
      Interrupted: a signal came; the same command continues.
      SaunaError: the disk failed, or the code of the environment has changed.
    """
    options = {**OPTIONS, **options}
    _check(options)
    values = load_space(options["space"], trust) if options["space"] else None
    if not options["population_based"]:
        storage.check_installed()
    _check_where(on, address)
    out = Path.cwd() / out
    if jobs and on == "local":  # a cluster may have another size when the tuning goes on
        given = {**given, "processes": jobs}
    command = tune_command(given, out, options)
    with kept_folder():
        plan, start, said = make_plan(
            given,
            values,
            trials=options["trials"],
            lockstep=options["lockstep"],
            search=options["search"],
            pruner=options["pruner"],
            finalists=options["finalists"],
            fresh=options["fresh_seeds"],
            population=options["population_based"],
            exchange_every=options["exchange_every"],
        )
        if plan.exchange_every:
            check_population(plan, start)
        place = _make_place(plan, out)
        with run_directory.lock(place):
            _note(plan, place)
            if said:
                say(said)
            if plan.fresh and (note := fresh.unfit_preset(plan)):
                say(f"note: {note}")
            say(_opening(plan, place))
            tuning = Tuning(plan, start, place, display, accept_changed_code)
            return _tune(tuning, command, Where(jobs, on, address), say), place


def _check_where(on: str, address: str) -> None:
    """Refuses a place where the tuning cannot train.

    Raises:
      BadInput: naming the option.
    """
    if on == "local":
        if address:
            raise BadInput("address: read with --on ray only")
    else:
        ray_cluster.check(address)


def _tune(tuning: Tuning, command: str, where: Where, say: Callable[[str], None]) -> dict[str, Any]:
    plan, place = tuning.plan, tuning.folder
    search = _search(tuning, where, say)
    try:
        with handled(_raise):
            search.run()
    except KeyboardInterrupt as error:  # what there is so far is kept, and shown
        results.write(plan, search, place, command)
        number = error.signal_number if isinstance(error, Interrupted) else 2
        raise Interrupted(number, f"stopped; continue with: {command}{where.flags}") from None
    written = results.write(plan, search, place, command)
    how = {**where._asdict(), "accept_changed_code": tuning.accept_changed_code}
    if plan.finalists > 1:
        fresh.try_finalists(plan, written["trials"], place, command, **how)
        written = results.write(plan, search, place, command)
    if plan.fresh and written["best"] is not None:
        say(f"trial {written['best']['number']} is best; it is tried on fresh seeds")
        fresh.evaluate(plan, written["best"]["settings"], place, command, **how)
        written = results.write(plan, search, place, command)
    return written


def _search(tuning: Tuning, where: Where, say: Callable[[str], None]) -> Search | Population:
    population = bool(tuning.plan.exchange_every)
    if where.on == "ray":
        make = ClusterPopulation if population else ClusterSearch
        return make(tuning, where.jobs, where.address, say)
    return (Population if population else Search)(tuning)


def _raise(number: int) -> None:
    raise Interrupted(number, "stopped")


def _check(options: Mapping[str, Any]) -> None:
    """Refuses options that cannot be used, or that nothing reads.

    Raises:
      BadInput: naming the option.
    """
    for name, least in (
        ("trials", 1),
        ("lockstep", 1),
        ("finalists", 1),
        ("fresh_seeds", 0),
        ("exchange_every", 0),
    ):
        if options[name] < least:
            raise BadInput(f"{name}: must be at least {least}, not {options[name]}")
    for name, known in (("search", SEARCHES), ("pruner", PRUNERS)):
        if options[name] not in known:
            raise BadInput(f"{name}: unknown value {options[name]!r} (known: {', '.join(known)})")
    if options["population_based"]:
        for name in OF_TRIALS:
            if options[name] != OPTIONS[name]:
                raise BadInput(f"{name}: not read with population_based")
        if options["trials"] < 2:
            raise BadInput("trials: a population needs at least 2 members")
    elif options["exchange_every"]:
        raise BadInput("exchange_every: only read with population_based")


def tune_command(given: Mapping[str, Any], out: Path, options: Mapping[str, Any]) -> str:
    """Returns what a user types to continue a tuning, or to make it again."""
    changed = {name: value for name, value in options.items() if value != OPTIONS[name]}
    words = [typed(name, value) for name, value in (*given.items(), *changed.items())]
    words = [word for word in words if not word.startswith("--env ")]
    words = ["--population-based" if w.startswith("--population-based") else w for w in words]
    place = "" if out == Path.cwd() / "runs" else f" {typed('out', str(out))}"
    return " ".join(["sauna tune", shlex.quote(str(given["env"])), *words]) + place


def _make_place(plan: Plan, out: Path) -> Path:
    place = out / plan.name()
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"out: cannot make {place}: {error.strerror}") from error
    return place


def _note(plan: Plan, place: Path) -> None:
    """Notes what the tuning is, or checks that the folder is its own.

    Raises:
      BadInput: it is another one's.
    """
    path, identity = place / "tune.json", plan.identity()
    if path.is_file() and run_directory.read_config_file(path).get("tune") != identity:
        raise BadInput(f"out: {place} holds another tuning; remove it or give --out")
    run_directory.write_json(path, {"tune": identity, "seal": seal(identity)})


def _opening(plan: Plan, place: Path) -> str:
    names = ", ".join(plan.values)
    what = f"{plan.trials} trials"
    if plan.exchange_every:
        what = f"a population of {plan.trials}, exchanges every {plan.exchange_every:,} env steps"
    return f"tune {plan.env}: {what}, over {names}; writing to {place}"
