"""The Python interface: `sauna.train`, `sauna.resume`, `sauna.load`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePath
from typing import Any

from sauna.config.accepted import translate
from sauna.config.flags import lists_settings
from sauna.config.imported_from import names_the_folder
from sauna.config.plugins import is_local, name_of, provide
from sauna.config.presets import COMPARED, parse_all
from sauna.config.settings import FIELDS, fields_with
from sauna.envs.make import check_makes, known_in_this_process_alone
from sauna.experiments.report.curve import curve_figure, draw_curve
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError
from sauna.training import run as runs
from sauna.training.coordinator import Callback
from sauna.training.display import Display, PlainDisplay, make_display
from sauna.training.pick import pick
from sauna.training.train import train_run

_OF_TRAIN = [name for name in FIELDS if name != "env"]
_OF_COMPARE = [name for name in _OF_TRAIN if name not in (*fields_with("decided_by_study"), "arm")]
PARTS = fields_with("plugin")  # what a user may pass by value


def _env_name(env: Any) -> str:
    """Names an environment; an id that this program registered is a part of this process.

    Raises:
      BadInput: it is an environment itself, or makes none.
    """
    if isinstance(env, str):
        if not known_in_this_process_alone(env):
            return env
        import gymnasium

        return name_of(partial(gymnasium.make, env, disable_env_checker=True))
    name = name_of(env)
    check_makes(name, env)
    return name


class Result:
    """A finished run: its directory, its numbers, its figure, its policies.

    Args:
      path: the run directory.

    Raises:
      BadInput: there is no run.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not (self.path / "config.json").is_file():
            raise BadInput(f"{self.path} is no run: it has no config.json")

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """The rows of `metrics.jsonl`, one per iteration and member."""
        return run_directory.rows(self.path)

    @property
    def summary(self) -> dict[str, Any]:
        """`member name -> final numbers`, as in `summary.json`.

        Raises:
          SaunaError: the run has not come to an end, so that it has no summary yet.
        """
        if not (self.path / "summary.json").is_file():
            raise SaunaError(f"{self.path} has no summary yet: it was cut short, or still trains")
        return run_directory.read_config_file(self.path / "summary.json")["members"]

    def plot(self) -> Any:
        """Draws the learning curves, mean and seeds of each arm, as a matplotlib figure.

        Raises:
          SaunaError: no episode has finished.
        """
        figure = curve_figure(self.path)
        if figure is None:
            raise SaunaError(f"{self.path}: no episode has finished, so there is no curve")
        return figure

    def table(self, of: str = "members") -> Any:
        """A pandas DataFrame, or a list of dicts if pandas is not installed.

        Args:
          of: "members": the final numbers of each; "metrics": the rows of `metrics.jsonl`.

        Raises:
          BadInput: `of` is something else.
        """
        if of not in ("members", "metrics"):
            raise BadInput(f"table: of must be 'members' or 'metrics', not {of!r}")
        rows = self.metrics
        if of == "members":
            rows = [{"member": name, **numbers} for name, numbers in self.summary.items()]
        try:
            import pandas
        except ImportError:
            return rows
        return pandas.DataFrame(rows)

    def policy(self, member: int | str = 0, *, best: bool = False) -> Any:
        """The trained policy of a member, as `policy(observation) -> action`.

        With `best`, it is the policy of the member's best evaluation during training.
        """
        return load(self.path, member, best=best, trust=True)

    def __repr__(self) -> str:
        return f"Result({str(self.path)!r})"


class _Silent(PlainDisplay):
    def say(self, text: str) -> None:
        pass


@lists_settings(_OF_TRAIN)
def train(
    env: Any,
    *,
    quiet: bool = False,
    callback: Callback | None = None,
    trust: bool = False,
    **settings: Any,
) -> Result:
    """Trains PPO (or A2C), with SAUNA or without, on `env` and returns the finished run.

    Args:
      env: a Gymnasium id, `module:function`, or a function that makes an environment.
      quiet: show nothing.
      callback: called with each row of `metrics.jsonl`, in their order; if it returns True, the
        row's member stops there. It runs in this process. An exception of its ends the run.
      trust: the run of `init_from` may name code of another user's; none of it runs.
      **settings: any field of `sauna.config.settings.Config` (`arm="sauna"`, `seeds=6`,
        `steps=1_000_000`), `seed=7` for the one seed 7, `batch_size` for samples per minibatch;
        functions, flax modules, filters and targets may be passed by value.

    Raises:
      BadInput: a setting is not usable; nothing was created.
      SaunaError: training failed; the last good checkpoint is on disk.
    """
    given = {"env": _env_name(env), **{n: _named(n, v) for n, v in settings.items()}}
    picked = pick(given)
    overrides = translate(picked.overrides)
    display: Display = _Silent() if quiet else make_display()
    run = runs.start(overrides, display, picked.found, trust)
    if picked.said:
        display.say(picked.said)
    train_and_draw(run, display, resume=False, callback=callback)
    return Result(run.path)


def train_and_draw(
    run: runs.Run,
    display: Display,
    *,
    resume: bool,
    inexact: bool = False,
    callback: Callback | None = None,
) -> None:
    """Trains a run to its end, or to where a signal stops it, and draws its learning curve.

    Raises:
      BadInput, Interrupted, SaunaError: as `train_run`.
    """
    train_run(run, display, resume=resume, inexact=inexact, callback=callback, draw=draw_curve)


@lists_settings(_OF_COMPARE)
def compare(
    env: Any,
    *,
    arms: Sequence[str] | str = COMPARED,
    rules: Sequence[str] | str = (),
    controls: bool = True,
    out: str | Path = "runs",
    processes: int = 0,
    quiet: bool = False,
    accept_changed_code: bool = False,
    **settings: Any,
) -> dict[str, Any]:
    """Does a selection rule help on `env`? Trains the arms and says what the data support.

    The same as `sauna compare`: called again, it continues where it was stopped.

    Args:
      env: a Gymnasium id, `module:function`, or a function that another process can import.
      arms: what to compare, also `"module:name"` of a rule of your own; the first is the baseline.
        `"all"`: a tournament of every rule.
      rules: a tournament of ppo and these instead: more seeds only where something is open.
      controls: each arm that chooses samples gets its matched random control.
      out: the folder of runs and results.
      processes: trainings at a time; 0: one per core.
      quiet: show nothing.
      accept_changed_code: take runs of before as they are, even if their code is not what it was.
      **settings: of every run (`seeds=6`, `steps=1_000_000`).

    Returns:
      the summary: its `table`, its `verdicts`, those on the filter alone (`filtering`);
      `report.html` beside it is the same to look at.

    Raises:
      BadInput: something is not usable; nothing was created.
    """
    from sauna.experiments.study.command import chosen_arms, compare_command, comparison, study

    overrides = {"env": _env_name(env), **{n: _named(n, v) for n, v in _given(settings).items()}}
    for name in PARTS:
        if is_local(str(overrides.get(name))):
            raise BadInput(f"{name}: other processes cannot import it; put it into a module")
    overrides = translate(overrides)
    task = overrides.pop("env")
    arms, rules, parsed = _names(arms), _names(rules), parse_all(overrides)
    chosen, is_tournament = chosen_arms(arms, rules, controls, parsed)
    spec = comparison(task, chosen, parsed, is_tournament)
    command = compare_command(task, arms, overrides, out, rules, controls)
    accept = accept_changed_code
    return study(spec, Path(out), command, processes, quiet=quiet, accept_changed_code=accept)


def resume(
    path: str | Path,
    *,
    quiet: bool = False,
    inexact: bool = False,
    trust: bool = False,
    accept_changed_code: bool = False,
    restart_schedule: bool = False,
    callback: Callback | None = None,
    **changes: Any,
) -> Result:
    """Continues a run to its end; the result is that of a run left alone.

    With more `steps`, a run that has ended is trained further.

    Args:
      path: the run directory.
      quiet: show nothing.
      inexact: start new episodes where environments cannot be brought back.
      trust: the code that the run names may run, even if another user named it.
      accept_changed_code: go on even if the code that the run names is not what it was.
      restart_schedule: with more `steps`, schedules begin anew over those that are added.
      callback: as in `train`; it is called with the rows from here on.
      **changes: settings that do not touch what is computed (`processes`, ...), those that say how
        far the run goes and how it is watched (`steps`, `eval_every`, ...), and the parts
        (`env`, `network`, `filter`, `vex_target`) that were passed by value when the run started.
    """
    display: Display = _Silent() if quiet else make_display()
    named = {n: _named(n, v) if n == "track" else v for n, v in _given(changes).items()}
    rest = provide(Path(path), named, PARTS)
    how = trust, accept_changed_code, restart_schedule, inexact, callback
    run = runs.reopen(Path(path), rest, display, *how)
    train_and_draw(run, display, resume=True, inexact=inexact, callback=callback)
    return Result(run.path)


@names_the_folder
def load(
    path: str | Path,
    member: int | str = 0,
    *,
    checkpoint: int | None = None,
    best: bool = False,
    trust: bool = False,
    **parts: Any,
) -> Any:
    """The policy of a run, as `policy(observation) -> action`.

    The action is the most likely one; `policy(observation, deterministic=False, key=...)` samples.

    Args:
      path: the run directory; or an exported policy: its folder, `zoo:NAME`, `hf:USER/NAME`.
      member: name (`sauna/0`) or index.
      checkpoint: the iteration of a kept checkpoint; default the newest good one.
      best: as it was at its best evaluation during training (`eval_every`).
      trust: the code that the run names may run, even if another user named it.
      **parts: those that were passed by value when the run started (`env`, `network`, ...).

    Raises:
      BadInput: there is no such run, member or checkpoint, or an argument is unknown.
    """
    from sauna.experiments.evaluate.policy import TrainedPolicy
    from sauna.training.artifact import load_artifact
    from sauna.training.located import locate

    folder = locate(path).folder
    artifact = load_artifact(folder, iteration=checkpoint, trust=trust)
    if rest := provide(folder, parts, PARTS):
        raise BadInput(f"unknown argument {next(iter(rest))!r}")
    return TrainedPolicy(artifact, member, best=best)


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    """Leaves out what is None, which means not given, as in `train`."""
    return {name: value for name, value in settings.items() if value is not None}


def _names(given: Sequence[str] | str) -> tuple[str, ...]:
    """Names in a list, or in a text with commas between them, as `train` takes arms."""
    return tuple(filter(None, given.split(","))) if isinstance(given, str) else tuple(given)


def _named(name: str, value: Any) -> Any:
    """Names a part that was passed by value, and a path; other values stay."""
    if isinstance(value, PurePath):
        return str(value)
    if name in ("track", "wrap") and value is not None and not isinstance(value, str):
        return [name_of(one) for one in (value if isinstance(value, list | tuple) else [value])]
    return name_of(value) if name in PARTS and value is not None else value
