"""What `sauna list` prints: everything that a setting can name."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator

from sauna.config.arms import SHARES
from sauna.config.choices import LISTS
from sauna.config.presets import (
    ARM_HELP,
    CONTROL_HELP,
    FILTER_HELP,
    PRESET_HELP,
    RULE_HELP,
    TARGET_HELP,
)
from sauna.config.settings import NATIVE
from sauna.config.zoo import ENVS, row_of
from sauna.system.run_directory import read_config
from sauna.training.located import zoo

HELP = {"arms": ARM_HELP, "presets": PRESET_HELP, "filters": FILTER_HELP, "targets": TARGET_HELP}
HEAD = ("environment", "preset", "env steps", "RL Zoo's return")


def listing(what: str | None) -> list[str]:
    """Returns the lines of one list, or what lists there are.

    Raises:
      BadInput: it is the list of a backend that is not installed.
    """
    if what is None:
        return [f"sauna list {name:{len('playground')}}  {text}" for name, text in LISTS.items()]
    if what == "envs":
        return list(_envs())
    if what == "atari":
        from sauna.envs.host.atari_envs import names

        return names()
    if what in NATIVE:
        from sauna.envs.device.make import names_of

        return names_of(what)
    if what == "zoo":
        return list(_policies())
    if what == "rules":
        return list(_rules())
    if what == "studies":
        return list(_studies())
    width = max(map(len, HELP[what]))
    lines = [f"{name:{width}}  {text}" for name, text in HELP[what].items()]
    return lines + (["", "What `sauna train ENV` takes:", *_zoo()] if what == "presets" else [])


def _studies() -> Iterator[str]:
    """The built-in studies, each with the first sentence of its comment."""
    from sauna.experiments.study.spec import built_in

    texts = built_in()
    width = max(map(len, texts))
    for name, text in texts.items():
        comment = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
        words = " ".join(line.removeprefix("# ") for line in comment)
        sentence = re.match(r".+?[.?](?= [A-Z]|$)", words)
        yield f"{name:{width}}  {sentence[0] if sentence else words}"


def _policies() -> Iterator[str]:
    """The trained policies that come with this package."""
    row = "{:30} {:>18}  {:>11}".format
    yield row("policy", "return", "env steps")
    for name, folder in zoo().items():
        stored = read_config(folder, exported=True)
        played = stored["evaluation"]
        found = f"{played['mean']:,.1f} +- {played['std']:,.1f}"
        yield row(f"zoo:{name}", found, f"{stored['env_steps']:,}")


def _envs() -> Iterator[str]:
    """Gymnasium's environments, with what the zoo says of them, and where there are more."""
    import gymnasium

    import sauna.envs.flagrun  # noqa: F401 - registers it
    from sauna.envs.host.packages import PACKAGES

    yield _columns(HEAD)
    for name in sorted(gymnasium.registry):
        yield _columns(row_of(name)) if row_of(name) else name
    for package in PACKAGES:
        yield f"{package.examples}  (`pip install 'sauna-rl[{package.extra}]'`)"
    for backend in NATIVE:
        yield f"{backend}/...  (on the device; `sauna list {backend}` names them)"
    yield "ALE/...  (`sauna list atari` names them)"


def _zoo() -> Iterator[str]:
    yield _columns(HEAD)
    for name in ENVS:
        yield _columns(row_of(name))


def _columns(row: tuple[str, ...]) -> str:
    env, preset, steps, published = row
    return f"{env:33} {preset:24} {steps:>11}  {published}".rstrip()


def _rules() -> Iterator[str]:
    row = "{:15} {:8} {:>5}  {}".format
    yield row("rule", "stage", "share", "what it does")
    for name, text in {**RULE_HELP, **CONTROL_HELP}.items():
        stage, _, sentence = text.partition(": ")
        yield row(name, stage, SHARES.get(name, "-"), sentence)
    yield ""
    yield "Share: how much of a rollout the rule keeps or draws, changed by --sampler-kwargs."
    yield "A rule without one keeps what it finds in each rollout, or all."
    yield "Join rules by +, such as sauna+avec, and a control to a rule: gigaflow+random"
    yield "Arm positive changes all advantages; --sampler positive keeps the samples above 0."
