"""What a tuning is: where it starts, what it searches, and how."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from sauna.config.accepted import translate
from sauna.config.arms import fixed_by
from sauna.config.checks import is_read
from sauna.config.presets import chosen_preset, parse_all, plain
from sauna.config.settings import FIELDS, Config
from sauna.experiments.study.units import digest_of
from sauna.experiments.tune.space import GROUPS, Space, default_space, read_space, traced
from sauna.system.errors import BadInput
from sauna.training.pick import pick
from sauna.training.prepare import Prepared, check_own_parts, prepare

SEARCHES = ("tpe", "random")
PRUNERS = ("median", "hyperband", "none")
FINALIST_SEEDS = 3  # that the finalists are trained with
FIRST_FRESH = 1000  # the first fresh seed, unless the trials have such seeds themselves
EXCHANGES = 10  # of a population, if nobody says how often


class Plan(NamedTuple):
    """A tuning, resolved.

    Attributes:
      settings: of every trial, before what is searched; without seeds.
      steps: env steps of a trial.
      default: those of the preset that `sauna train ENV` takes by itself.
      seeds: of each trial; its score is their mean.
      values: what is searched, as JSON values.
      trials: how many settings are tried; of a population, its members.
      lockstep: how many trials are trained in one program.
      search, pruner: Optuna's, one of `SEARCHES` and `PRUNERS`.
      finalists: how many of the best trials are trained with further seeds, to choose among them.
      fresh: how many fresh seeds what was found is trained with.
      exchange_every: env steps between the exchanges of a population; 0: no population.
    """

    settings: dict[str, Any]
    steps: int
    default: dict[str, Any]
    seeds: tuple[int, ...]
    values: dict[str, Any]
    trials: int
    lockstep: int
    search: str
    pruner: str
    finalists: int
    fresh: int
    exchange_every: int

    @property
    def env(self) -> str:
        """The task."""
        return str(self.settings["env"])

    @property
    def space(self) -> Space:
        """What is searched."""
        return read_space(self.values)

    @property
    def preset(self) -> str:
        """The preset that `sauna train ENV` takes by itself."""
        return chosen_preset(parse_all(self.default))

    @property
    def fresh_seeds(self) -> list[int]:
        """Seeds that neither a trial nor a finalist has seen."""
        first = FIRST_FRESH if max(self.seeds) < FIRST_FRESH - FINALIST_SEEDS else self._after
        return list(range(first, first + self.fresh))

    @property
    def finalist_seeds(self) -> list[int]:
        """Seeds that no trial has seen."""
        return list(range(max(self.seeds) + 1, self._after))

    @property
    def _after(self) -> int:
        return max(self.seeds) + 1 + FINALIST_SEEDS

    def identity(self) -> dict[str, Any]:
        """Returns what may not change when the tuning is continued, as JSON values."""
        free = ("finalists", "fresh", *(() if self.exchange_every else ("trials",)))
        values = self._asdict() | {"seeds": list(self.seeds)}
        return {name: value for name, value in values.items() if name not in free}

    def name(self) -> str:
        """Names the folder of the tuning after its settings."""
        place = "".join(c if c.isalnum() or c in "-." else "-" for c in self.env)
        return f"tune_{place}_{digest_of(self.identity())}"


def make_plan(
    given: Mapping[str, Any],
    space: Mapping[str, Any] | None,
    *,
    trials: int,
    lockstep: int,
    search: str,
    pruner: str,
    finalists: int,
    fresh: int,
    population: bool,
    exchange_every: int,
) -> tuple[Plan, Prepared, str]:
    """Makes the plan of a tuning from what a user gives.

    Args:
      given: settings of a run, which every trial starts from.
      space: what is searched; None: the default for the algorithm.

    Returns:
      the plan, its start as a run, and what is to be said of the preset.

    Raises:
      BadInput: something cannot be used.
    """
    picked = pick(given)
    settings = plain(translate(picked.overrides))
    settings.pop("out", None)
    seeds = parse_all({"seeds": settings.pop("seeds", [0])})["seeds"]
    start = prepare({**settings, "seeds": list(seeds)})
    if len(start.config.arm) > 1:
        raise BadInput("arm: a tuning has one arm")
    if start.config.init_from:
        raise BadInput("init_from: not read by a tuning, whose trials start afresh")
    check_own_parts(start)
    values = dict(space) if space is not None else default_space(start.config)
    if population:
        values = _of_population(values, start.config, given_space=space is not None)
        exchange_every = exchange_every or max(start.config.steps // EXCHANGES, 1)
    _check_searched(values, start.config)
    return (
        Plan(
            settings,
            start.config.steps,
            _default(settings),
            seeds,
            values,
            trials,
            lockstep,
            search,
            pruner,
            finalists,
            fresh,
            exchange_every,
        ),
        start,
        picked.said,
    )


def _of_population(values: dict[str, Any], config: Config, given_space: bool) -> dict[str, Any]:
    """Keeps what an exchange can change.

    Raises:
      BadInput: the user wants to search something else.
    """
    space = read_space(values)
    kept = traced(space)
    if given_space and (fixed := [name for name in space if name not in kept]):
        raise BadInput(
            f"space: {', '.join(fixed)} shapes the program, which a population shares; leave it "
            f"out or tune without --population-based"
        )
    followed = config.learning_rate_schedule == "kl" and "learning_rate" in kept
    if given_space and followed:
        raise BadInput(
            "space: learning_rate is not read after the start of a population with "
            "learning_rate_schedule kl; leave it out"
        )
    return {name: values[name] for name in kept if not (followed and name == "learning_rate")}


def _check_searched(values: Mapping[str, Any], config: Config) -> None:
    """Refuses what cannot be searched, or what the start of the trials would not read.

    Raises:
      BadInput: naming the setting.
    """
    space, arm = read_space(values), config.arm[0]
    if "batch_size" in space and "minibatches" in space:
        raise BadInput("space: give either batch_size or minibatches")
    for name in space:
        field = "minibatches" if name == "batch_size" else name
        if field in fixed_by(arm):
            raise BadInput(f"space: {name} is fixed by arm {arm}")
        if not is_read(field, config):
            needed = FIELDS[field].metadata["read_when"][0]
            raise BadInput(f"space: {name} is not read by the trials; it needs {needed}")


def _default(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Lists the settings of the preset that is taken by itself: task, steps and place stay."""
    learned = [name for name in settings if FIELDS[name].metadata["group"] in GROUPS]
    kept = {n: v for n, v in settings.items() if n not in learned and n != "preset"}
    return plain(pick(kept).overrides)
