"""The command line: `sauna train | resume | eval | inspect | compare | tune | plot | runs | ...`.

Flags and help lines are made from `Config`'s fields. argparse rather than a larger parser: it
starts in milliseconds, and a mistake can be answered with one line.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from sauna import __version__
from sauna.config.accepted import over, translate
from sauna.config.choices import LISTS, PEERS
from sauna.config.flags import add_fields, shown_values
from sauna.config.other_names import flag_hint, spread_hint
from sauna.config.parsing import whole_number
from sauna.config.presets import COMPARED, COMPARED_SEEDS, parse_all
from sauna.config.settings import FIELDS, fields_with, flag
from sauna.experiments.check import flags as checking
from sauna.experiments.evaluate import MAX_STEPS
from sauna.experiments.share import flags as sharing
from sauna.experiments.tune.flags import add_tune, tune_from_flags
from sauna.system.errors import BadInput, Interrupted, SaunaError, printable
from sauna.system.jax_setup import ON_CPU
from sauna.system.spawn import spawned_ahead
from sauna.system.supported import check_system
from sauna.system.tracebacks import user_frames

# Where a comparison or a study trains.
_PLACE: dict[str, dict[str, Any]] = {
    "out": {
        "default": "runs",
        "metavar": "DIR",
        "help": "where runs and results go (default runs)",
    },
    "processes": {
        "default": "0",
        "metavar": "INT",
        "help": "trainings at a time (default 0: one per core)",
    },
    "on": {
        "default": "local",
        "choices": ("local", "ray"),
        "help": "where to train: this machine, or a Ray cluster (default local)",
    },
    "address": {
        "default": "",
        "help": "of a Ray cluster: HOST:PORT, ray://HOST:PORT or auto (default: start one here)",
    },
    "accept_changed_code": {
        "action": "store_true",
        "help": "go on with runs although the code of their environment or plug-in has changed",
    },
}


class _Parser(argparse.ArgumentParser):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # -1e3, too, as from Python 3.14 on

    def error(self, message: str) -> NoReturn:
        raise BadInput(message)


def make_parser(arguments: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Makes the parser; `arguments` name the preset and arm whose defaults the help shows."""
    values = shown_values(arguments)
    parser = _Parser(
        prog="sauna", description=__doc__.splitlines()[0] if __doc__ else None, allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"sauna {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")

    usage = "sauna %s ENV [--OPTION VALUE ...]"
    text = "train a population"
    train = commands.add_parser("train", help=text, usage=usage % "train", allow_abbrev=False)
    train.add_argument("env", nargs="?", metavar="ENV", help=FIELDS["env"].metadata["help"])
    text = "a run, its config.json, or a JSON file of settings"
    train.add_argument("--config", metavar="RUN|FILE", help=text)
    add_fields(train, [name for name in FIELDS if name != "env"], values)

    resume = commands.add_parser("resume", help="continue a run", allow_abbrev=False)
    resume.add_argument("run", metavar="RUN", help="run directory")
    text = "start new episodes where environments cannot be brought back"
    resume.add_argument("--inexact", action="store_true", help=text)
    text = "with more --steps: schedules begin anew over those that are added"
    resume.add_argument("--restart-schedule", action="store_true", help=text)
    changeable = (*fields_with("extends_run"), *fields_with("resumable"))
    add_fields(resume, changeable, {**values, **dict.fromkeys(FIELDS, "")})

    evaluate = commands.add_parser(
        "eval", help="play episodes with a trained run", allow_abbrev=False
    )
    evaluate.add_argument("--member", help="name (sauna/0) or index; default: all")
    evaluate.add_argument("--episodes", default="10", help="episodes per member (default 10)")
    evaluate.add_argument("--video", action="store_true", help="record the first episode")

    text = "write episodes of a trained policy as data: a Minari dataset or a Parquet file"
    record = commands.add_parser("record", help=text, allow_abbrev=False)
    record.add_argument("--member", help="name (sauna/0) or index; default: the first")
    record.add_argument("--episodes", default="100", help="how many (default 100)")
    text = "minari:NAME, minari:./FOLDER/NAME or FILE.parquet"
    record.add_argument("--to", required=True, metavar="DATA", help=text)
    for command in (evaluate, record):
        command.add_argument("--env", help="another environment with the same spaces")
        text = "keyword arguments of the environment, as a JSON object; they change the run's own"
        command.add_argument("--env-kwargs", metavar="JSON", help=text)
        text = "the iteration of a kept checkpoint (default: the newest)"
        command.add_argument("--checkpoint", metavar="N", help=text)
        text = "each member as it was at its best evaluation during training"
        command.add_argument("--best", action="store_true", help=text)

    text = "a page about one episode: what the Vex head predicts, which steps the rule keeps"
    inspect = commands.add_parser("inspect", help=text, allow_abbrev=False)
    inspect.add_argument("--member", help="name (sauna/0) or index; default: the first")
    inspect.add_argument("--episodes", default="1", help="how many, in a row (default 1)")
    text = "the page (default: RUN/inspect_MEMBER_MODE.html)"
    inspect.add_argument("--out", metavar="PAGE", help=text)
    text = f"env steps after which an episode is cut (default {MAX_STEPS})"
    for command in (evaluate, record, inspect):
        command.add_argument("run", metavar="RUN", help="run directory")
        command.add_argument("--max-steps", metavar="N", default=str(MAX_STEPS), help=text)
        most_likely = "the most likely action (default: sampled, as in training)"
        command.add_argument("--deterministic", action="store_true", help=most_likely)
        command.add_argument("--seed", default="0", help="seed of the first episode (default 0)")
    text = "leave the frames out: needs no renderer"
    inspect.add_argument("--no-frames", action="store_false", dest="frames", help=text)

    text = "does a selection rule help on ENV? Trains several arms and says what the data support"
    compare = commands.add_parser("compare", help=text, usage=usage % "compare", allow_abbrev=False)
    text = f"{FIELDS['env'].metadata['help']}; or runs that exist, as `plot` reads them"
    compare.add_argument("env", nargs="*", metavar="ENV | RUN RUN", help=text)
    compare.add_argument("--tag", default="", help="of the returns in TensorBoard files")
    arms = ",".join(COMPARED)
    text = f"what to compare, also your module:rule; the first is the baseline (default {arms})"
    compare.add_argument("--arms", default=arms, help=f"{text}; all: every rule, in a tournament")
    text = "a tournament of ppo and these (see `sauna list rules`): more seeds where it is open"
    compare.add_argument("--rules", default="", metavar="RULE,...", help=text)
    text = "add no matched random control to the arms that choose samples"
    compare.add_argument("--no-controls", action="store_false", dest="controls", help=text)
    free = [n for n in FIELDS if n not in (*fields_with("decided_by_study"), "arm")]
    filtered = {**shown_values(arguments, "sauna"), "seeds": COMPARED_SEEDS}
    add_fields(compare, free, filtered)

    text = "run a study of the paper's, or your own"
    study = commands.add_parser("study", help=text, allow_abbrev=False)
    study.add_argument("study", metavar="NAME|FILE", help="see `sauna list studies`")
    text = "run the code that the file or run names, even if another user named it"
    for command in (train, resume, evaluate, record, inspect, study):
        command.add_argument("--trust", action="store_true", help=text)
    resume.add_argument("--accept-changed-code", **_PLACE["accept_changed_code"])
    for command in (compare, study):
        place = command.add_argument_group("where it trains")
        for name, how in _PLACE.items():
            place.add_argument(flag(name), **how)

    add_tune(commands, values, _PLACE)

    text = "draw the learning curves of runs that exist: run directories, CSV, TensorBoard files"
    plot = commands.add_parser("plot", help=text, allow_abbrev=False)
    text = "a run directory, a CSV file (seed, step, return), or TensorBoard files or their folder"
    plot.add_argument("runs", nargs="+", metavar="RUN", help=text)
    plot.add_argument("--out", default="", metavar="FILE", help="the figure, .png or .svg")
    plot.add_argument("--tag", default="", help="of the returns in TensorBoard files")

    text = "what runs a folder holds, how far each is and how it went"
    runs = commands.add_parser("runs", help=text, allow_abbrev=False)
    text = "the folder, searched with those below (default runs)"
    runs.add_argument("folder", nargs="?", metavar="DIR", default="runs", help=text)

    text = "measure this machine: training, its parts, physics alone, other trainers"
    bench = commands.add_parser("bench", help=text, usage=usage % "bench", allow_abbrev=False)
    bench.add_argument(
        "env", nargs="?", metavar="ENV", default="HalfCheetah-v5", help="default: HalfCheetah-v5"
    )
    text = f"also run another trainer: {', '.join(PEERS)}"
    bench.add_argument("--against", metavar="PEER", help=text)
    text = "your copy of cleanrl's ppo_continuous_action.py or of purejaxrl's ppo.py"
    bench.add_argument("--script", metavar="FILE", help=text)
    bench.add_argument("--rounds", default="3", help="how often, in turn (default 3)")
    text = "iterations of each round's training (default 50)"
    bench.add_argument("--iterations", default=argparse.SUPPRESS, help=text)
    text = "the rate against members, environments, width and processes instead"
    bench.add_argument("--scale", action="store_true", help=text)
    bench.add_argument("--json", metavar="FILE", help="also write the figures there")
    own = ("env", "steps", "out")
    add_fields(bench, [n for n in FIELDS if n not in own], {**values, "seeds": 6})

    sharing.add_commands(commands)
    checking.add_command(commands)

    lists = commands.add_parser("list", help="what there is to choose from", allow_abbrev=False)
    text = f"{', '.join(LISTS)} (without: what these are)"
    lists.add_argument("what", nargs="?", choices=LISTS, metavar="WHAT", help=text)
    return parser


def main(arguments: list[str] | None = None) -> None:
    """Parses, runs, and exits with the documented code."""
    try:
        _run(sys.argv[1:] if arguments is None else arguments)
    except BadInput as error:
        _fail(error, 2)
    except Interrupted as error:
        _fail(error, 128 + error.signal_number)
    except SaunaError as error:
        _fail(error, 1)
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        _fail(f"cannot read or write {error.filename or 'a file'}: {error.strerror or error}", 1)
    except Exception as error:
        traceback.print_exc()
        _fail(f"unexpected {type(error).__name__}: {error}", 1)


def _fail(message: object, code: int) -> NoReturn:
    """Prints one line, below the frames of the user's own code if that raised; exits."""
    if isinstance(message, SaunaError) and (frames := user_frames(message)):
        print(frames, file=sys.stderr)
    print(f"sauna: {printable(str(message))}", file=sys.stderr)
    sys.exit(code)


def _run(arguments: list[str]) -> None:
    check_system()
    parser = make_parser(arguments)
    parsed, unknown = parser.parse_known_args(arguments)
    if unknown:
        flags = [
            option
            for action in _subparser(parser, parsed.command)._actions
            for option in action.option_strings
        ]
        hint = spread_hint(arguments, unknown[0]) or flag_hint(unknown[0], flags, parsed.command)
        raise BadInput(f"unknown argument {unknown[0]!r}{hint}")
    values = {name: value for name, value in vars(parsed).items() if name != "command"}
    if parsed.command is None:
        parser.print_help()
    elif parsed.command in ("train", "resume"):
        with spawned_ahead("sauna.training.worker", ON_CPU):  # imports JAX meanwhile
            _COMMANDS[parsed.command](values)
    else:
        _COMMANDS[parsed.command](values)


def _subparser(parser: argparse.ArgumentParser, command: str | None) -> argparse.ArgumentParser:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) and command:
            return action.choices[command]
    return parser


def _train(values: dict[str, Any]) -> None:
    from sauna.api import train_and_draw
    from sauna.config.settings_file import settings_in
    from sauna.training import run as runs
    from sauna.training.display import make_display
    from sauna.training.pick import pick

    trust = values.pop("trust")
    file, env = values.pop("config"), values.pop("env")
    stored = settings_in(file, trust) if file else {}
    picked = pick(over(stored, values | ({"env": env} if env else {})))
    overrides = translate(picked.overrides)
    display = make_display()
    if runs.follows(overrides):
        runs.follow(overrides, display)
        return
    run = runs.start(overrides, display, picked.found, trust)
    if picked.said:
        display.say(f"the settings of {file} over {picked.said}" if stored else picked.said)
    train_and_draw(run, display, resume=False)
    _print_curve(run.path)


def _print_curve(run: Path) -> None:
    curve = run / "figures" / "learning_curve.png"
    print(f"learning curve: {curve}" if curve.exists() else "no episode has finished: no curve")


def _resume(values: dict[str, Any]) -> None:
    from sauna.api import train_and_draw
    from sauna.training import run as runs
    from sauna.training.display import make_display

    path = Path(values.pop("run"))
    names = ("trust", "accept_changed_code", "restart_schedule", "inexact")
    how = {name: values.pop(name) for name in names}
    display = make_display()
    run = runs.reopen(path, values, display, **how)
    train_and_draw(run, display, resume=True, inexact=how["inexact"])
    _print_curve(path)


def _eval(values: dict[str, Any]) -> None:
    run = Path(values.pop("run"))
    _set_up_playing(values)
    from sauna.experiments.evaluate.episodes import VideoFailure, evaluate, report
    from sauna.experiments.evaluate.video import choose_renderer

    if values["video"]:
        choose_renderer()
    try:
        result = evaluate(run, **values)
    except VideoFailure as error:
        print("\n".join(report(error.result)), flush=True)
        raise
    print("\n".join(report(result)))
    if "video" in result:
        print(f"video: {result['video']}")


def _record(values: dict[str, Any]) -> None:
    run = Path(values.pop("run"))
    _set_up_playing(values)
    from sauna.experiments.record import record, report

    print(report(record(run, **values, say=_say)))


def _set_up_playing(values: dict[str, Any]) -> None:
    """Reads the numbers of what plays episodes, and keeps JAX to one thread of the CPU."""
    least = {"episodes": 1, "seed": 0, "max_steps": 1}
    if values.get("checkpoint") is not None:
        least["checkpoint"] = 0
    values |= {name: whole_number(name, values[name], number) for name, number in least.items()}
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("PJRT_NPROC", "1")
    os.environ.setdefault("JAX_CPU_ENABLE_ASYNC_DISPATCH", "0")  # a step waits for each action


def _inspect(values: dict[str, Any]) -> None:
    run = Path(values.pop("run"))
    _set_up_playing(values)
    from sauna.experiments.inspect.command import inspect

    path = inspect(run, **values, say=_say)
    print(f"page: {path} ({path.stat().st_size / 1e6:.1f} MB)")


def _compare(values: dict[str, Any]) -> None:
    from sauna.experiments.report.sources import is_source
    from sauna.experiments.study.command import chosen_arms, compare_command, comparison
    from sauna.experiments.study.existing import compare_existing

    names, tag = values.pop("env"), values.pop("tag")
    if len(names) > 1 or tag or any(is_source(Path(name)) for name in names):
        print("\n".join(compare_existing([*map(Path, names)], tag, **values)))
        return
    env, arms = names[0] if names else "", tuple(values.pop("arms").split(","))
    rules, controls = tuple(filter(None, values.pop("rules").split(","))), values.pop("controls")
    if not env:
        raise BadInput("env: no environment given; try `sauna compare InvertedPendulum-v5`")
    place = {name: values.pop(name) for name in _PLACE}
    values = translate({"env": env, **values})
    del values["env"]
    parsed = parse_all(values)
    chosen, is_tournament = chosen_arms(arms, rules, controls, parsed)
    spec = comparison(env, chosen, parsed, is_tournament)
    _run_study(spec, compare_command(env, arms, values, place["out"], rules, controls), **place)


def _plot(values: dict[str, Any]) -> None:
    from sauna.experiments.report.curve import plot

    print(f"figure: {plot([*map(Path, values['runs'])], values['out'], values['tag'])}")


def _runs(values: dict[str, Any]) -> None:
    from sauna.experiments.run_list import list_runs

    print("\n".join(list_runs(Path(values["folder"]))))


def _study(values: dict[str, Any]) -> None:
    from sauna.experiments.study.command import check_study, load_spec, study_command

    name, trust, out = values.pop("study"), values.pop("trust"), values["out"]
    spec = load_spec(name, lambda text: check_study(text, Path(out), trust))
    _run_study(spec, study_command(name, out, spec.text), **values)


def _run_study(spec: Any, command: str, *, out: str, processes: str, **place: Any) -> None:
    from sauna.experiments.study.command import lines, study

    jobs = whole_number("processes", processes, 0)
    summary = study(spec, Path(out), command, jobs, **place)
    print("\n".join(lines(summary)))
    print(f"\nreport: {Path(out) / spec.name / 'report.html'}")
    if not any(row["seeds"] for row in summary["table"]):
        raise SaunaError("no training ended well; the report and the units' stderr.txt say why")
    if number := summary.get("not_measured"):
        log = spec.measurement.folder(Path(out) / spec.name) / "stderr.txt"
        raise SaunaError(f"{number} members are not measured; the lines above and {log} say why")


def _bench(values: dict[str, Any]) -> None:
    from sauna.experiments.bench.flags import bench_from_flags

    bench_from_flags(values, _say)


def _say(text: str) -> None:
    print(printable(text), flush=True)


def _list(values: dict[str, Any]) -> None:
    from sauna.experiments.listing import listing

    for line in listing(values["what"]):
        print(line)


_COMMANDS = {
    "train": _train,
    "resume": _resume,
    "eval": _eval,
    "record": _record,
    "inspect": _inspect,
    "compare": _compare,
    "tune": lambda values: tune_from_flags(values, _say),
    "plot": _plot,
    "runs": _runs,
    "study": _study,
    "bench": _bench,
    "list": _list,
    **sharing.COMMANDS,
    "check": checking.check_from_flags,
}
