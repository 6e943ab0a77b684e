"""Compiled functions made once per test process, for all configs that shape the same program.

Tracing and lowering cost a small training ten times what its numbers cost, and the tests train the
same few programs again and again. Production code makes them once per process; so do the tests, in
which a process trains several hundred times. What shares a program is what `shapes_program` says,
so a setting whose mark is wrong fails the tests that change it. Parts of a user's own are made anew
unless a module of `tests/` holds them: a test may write another module of the same name.
"""

from __future__ import annotations

import dataclasses
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

import jax

from sauna.algorithm.learner import program as learning
from sauna.algorithm.learner.program import Learner
from sauna.algorithm.policy import policy as policies
from sauna.algorithm.policy.policy import Policy
from sauna.algorithm.rollout import program as collecting
from sauna.algorithm.rollout.program import Program
from sauna.config.checks import own_parts
from sauna.config.settings import FIELDS, Config, fields_with
from sauna.envs.spaces import Spaces
from sauna.training.loop import device
from sauna.training.loop.job import Job

FREE = {*FIELDS} - {*fields_with("shapes_program")} | {"env", "env_kwargs"}
START = {name: FIELDS[name].default for name in FREE}

OURS = {path.stem for path in Path(__file__).parent.glob("*.py")}

_made: dict[Any, Any] = {}


def _may_change(config: Config) -> bool:
    """Returns whether a part may be another one in the next test."""
    parts = (getattr(config, name) for name in own_parts(config))
    return any(part.partition(":")[0] not in OURS for part in parts)


def _key(config: Config, spaces: Spaces) -> Any:
    """Equal for configs whose compiled functions are the same."""
    of_rules = {"steps": config.steps} if config.sampler != "none" else {}
    return dataclasses.replace(config, **{**START, **of_rules}), repr(spaces)


def _population(make_population: Any, job: Job) -> Any:
    """The members of a job on the device, whose program may be compiled already."""
    config = job.config
    known = ":" not in config.env or config.env.partition(":")[0] in OURS
    if not known or _may_change(config) or config.devices > 1 or config.distributed:
        return make_population(job)
    key = (*_key(config, job.spaces), config.env, repr(job.env_kwargs))
    if key not in _made:
        _made[key] = first = make_population(job)
        first.compile()
    new = copy(_made[key])  # with the compiled `_run`, which is of one member
    assert new._one_by_one
    new.compile = lambda: 0.0
    new.number, new._settings = len(job.members), [device._setting(m) for m in job.members]
    new._state = [new._init(setting) for setting in new._settings]
    return new


def forget() -> None:
    """Lets everything be made anew: the code that it is traced from has changed, or will."""
    _made.clear()


def share_programs() -> None:
    """Lets modules that are imported from now on share what they compile."""
    make_program, make_learner = collecting.make_program, learning.make_learner
    make_policy = policies.make_policy

    def policy(config: Config, spaces: Spaces) -> Policy:
        """Its parameters are drawn by one program rather than operation by operation."""
        if _may_change(config):
            return make_policy(config, spaces)
        key = ("policy", *_key(config, spaces))
        if key not in _made:
            made = make_policy(config, spaces)
            _made[key] = made._replace(init=jax.jit(made.init))
        return _made[key]

    def program(config: Config, spaces: Spaces) -> Program:
        if _may_change(config):
            return make_program(config, spaces)
        key = _key(config, spaces)
        if key not in _made:
            _made[key] = make_program(config, spaces)
        return _made[key]._replace(config=config)

    def learner(config: Config, policy: Policy, spaces: Spaces) -> Learner:
        if _may_change(config):
            return make_learner(config, policy, spaces)
        key = (*_key(config, spaces), id(policy.apply))
        if key not in _made:
            _made[key] = policy, make_learner(config, policy, spaces)
        return _made[key][1]

    collecting.make_program, learning.make_learner = program, learner
    policies.make_policy = policy
    device.make_population = partial(_population, device.make_population)
