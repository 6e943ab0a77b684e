"""What is refused of a run's settings: what nothing reads, and what does not go together."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from sauna.config import readers
from sauna.config.plugins import import_name, is_local
from sauna.config.settings import FIELDS, Config, fields_with
from sauna.system.errors import BadInput

MIN_MINIBATCH = 2  # samples; of fewer, nothing can be standardised
SMALL_MINIBATCH = 16  # samples; below, a run says so
FEW_UPDATES = 10  # a training of fewer gets a note
LEFT_OVER = 0.05  # share of the budget that fills no rollout, from which it is named


def is_read(name: str, config: Config) -> bool:
    """Returns whether a run with this config reads field `name`."""
    read_when = FIELDS[name].metadata["read_when"]
    return read_when is None or bool(read_when[1](config))


def check_read(configs: list[Config], names: Iterable[str]) -> None:
    """Refuses a named field that none of the arms' `configs` reads.

    Raises:
      BadInput: naming the field and what would read it.
    """
    for name in names:
        if not any(is_read(name, config) for config in configs):
            arms = ",".join(configs[0].arm)
            needed = FIELDS[name].metadata["read_when"][0]
            raise BadInput(f"{name}: not read by arm {arms}; it needs {needed}")


def check_read_here(config: Config, spaces: Any, overrides: Mapping[str, Any]) -> None:
    """Refuses what the place and the spaces of the environment leave unread.

    Args:
      config: with the place decided.
      spaces: of the environment.
      overrides: what the user gives, parsed; to turn something off is never refused.

    Raises:
      BadInput: naming the field and what would read it.
    """
    for name, value in overrides.items():
        meta = FIELDS[name].metadata
        if meta["device_only"] and config.backend != "device":
            raise BadInput(f"{name}: only read with backend device")
        needs = meta["needs_spaces"]
        if needs is not None and value is not False and not needs[1](spaces):
            raise BadInput(f"{name}: not read by {config.env}; it needs {needs[0]}")


def check_consistent(config: Config) -> None:
    """Refuses values that are each possible but not together.

    Raises:
      BadInput: with the one line that says which.
    """
    if not config.env:
        raise BadInput("env: no environment given; try `sauna train InvertedPendulum-v5`")
    if not config.seeds:
        raise BadInput("seeds: empty; give a number of seeds or a list")
    if len(set(config.seeds)) != len(config.seeds):
        raise BadInput("seeds: a seed is given twice")
    if not config.hidden:
        raise BadInput("hidden: empty; give at least one width")
    if min(config.seeds) < 0 or max(config.seeds) >= 2**32:
        raise BadInput("seeds: must lie between 0 and 2**32 - 1")
    batch = config.rollout_steps * config.envs
    if batch % config.minibatches:
        raise BadInput(
            f"minibatches: {config.minibatches} does not divide rollout_steps x envs = {batch}"
        )
    size = batch // config.minibatches
    if size < MIN_MINIBATCH and config.normalize_advantages:
        raise BadInput(
            f"minibatches: {config.minibatches} of {batch} samples leave {size} each, whose "
            f"standardised advantage is 0; at least {MIN_MINIBATCH} are needed"
        )
    if config.steps < batch:
        raise BadInput(f"steps: {config.steps} is less than one rollout of {batch} steps")
    _check_evaluations(config, batch)
    if config.schedule_start >= config.steps:
        raise BadInput(f"schedule_start: {config.schedule_start} is not below steps {config.steps}")
    if config.distributed and config.init_from:
        raise BadInput("init_from: not read with distributed")
    if config.distributed and config.eval_every:
        raise BadInput("eval_every: not read with distributed; use `sauna eval`")
    if config.gae_over == "kept" and config.truncation == "bootstrap":
        raise BadInput(
            "gae_over: kept needs truncation=terminate (the final value belongs to a step that "
            "may have been dropped)"
        )
    if config.keep_rate_target and (config.history, config.decision) != ("all", "env"):
        raise BadInput("keep_rate_target: needs history=all and decision=env")
    if config.filter == "random-drop" and not config.drop_rate:
        raise BadInput(
            "drop_rate: random-drop needs a rate (arm sauna+random drops as many steps as sauna)"
        )
    if config.env_processes and "env" in local_parts(config):
        raise BadInput(
            "env_processes: the environment cannot be imported by another process; "
            "put it at the top level of a module"
        )
    if config.env_processes > config.envs * len(config.seeds) * len(config.arm):
        raise BadInput("env_processes: more worker processes than environments")
    if config.stack > 1 and config.env.startswith("ALE/"):
        raise BadInput("stack: an observation of an Atari game is its last four frames already")
    check_rate(config)
    check_rules(config)
    check_recurrent(config)
    for name in own_parts(config):
        import_name(name, getattr(config, name))
    for path in config.wrap:
        check_wrapper(path)


def _check_evaluations(config: Config, batch: int) -> None:
    """Refuses evaluations that would never come.

    Raises:
      BadInput: naming the last env step of the run.
    """
    last = config.steps // batch * batch
    if config.eval_every > last and (config.filter == "none" or config.budget == "env"):
        raise BadInput(
            f"eval_every: the run ends after {last:,} env steps, before the first evaluation"
        )


def check_wrapper(path: str) -> None:
    """Refuses a wrapper that no worker could import and call.

    Raises:
      BadInput: it is none; naming it.
    """
    if ":" not in path:
        raise BadInput(f"wrap: {path!r} is no module:function")
    if is_local(path):
        raise BadInput("wrap: a wrapper has to be importable; put it at the top level of a module")
    if not callable(import_name("wrap", path)):
        raise BadInput(f"wrap: {path} cannot be called with an environment")


def check_rate(config: Config) -> None:
    """Refuses a learning rate that its schedule cannot move.

    Raises:
      BadInput: with the one line that says why.
    """
    if config.learning_rate_schedule != "kl":
        return
    if config.algorithm != "ppo":
        raise BadInput("learning_rate_schedule: kl needs algorithm ppo, which measures the KL")
    least, most = config.learning_rate_min, config.learning_rate_max
    if not least <= config.learning_rate <= most:
        raise BadInput(
            f"learning_rate: {config.learning_rate} lies outside learning_rate_min {least} and "
            f"learning_rate_max {most}"
        )


def check_rules(config: Config) -> None:
    """Refuses rules of selection that cannot work together.

    Raises:
      BadInput: with the one line that says which.
    """
    stages = [
        name for name in ("filter", "sampler", "loss_weight") if getattr(config, name) != "none"
    ]
    if config.control != "none":
        if not stages:
            raise BadInput("control: needs a rule to follow: a filter, a sampler or a loss_weight")
        if len(stages) > 1:
            raise BadInput(f"control: {' and '.join(stages)} are two rules; it can follow one")
        if stages == ["loss_weight"] and config.control not in ("random", "reversed"):
            raise BadInput(
                f"control: a loss_weight is controlled by random or reversed, not by "
                f"{config.control}"
            )
        if config.filter == "random-drop":
            raise BadInput("control: random-drop is a control itself")
    if config.gae_over == "kept":
        unfit = [("control", "none"), ("critic", "squared"), ("recompute_advantages", False)]
        for name, plain in unfit:
            if getattr(config, name) != plain and (name != "control" or config.filter != "none"):
                raise BadInput(f"{name}: needs gae_over=all")
    check_passes(config)
    check_distribution(config)
    if config.replay_rollouts:
        check_replay(config)
    if config.normalize_over == "kept" and config.sampler == "none":
        raise BadInput("normalize_over: kept needs a sampler; without one it is rollout")
    if config.objective == "unclipped" and config.stop == "none" and config.loss_weight == "none":
        raise BadInput(
            "objective: unclipped needs a stop rule (espo) or a loss_weight "
            "(sample-dropout): nothing else bounds the ratio"
        )


def check_distribution(config: Config) -> None:
    """Refuses rules that need a formula which the actions' distribution lacks.

    Raises:
      BadInput: with the one line that says which.
    """
    if config.distribution == "gsde" and config.sampler == "gradient-norm":
        raise BadInput(
            "sampler: gradient-norm has no formula for the gradient of distribution gsde; it has "
            "one for gaussian, squashed and beta"
        )
    whole = json.loads(config.loss_weight_kwargs).get("on") == "all"
    if config.distribution == "beta" and config.loss_weight == "delight" and not whole:
        raise BadInput(
            "loss_weight: delight weighs the gradient of the mean, which distribution beta has "
            'no parameter for; loss_weight_kwargs {"on": "all"} weighs it whole'
        )


def check_replay(config: Config) -> None:
    """Refuses what cannot learn from earlier rollouts.

    Raises:
      BadInput: with the one line that says which.
    """
    plain = {
        "gae_over": "all",
        "critic": "squared",
        "recompute_advantages": False,
        "recurrent": "none",
    }
    for name, value in plain.items():
        if getattr(config, name) != value:
            raise BadInput(f"replay_rollouts: not read with {name} {getattr(config, name)}")
    if config.sampler == "pods":
        raise BadInput("replay_rollouts: pods takes segments of one rollout")
    if config.filter != "none" and config.control != "none":
        raise BadInput("replay_rollouts: not read with the control of a filter")


def check_passes(config: Config) -> None:
    """Refuses rules that need a ratio other than 1, or a second epoch, where there is none.

    Raises:
      BadInput: with the one line that says which.
    """
    if config.algorithm == "a2c":
        if config.stop != "none":
            raise BadInput("stop: A2C makes one pass, which nothing stops early")
        if config.objective != "clip":
            raise BadInput(f"objective: {config.objective} needs a ratio, which A2C has none of")
        if config.loss_weight == "sample-dropout":
            raise BadInput("loss_weight: sample-dropout needs a ratio other than 1; A2C's is 1")
    if config.recompute_advantages and (config.algorithm == "a2c" or config.epochs == 1):
        raise BadInput("recompute_advantages: needs more than one epoch")


def check_recurrent(config: Config) -> None:
    """Refuses what a recurrent policy cannot be trained with.

    Raises:
      BadInput: with the one line that says which.
    """
    if config.recurrent == "none":
        return
    length, batch = config.sequence_length, config.rollout_steps * config.envs
    if config.rollout_steps % length:
        raise BadInput(
            f"sequence_length: {length} does not divide rollout_steps {config.rollout_steps}"
        )
    if (batch // length) % config.minibatches:
        raise BadInput(
            f"minibatches: {config.minibatches} does not divide the {batch // length} sequences of "
            f"{length} steps in a rollout"
        )
    if readers.CLONED[1](config):
        raise BadInput("init_from: recorded episodes are cloned step by step; use recurrent none")
    replaced = config.filter != "none" and config.dropped == "replace"
    if replaced and config.selection_mode == "refill":
        raise BadInput(
            "selection_mode: with recurrent and dropped replace an update takes as many gradient "
            "steps as PPO's by itself; use fewer or smaller"
        )
    if config.loss_weight != "none" and config.control == "random":
        raise BadInput(
            "control: the random control of a loss_weight needs a minibatch in random order, and "
            "with recurrent its rows stand in sequences; use reversed"
        )
    if config.auxiliary == "shuffled-observation":
        raise BadInput(
            "auxiliary: shuffled-observation needs a minibatch in random order, and with recurrent "
            "its rows stand in sequences; use next-observation"
        )


def local_parts(config: Config) -> list[str]:
    """Names the fields whose values were passed by value and only this process knows."""
    return [name for name in FIELDS if is_local(str(getattr(config, name)))]


def own_parts(config: Config) -> list[str]:
    """Names the fields that hold a part of the user's own besides the environment."""
    names = (name for name in fields_with("plugin") if name != "env")
    return [name for name in names if ":" in getattr(config, name)]


def has_room(config: Config, env_steps: int, kept_steps: int) -> bool:
    """Returns whether a whole rollout still fits in the budget after these steps of a member."""
    used = kept_steps if config.budget == "kept" else env_steps
    return config.steps - used >= config.rollout_steps * config.envs


def budget_note(config: Config) -> str:
    """Says how much of a small budget is trained, in whole rollouts; empty if nothing is worth it.

    A filter's rollouts have no fixed number of env steps, so that there is no note of them.
    """
    rollout = config.rollout_steps * config.envs
    updates = config.steps // rollout
    trained, left = updates * rollout, config.steps % rollout
    if config.filter != "none" or not (updates < FEW_UPDATES or left > LEFT_OVER * config.steps):
        return ""
    share = f"{trained:,} of {config.steps:,}" if left else f"all {trained:,}"
    times = f"{updates} update{'s' * (updates != 1)}"
    return (
        f"note: {share} env steps are trained, in {times}: a rollout has {rollout:,} steps, which "
        "--rollout-steps changes"
    )


def cautions(config: Config) -> list[str]:
    """Says what can be trained with, but seldom is meant."""
    found: list[str] = []
    size = config.rollout_steps * config.envs // config.minibatches
    if not config.normalize_advantages or config.algorithm != "ppo":
        return found
    if size < SMALL_MINIBATCH:
        found.append(
            f"warning: minibatches of {size} samples: their advantages are standardised alone"
        )
    if ":" in config.sampler and config.normalize_over == "minibatch":
        found.append(
            "note: advantages are standardised over each minibatch, the default; for a sampler "
            "that ranks by the advantage give --normalize-over rollout"
        )
    return found
