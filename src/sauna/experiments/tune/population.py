"""Population-based training: the worst copy the best and change its settings while they train.

    M. Jaderberg et al. (2017), Population Based Training of Neural Networks, arXiv:1711.09846

The members are the arms of one run, in lockstep. At equal intervals the run pauses, its checkpoint
is changed as `exchange` says, and the run goes on from that. A checkpoint names the settings of the
members at its iteration, so that a killed population goes on from its newest one, and makes an
exchange that was lost again, the same: draws follow from the seed and the iteration.

    population/run               the run
    population/exchanges.jsonl   every exchange

On a cluster each member is a run of its own: see `population_on_cluster.py`.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sauna.config.presets import RunConfig
from sauna.config.settings import FIELDS, to_json
from sauna.config.stored import read_stored, to_stored
from sauna.experiments.tune.batch import Tuning, prepared_batch, train
from sauna.experiments.tune.plan import Plan
from sauna.experiments.tune.space import Range, Space, as_choice, start_of
from sauna.system import checkpoint, run_directory
from sauna.system.errors import BadInput
from sauna.system.safe_write import own_folder, replace_file
from sauna.training.prepare import Prepared

FOLDER, LOG, UNITS = "population", "exchanges.jsonl", "units"
EXPLOITED = 0.2  # share of the members that are replaced, and of those that are copied
FACTORS = (0.8, 1.2)  # that change a number
DRAWN_ANEW = 0.25  # probability with which a setting is drawn from its range instead
DONE = "exchanged"  # in the manifest of a checkpoint that was changed
FORMER = ("format", "iteration", "sha256", "bytes", "manifest_sha256", DONE)  # written anew
POINTS = 20  # of a member's curve that are kept
# What is a member's own and stays, by the first part of an array's name; the rest is learned.
OWN = ("counters", "collect", "envs", "evaluation", "best")
LEARNED = ("collect/observation_moments", "collect/reward_moments")  # as the device keeps them


class Exchange(NamedTuple):
    """One member that copied another.

    Attributes:
      iteration: at whose start.
      env_steps: of each member until then.
      member, source: who copied whom; numbers.
      score, source_score: mean return of the episodes since the exchange before.
      copied: the source's settings.
      settings: what the member goes on with.
    """

    iteration: int
    env_steps: int
    member: int
    source: int
    score: float
    source_score: float
    copied: dict[str, Any]
    settings: dict[str, Any]


def arm_of(number: int) -> str:
    """Names the arm of a member."""
    return f"member-{number}"


def samples_of(start: Prepared) -> int:
    """Counts the env steps of a member's iteration."""
    return start.config.rollout_steps * start.config.envs


def iterations_between(plan: Plan, start: Prepared) -> int:
    """Counts the iterations between two exchanges."""
    return max(plan.exchange_every // samples_of(start), 1)


def check_population(plan: Plan, start: Prepared) -> None:
    """Refuses a population that cannot be trained.

    Raises:
      BadInput: there are several seeds, members may end early, or no exchange would happen.
    """
    config = start.config
    if len(plan.seeds) > 1:
        raise BadInput("seeds: a population has one, which all its members share")
    if config.filter != "none" and config.dropped == "replace":
        raise BadInput(
            "dropped: the members of a population need iterations of equally many env steps; "
            "give mask (--dropped mask)"
        )
    for name in ("stop_at", "stop_when_flat"):
        if getattr(config, name) != FIELDS[name].default:
            raise BadInput(f"{name}: a population trains to its end; leave it out")
    if iterations_between(plan, start) >= config.steps // samples_of(start):
        raise BadInput(
            f"exchange_every: the first exchange, after {plan.exchange_every} env steps, would "
            f"come after the last iteration"
        )


class Population:
    """A population of a plan in a folder."""

    def __init__(self, tuning: Tuning) -> None:
        plan, start, folder, self._display, self._accept = tuning
        self._plan, self._start = plan, start
        self._folder, self._run = folder / FOLDER, folder / FOLDER / "run"
        self._space, self._samples = plan.space, samples_of(start)
        self._every = iterations_between(plan, start)

    def run(self) -> None:
        """Trains the population to its end.

        Raises:
          BadInput: it was begun on a cluster, or on this machine and is to go on on one.
          Interrupted: a signal came; running again continues.
          SaunaError: the training failed.
        """
        own_folder(self._folder)
        self._check_begun()
        whole = {
            arm_of(number): {**self._plan.settings, **settings}
            for number, settings in enumerate(self._first())
        }
        first = prepared_batch(whole, self._plan.seeds, self._start, self._run)
        at, last = self._begin(first), first.config.steps // self._samples
        if at is None:
            return
        for iteration in range(self._every, last, self._every):
            if iteration > at:
                self._train(first, iteration)
            if iteration >= at:
                self._exchange(iteration)
        self._train(first, None)

    def _check_begun(self) -> None:
        if (self._folder / UNITS).is_dir():
            raise BadInput("on: this population was begun on a cluster; give --on ray")

    def _begin(self, first: Prepared) -> int | None:
        """The iteration that the population has reached; None if it is complete."""
        if run_directory.is_complete(self._run):
            return None
        return aligned(self._run, self._display().say, to_stored(first.run))

    def _train(self, first: Prepared, until: int | None) -> None:
        train(first, self._display(), None, self._accept, until)

    def _first(self) -> list[dict[str, Any]]:
        """The settings with which the members begin; the first has the start's."""
        found = []
        for number in range(self._plan.trials):
            draw = np.random.default_rng([self._plan.seeds[0], number])
            found.append({name: drawn(one, draw) for name, one in self._space.items()})
        found[0] |= start_of(self._space, self._start.config)
        return found

    def _exchange(self, iteration: int) -> None:
        """Changes the checkpoint at `iteration` and logs how, unless that was done."""
        newest = checkpoint.load_newest(self._run / "checkpoints", self._display().say)
        assert newest is not None and newest.manifest["iteration"] == iteration
        if DONE in newest.manifest:
            return
        run = read_stored(newest.manifest)
        rows = run_directory.rows(self._run)
        names = [arm_of(number) for number in range(self._plan.trials)]
        of_arm = [[row for row in rows if row["arm"] == name] for name in names]
        scores = [self._score(own, iteration) for own in of_arm]
        settings = [settings_in(run, name, self._space) for name in names]
        made = self._decided(scores, settings, iteration)
        arrays = dict(newest.arrays)
        for one in made:
            arrays |= copied(newest.arrays, *(self._member(n) for n in (one.source, one.member)))
            run = with_settings(run, arm_of(one.member), one.settings)
        self._log(made, iteration)
        self._save(newest, arrays, run, self._run)

    def _decided(
        self, scores: Sequence[float], settings: Sequence[Mapping[str, Any]], iteration: int
    ) -> list[Exchange]:
        draw = np.random.default_rng([self._plan.seeds[0], self._plan.trials, iteration])
        steps = iteration * self._samples
        return exchanges(scores, settings, self._space, draw, iteration, steps)

    def _member(self, number: int) -> str:
        return f"{arm_of(number)}/{self._plan.seeds[0]}"

    def _score(self, rows: list[dict[str, Any]], iteration: int) -> float:
        """Mean return of a member's episodes since the last exchange; NaN without any."""
        recent = [row for row in rows if iteration - self._every <= row["iteration"]]
        returns = [return_ for row in recent for return_ in row["episode_returns"]]
        return float(np.mean(returns)) if returns else math.nan

    def _log(self, made: Sequence[Exchange], iteration: int) -> None:
        """Logs exchanges; those of a later state, which a kill has undone, go."""
        before = [row for row in exchanges_in(self._folder.parent) if row["iteration"] < iteration]
        rows = [*before, *(one._asdict() for one in made)]
        text = "".join(json.dumps(row) + "\n" for row in rows)
        replace_file(self._folder / LOG, text.encode())

    def _save(
        self,
        newest: checkpoint.Checkpoint,
        arrays: dict[str, np.ndarray],
        run: RunConfig,
        path: Path,
    ) -> None:
        """Puts the changed checkpoint of the run at `path` in the place of the one before."""
        stored = run_directory.read_config(path)
        iteration = newest.manifest["iteration"]
        manifest = {name: value for name, value in newest.manifest.items() if name not in FORMER}
        manifest |= {**to_stored(run), DONE: True}
        former = newest.path.with_name(f".writing-before-{iteration:08d}")
        shutil.rmtree(former, ignore_errors=True)
        newest.path.rename(former)
        keep = run.config.keep_checkpoints
        checkpoint.save_checkpoint(newest.path.parent, iteration, arrays, manifest, keep)
        run_directory.write_config(path, {**stored, **to_stored(run)})

    def ended(self) -> list[dict[str, Any]]:
        """Lists the members as JSON values, as `Search.ended` lists trials."""
        if not (self._run / "config.json").is_file():
            return []
        run = read_stored(run_directory.read_config(self._run))
        rows = run_directory.rows(self._run)
        state = "complete" if run_directory.is_complete(self._run) else "running"
        found = []
        for number in range(self._plan.trials):
            own = [row for row in rows if row["arm"] == arm_of(number)]
            settings = settings_in(run, arm_of(number), self._space)
            found.append(self._as_json(number, settings, own) | {"state": state})
        return found

    def importance(self) -> dict[str, float]:
        """Nothing: the settings of a member change."""
        return {}

    def _as_json(
        self, number: int, settings: dict[str, Any], rows: list[dict[str, Any]]
    ) -> dict[str, Any]:
        steps = self._plan.steps
        curve = [[r["env_steps"] / steps, r["return_mean"]] for r in rows if "return_mean" in r]
        places = np.linspace(0, len(curve) - 1, POINTS if curve else 0).astype(int)
        return {
            "number": number,
            "return": curve[-1][1] if curve else None,
            "env_steps": rows[-1]["env_steps"] if rows else 0,
            "searched": settings,
            "settings": settings,
            "curve": [curve[i] for i in np.unique(places).tolist()],
        }


def drawn(one: Range, draw: np.random.Generator) -> Any:
    """Draws a value of a range."""
    if one.choices:
        return one.choices[int(draw.integers(len(one.choices)))]
    if one.log:
        value = math.exp(draw.uniform(math.log(one.low), math.log(one.high)))
    else:
        value = float(draw.uniform(one.low, one.high))
    return one.inside(value)


def explored(one: Range, value: Any, draw: np.random.Generator) -> Any:
    """Changes a value: a number by a factor, a choice to one beside it; or draws it anew."""
    if draw.random() < DRAWN_ANEW:
        return drawn(one, draw)
    up = bool(draw.random() < 0.5)
    if one.choices:
        place = one.choices.index(one.inside(value)) + (1 if up else -1)
        return one.choices[min(max(place, 0), len(one.choices) - 1)]
    return one.inside(value * FACTORS[up])


def exchanges(
    scores: Sequence[float],
    settings: Sequence[Mapping[str, Any]],
    space: Space,
    draw: np.random.Generator,
    iteration: int,
    env_steps: int,
) -> list[Exchange]:
    """Decides who copies whom, by truncation, and with which settings they go on.

    Each of the worst fifth copies one of the best fifth, drawn at random, that is better. A member
    without a score takes no part.

    Args:
      scores: of the members; NaN if no episode has ended.
      settings: of the members, as they are searched.
    """
    ranked = [n for n in np.argsort(scores, kind="stable").tolist() if math.isfinite(scores[n])]
    number = max(1, round(EXPLOITED * len(ranked)))
    if len(ranked) < 2:
        return []
    made = []
    for member in ranked[:number]:
        source = ranked[-1 - int(draw.integers(number))]
        if scores[source] <= scores[member]:
            continue
        from_ = dict(settings[source])
        after = {name: explored(one, from_[name], draw) for name, one in space.items()}
        pair = scores[member], scores[source]
        made.append(Exchange(iteration, env_steps, member, source, *pair, from_, after))
    return made


def copied(arrays: Mapping[str, np.ndarray], source: str, member: str) -> dict[str, np.ndarray]:
    """Returns what `source` has learned under `member`'s names: parameters, optimizer, moments.

    Its counters, its environments and their episodes stay the member's own.
    """
    return {
        f"{member}/{name}": array
        for name, array in checkpoint.under(f"{source}/", arrays).items()
        if name.split("/")[0] not in OWN or name.startswith(LEARNED)
    }


def aligned(path: Path, say: Callable[[str], None], before: Mapping[str, Any]) -> int:
    """Makes a run's config that of its newest checkpoint; returns the iteration of it.

    Args:
      path: of the run, which may not be there.
      before: the config without a checkpoint.
    """
    if not (path / "config.json").is_file():
        return 0
    newest = checkpoint.load_newest(path / "checkpoints", say)
    settings = newest.manifest if newest else before
    stored = run_directory.read_config(path)
    run_directory.write_config(
        path, {**stored, **{name: settings[name] for name in ("config", "arms")}}
    )
    return int(newest.manifest["iteration"]) if newest else 0


def settings_in(run: RunConfig, arm: str, space: Space) -> dict[str, Any]:
    """The searched settings of an arm."""
    values = to_json(run.arms[arm])
    return {name: as_choice(values[name]) for name in space}


def with_settings(run: RunConfig, arm: str, settings: Mapping[str, Any]) -> RunConfig:
    """Changes the settings of one arm."""
    return RunConfig(run.config, {**run.arms, arm: dataclasses.replace(run.arms[arm], **settings)})


def exchanges_in(folder: Path) -> list[dict[str, Any]]:
    """Reads the log of exchanges of a tuning; nothing if it has none."""
    path = folder / FOLDER / LOG
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]
