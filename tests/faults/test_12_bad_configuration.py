"""Row 12: a mistake is answered in one line that names it, at once, and creates nothing."""

from __future__ import annotations

import contextlib
import io
import os
import random
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from faults.nursery import environment
from faults.result import Result, Tally, assert_held
from sauna import cli
from sauna.config.presets import ARMS, PRESETS
from sauna.config.settings import FIELDS, TYPES, flag

SECONDS = 1.0  # of CPU
ENV = "small_envs:Scripted"
COMMANDS = ("train", "compare", "study", "resume", "eval", "bench", "list")


class Mistake(NamedTuple):
    """A command line (`{file}` stands for a file that holds `text`), and what has to be said."""

    arguments: list[str]
    said: str
    text: str = ""
    imports: bool = False  # it takes JAX and its environments to know, whose import takes seconds


def typo(word: str, rng: random.Random) -> str:
    """One letter of `word` left out, doubled or swapped with its neighbour."""
    at = rng.randrange(1, len(word) - 1)
    kind = rng.randrange(3)
    if kind == 0:
        return word[:at] + word[at + 1 :]
    if kind == 1:
        return word[:at] + word[at] + word[at:]
    return word[:at] + word[at + 1] + word[at] + word[at + 2 :]


def wrong_flag(rng: random.Random) -> Mistake:
    known = [flag(name) for name in FIELDS if name != "env" and len(name) > 4]
    name = rng.choice(known)
    wrong = name
    while wrong in known or wrong == name:
        wrong = "--" + typo(name[2:], rng)
    return Mistake(["train", ENV, f"{wrong}=1"], f"unknown argument '{wrong}=1'; did you mean '--")


def out_of_bounds(rng: random.Random) -> Mistake:
    names = [
        n
        for n, f in FIELDS.items()
        if f.metadata["at_least"] is not None
        or f.metadata["above"] is not None
        or f.metadata["at_most"] is not None
    ]
    name = rng.choice(names)
    meta = FIELDS[name].metadata
    values = ["nan", "inf", "-inf"] if TYPES[name] is float else []
    if meta["at_least"] is not None:
        values.append(str(meta["at_least"] - 1))
    if meta["above"] is not None:
        values.append(str(meta["above"]))
    if meta["at_most"] is not None:
        values.append(str(meta["at_most"] + 0.5))
    return Mistake(["train", ENV, f"{flag(name)}={rng.choice(values)}"], f"{name}: must be ")


def unreadable(rng: random.Random) -> Mistake:
    texts = {int: ["1.5", "ten", "", "1e", "0x10", "--"], float: ["", "a", "1,5", "1e", "-"]}
    names = [n for n in FIELDS if TYPES[n] in texts and n != "env"]
    name = rng.choice(names)
    return Mistake(
        ["train", ENV, f"{flag(name)}={rng.choice(texts[TYPES[name]])}"], f"{name}: cannot read"
    )


def unknown_choice(rng: random.Random) -> Mistake:
    names = [n for n, f in FIELDS.items() if f.metadata["choices"]]
    name = rng.choice(names)
    word = rng.choice([c for c in FIELDS[name].metadata["choices"] if len(c) > 2])
    wrong = word + rng.choice(["x", "s", "_"])
    arm = "sauna" if name != "backend" else "ppo"
    return Mistake(
        ["train", ENV, "--arm", arm, flag(name), wrong], f"{name}: unknown value '{wrong}'"
    )


def unknown_name(rng: random.Random) -> Mistake:
    kind, known = rng.choice([("arm", ARMS), ("preset", PRESETS)])
    word = rng.choice(sorted(known))
    wrong = word
    while wrong in known:
        wrong = typo(word, rng)
    return Mistake(["train", ENV, f"--{kind}", wrong], f"unknown {kind} '{wrong}'")


def unread_setting(rng: random.Random) -> Mistake:
    name, value = rng.choice(
        [
            ("threshold", "0.5"),
            ("history", "all"),
            ("dropped", "mask"),
            ("max_env_steps_factor", "2"),
            ("drop_rate", "0.1"),
            ("env_timeout", "5"),
            ("eval_episodes", "5"),
            ("stop_at", "5"),
            ("stop_when_flat", "5"),
            ("init_normalizer", "fresh"),
        ]
    )
    return Mistake(["train", ENV, "--arm", "ppo", flag(name), value], f"{name}: not read by arm")


def impossible_together(rng: random.Random) -> Mistake:
    return rng.choice(
        [
            Mistake(["train", ENV, f"--minibatches={rng.choice([33, 7, 1000])}"], "minibatches:"),
            Mistake(["train", ENV, f"--steps={rng.randrange(1, 2048)}"], "steps:"),
            Mistake(["train", ENV, "--seeds", f"{(n := rng.randrange(99))},{n}"], "seeds:"),
            Mistake(["train", ENV, f"--seeds={-rng.randrange(1, 99)},1"], "seeds:"),
            Mistake(["train", ENV, "--arm", "random-drop"], "drop_rate:"),
            Mistake(["train", ENV, f"--schedule-start={rng.randrange(1, 9)}e9"], "schedule_start:"),
            Mistake(
                ["train", ENV, "--init-from=nowhere"], "init_from: nowhere is no run", "", True
            ),
            Mistake(["train", ENV, "--gae-over", "kept"], "gae_over:"),
            Mistake(["train", ENV, "--arm", "sauna,random-drop", "--drop-rate", "0.1"], "arm:"),
            Mistake(["train", ENV, f"--env-processes={rng.randrange(2, 99)}"], "env_processes:"),
        ]
    )


def wrong_environment(rng: random.Random) -> Mistake:
    known = ["HalfCheetah-v5", "Hopper-v5", "CartPole-v1", "InvertedPendulum-v5"]
    name = rng.choice(known)
    command = rng.choice(["train", "compare", "bench"])
    return rng.choice(
        [
            Mistake([command, typo(name[:-3], rng) + name[-3:]], "env: unknown environment"),
            Mistake(["train", f"nowhere{rng.randrange(99)}:Thing"], "env: cannot import"),
            Mistake(["train", "small_envs:Scriptd"], "did you mean 'Scripted'?"),
            Mistake(["train", ENV, "--env-kwargs", '{"speed": 3}'], "cannot be made"),
            Mistake(["train", ENV, "--env-kwargs", "{speed: 3}"], "env_kwargs: cannot read"),
            Mistake(["train", "os:system"], "'os' is a part of Python"),
            Mistake(["train"], "no environment given"),
        ]
    )


def wrong_command(rng: random.Random) -> Mistake:
    word = rng.choice([c for c in COMMANDS if len(c) > 4])
    wrong = word
    while wrong in COMMANDS:
        wrong = typo(word, rng)
    return Mistake([wrong, ENV], f"invalid choice: '{wrong}'")


def wrong_run(rng: random.Random) -> Mistake:
    name = f"no-run-{rng.randrange(999)}"
    return rng.choice(
        [
            Mistake(["resume", name], f"{name} is not a run directory"),
            Mistake(["eval", name], f"{name} is not a run directory"),
            Mistake(["resume", name, "--gamma", "0.9"], "unknown argument '--gamma'"),
            Mistake(["eval", name, "--episodes", "0"], "episodes: must be a whole number"),
            Mistake(["eval", name, "--seed", "x"], "seed: must be a whole number"),
            Mistake(["resume", name, "--processes", "many"], f"{name} is not a run directory"),
            Mistake(["train", "--config", f"{name}.json"], f"cannot read {name}.json"),
        ]
    )


def wrong_config_file(rng: random.Random) -> Mistake:
    name = rng.choice([n for n in FIELDS if len(n) > 4])
    wrong = name
    while wrong in FIELDS:
        wrong = typo(name, rng)
    return rng.choice(
        [
            Mistake(
                ["train", ENV, "--config", "{file}"],
                f"unknown key '{wrong}'; did you mean",
                f'{{"{wrong}": 1}}',
            ),
            Mistake(["train", ENV, "--config", "{file}"], "config: cannot read", '{"gamma": 0.9'),
            Mistake(["train", ENV, "--config", "{file}"], "config: cannot read", "[1, 2]"),
            Mistake(["train", ENV, "--config", "{file}"], "twice", '{"gamma": 0.9, "gamma": 0.5}'),
            Mistake(["train", ENV, "--config", "{file}"], "gamma: must be", '{"gamma": 2}'),
        ]
    )


STUDY = ("study", "{file}", "--trust")  # its environment is of a module


def wrong_study(rng: random.Random) -> Mistake:
    start = 'tasks = ["small_envs:Scripted"]\n'
    arm = '[[arms]]\nlabel = "ppo"\n'
    return rng.choice(
        [
            Mistake(["study", "fig33"], "did you mean"),
            Mistake([*STUDY], "cannot read", "tasks = ["),
            Mistake([*STUDY], "unknown key", f'task = ["x"]\n{arm}'),
            Mistake([*STUDY], "no arms", start),
            Mistake([*STUDY], "unknown arm", f'{start}[[arms]]\nlabel = "suana"\n'),
            Mistake([*STUDY], "minibatches", f"minibatches = 7\n{start}{arm}"),
            Mistake(
                [*STUDY],
                "gamma",
                f"gamma = {rng.uniform(1.1, 9):.3f}\n{start}{arm}",
            ),
            Mistake([*STUDY, "--processes", "-1"], "processes:", start + arm),
            Mistake(
                [*STUDY, "--on", "mars"],
                "invalid choice: 'mars'",
                start + arm,
            ),
            Mistake(["compare", ENV, "--arms", "ppo,ppo"], "twice"),
            Mistake(["compare", ENV, "--arms", "ppo,suana"], "did you mean 'sauna'?"),
            Mistake(["compare", ENV, "--gamma", "1.5"], "gamma"),
            Mistake(["compare"], "no environment given"),
            Mistake(["list", "arm"], "invalid choice: 'arm'"),
            Mistake(["bench", "--rounds", "0"], "rounds: must be a whole number"),
        ]
    )


def wrong_on_device(rng: random.Random) -> Mistake:
    walk, pole = "jax_envs:walk", "gymnax/CartPole-v1"
    fault = rng.choice(["raises", "branches", "observation", "reward", "terminated", "state"])
    faulty = ["train", "jax_envs:faulty", "--env-kwargs", f'{{"fault": "{fault}"}}']
    said = {
        "raises": "cannot be played: ValueError: two lines",
        "branches": "cannot be played: TracerBool",
        "state": "its state has other arrays",
        "observation": "observation is of shape",
    }
    import jax_envs

    del jax_envs
    only, count = "only read with backend device", rng.randrange(1, 9)
    at_once = [
        Mistake(["train", ENV, "--device=gpu"], "device: no NVIDIA GPU here"),
        Mistake(["train", ENV, f"--devices={count}"], f"devices: {only}"),
        Mistake(["train", ENV, "--reset=cached"], f"reset: {only}"),
        Mistake(["train", ENV, "--distributed=here:1,2,0"], f"distributed: {only}"),
        Mistake(["compare", ENV, f"--devices={count}"], f"devices: {only}"),
        Mistake(["train", pole, f"--env-processes={count}", "--seeds=9"], "env_processes: not"),
        Mistake(["compare", pole, "--env-processes=1"], "env_processes: not read"),
        Mistake(["train", pole, "--distributed=here"], "distributed: 'here' is not HOST:PORT,"),
        Mistake(["train", pole, f"--distributed=a:1,{count},{count}"], "distributed: index"),
        Mistake(["train", pole, "--distributed=a:1,2,0", f"--devices={count}"], "devices: not"),
        Mistake(["train", pole, f"--steps={rng.randrange(3, 9)}e9"], "steps: the device counts"),
    ]
    after_imports = [
        Mistake(["train", walk, "--env-processes=1"], "env_processes: not read"),
        Mistake(["train", ENV, "--backend=device"], "backend: small_envs:Scripted is not"),
        Mistake(
            ["train", "CartPole-v1", "--backend=device"],
            "CartPole-v1 does not run on the device",
        ),
        Mistake(["train", walk, "--devices=2"], "devices: 1 members of 1 environments cannot be"),
        Mistake(["train", f"jax_envs:{typo('unlucky', rng)}"], "did you mean 'unlucky'?"),
        Mistake(["train", walk, "--network=nature-cnn"], "network: nature-cnn does not fit"),
        Mistake(["train", walk, "--env-kwargs", '{"speed": 1}'], "env_kwargs: jax_envs:walk"),
        Mistake(["train", "jax_envs:no_env"], "gives no environment, but int"),
        Mistake(["train", "jax_envs:no_env", "--backend=device"], "is not a sauna.JaxEnv"),
        Mistake(faulty, said.get(fault, f"its {fault} is not of shape")),
    ]
    return rng.choice([*at_once, *(mistake._replace(imports=True) for mistake in after_imports)])


KINDS: list[Callable[[random.Random], Mistake]] = [
    wrong_flag,
    out_of_bounds,
    unreadable,
    unknown_choice,
    unknown_name,
    unread_setting,
    impossible_together,
    wrong_environment,
    wrong_command,
    wrong_run,
    wrong_config_file,
    wrong_study,
    wrong_on_device,
]


def experiment(least: int, seed: int, place: Path) -> Result:
    """Mistakes of every kind, one in thirty in a process of its own. `worst`: CPU seconds."""
    rng, tally, before = random.Random(seed), Tally(), os.getcwd()
    folder = place / "folder"
    try:
        for number in range(least):
            mistake = KINDS[number % len(KINDS)](rng)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            file = place / "file.toml"
            file.write_text(mistake.text)
            arguments = [part.replace("{file}", str(file)) for part in mistake.arguments]
            os.chdir(folder)
            ask = _in_a_process if number % 30 == 29 and not mistake.imports else _here
            _judge(arguments, mistake.said, ask, folder, tally)
    finally:
        os.chdir(before)
    return tally.result()


def _judge(
    arguments: list[str], said: str, ask: Callable[..., tuple], folder: Path, tally: Tally
) -> None:
    code, errors, seconds = ask(arguments)
    tally.tried += 1
    tally.count("in a process of their own" if ask is _in_a_process else "in one process")
    tally.took(seconds)
    what = " ".join(arguments)
    if code != 2 or said not in errors:
        tally.miss(f"{what}: {code}, {errors[:300]!r} instead of {said!r}")
    *frames, line = errors.splitlines() or [""]  # above it, where the user's own code raised
    users = not frames or any(name in frames[0] for name in ("small_envs.py", "jax_envs.py"))
    if not line.startswith("sauna: ") or not users:
        tally.lose(f"{what}: not one line: {errors[:300]!r}")
    if any(folder.iterdir()):
        tally.lose(f"{what}: created {list(folder.iterdir())}")
    if seconds >= SECONDS:
        tally.lose(f"{what}: took {seconds:.2f} s of CPU")


def _here(arguments: list[str]) -> tuple[int, str, float]:
    errors, clock, code = io.StringIO(), time.process_time(), 0
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            cli.main(arguments)
        except SystemExit as end:
            code = int(end.code or 0)
    return code, errors.getvalue(), time.process_time() - clock


def _in_a_process(arguments: list[str]) -> tuple[int, str, float]:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "sauna", *arguments],
        capture_output=True,
        text=True,
        env=environment(),
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return done.returncode, done.stderr, seconds


def test_mistakes_are_named_and_create_nothing(tmp_path: Path) -> None:
    assert_held(experiment(96, 0, tmp_path), 96)
