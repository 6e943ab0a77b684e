"""`seed`, `batch_size` and `target_kl`, which other trainers have, as what they stand for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from sauna.config.arms import fixed_by
from sauna.config.checks import is_read
from sauna.config.other_names import ACCEPTED
from sauna.config.parsing import read_value
from sauna.config.presets import arm_config, parse_all
from sauna.config.settings import FIELDS, parse
from sauna.system.errors import BadInput


def translate(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replaces `seed` (the one seed), `batch_size` (samples per minibatch) and `target_kl`.

    `target_kl` is the limit of the stop rule of that name, as in Stable-Baselines3.

    Raises:
      BadInput: one is given beside the field that it replaces, or does not divide the rollout.
    """
    found = {name: value for name, value in values.items() if name not in ACCEPTED}
    if values.get("seed") is not None:
        _refuse_both(values, "seed", "seeds")
        found["seeds"] = (_whole("seed", values["seed"]),)
    if values.get("batch_size") is not None:
        _refuse_both(values, "batch_size", "minibatches")
        size = _whole("batch_size", values["batch_size"])
        config = arm_config("ppo", parse_all({k: v for k, v in found.items() if v is not None}))
        samples = config.rollout_steps * config.envs
        if size < 1 or samples % size:
            raise BadInput(f"batch_size: {size} does not divide rollout_steps x envs = {samples}")
        found["minibatches"] = samples // size
    if values.get("target_kl") is not None:
        found |= _stop_at(values["target_kl"], found)
    return found


def over(stored: Mapping[str, Any], typed: Mapping[str, Any]) -> dict[str, Any]:
    """Puts what is typed over what a file says.

    `--seed` replaces its seeds and `--seeds` its seed, and so on. A rule that is typed does not get
    the arguments of the rule in the file, and what only the file's settings read is left out.
    """
    if not stored:
        return dict(typed)
    gone = [other for pair in _SAME for name, other in (pair, pair[::-1]) if name in typed]
    named = {"stop" if name == "target_kl" else name for name in typed}
    gone += [f"{name}_kwargs" for name in named if stored.get(name) != typed.get(name)]
    found = {k: v for k, v in stored.items() if k not in gone} | dict(typed)
    try:
        left = set(_unread(found)) - set(_unread(stored))
        while lost := [name for name in left if name in found and name not in typed]:
            found = {name: value for name, value in found.items() if name not in lost}
            left = set(_unread(found)) - set(_unread(stored))  # what was read for their sake alone
    except BadInput:
        pass  # the run says so
    return found


def _unread(values: Mapping[str, Any]) -> list[str]:
    """Names the fields among `values` that none of the arms reads, or that all of them fix."""
    parsed = parse_all({k: v for k, v in translate(values).items() if v is not None})
    arms = parsed.get("arm", FIELDS["arm"].default)
    configs = {arm: arm_config(arm, parsed) for arm in arms}
    return [
        name
        for name in parsed
        if all(name in fixed_by(arm) or not is_read(name, own) for arm, own in configs.items())
    ]


# A setting that is accepted, and the field that it is another form of.
_SAME = (("seed", "seeds"), ("batch_size", "minibatches"), ("target_kl", "stop"))


def _stop_at(limit: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    if given.get("stop") not in (None, "target-kl"):
        raise BadInput("target_kl: give either target_kl or stop, not both")
    if given.get("algorithm") not in (None, "ppo"):
        raise BadInput("target_kl: only read with algorithm ppo")
    try:
        number = float(limit)
    except (ValueError, TypeError):
        raise BadInput(f"target_kl: cannot read {limit!r} as a number") from None
    if not 0 < number < float("inf"):
        raise BadInput(f"target_kl: must be a number above 0, not {limit}")
    kwargs = json.loads(parse("stop_kwargs", given.get("stop_kwargs") or "{}"))
    if "limit" in kwargs:
        raise BadInput("target_kl: give either target_kl or the limit in stop_kwargs, not both")
    return {"stop": "target-kl", "stop_kwargs": json.dumps({**kwargs, "limit": number})}


def _refuse_both(values: Mapping[str, Any], name: str, ours: str) -> None:
    if values.get(ours) is not None:
        raise BadInput(f"{name}: give either {name} or {ours}, not both")


def _whole(name: str, value: Any) -> int:
    try:
        return int(read_value(name, value, int))
    except (ValueError, TypeError):
        raise BadInput(f"{name}: cannot read {value!r} as a whole number") from None
