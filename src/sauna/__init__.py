"""SAUNA: PPO whose updates keep only the transitions with an informative explained variance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sauna.envs.registration import register as _register

if TYPE_CHECKING:
    from sauna.algorithm.learner.vex_targets import VexTarget
    from sauna.algorithm.types import (
        Choice,
        Hypers,
        LossTerms,
        LossWeight,
        Sampler,
        SamplerSetup,
        Samples,
        ScoredStep,
        StepFilter,
        StopRule,
    )
    from sauna.api import Result, compare, load, resume, train
    from sauna.envs.device.contract import JaxEnv, Transition
    from sauna.experiments.evaluate.episodes import evaluate
    from sauna.experiments.inspect.command import inspect
    from sauna.experiments.record import record
    from sauna.experiments.share.exchange import pull, push
    from sauna.experiments.share.export import export
    from sauna.system.errors import BadInput, SaunaError
    from sauna.training.tracking.tracker import TrackedRun, Tracker

__version__ = "0.1.0"

__all__ = [
    "BadInput",
    "Choice",
    "Hypers",
    "JaxEnv",
    "LossTerms",
    "LossWeight",
    "Result",
    "Sampler",
    "SamplerSetup",
    "Samples",
    "SaunaError",
    "ScoredStep",
    "StepFilter",
    "StopRule",
    "TrackedRun",
    "Tracker",
    "Transition",
    "VexTarget",
    "compare",
    "evaluate",
    "export",
    "inspect",
    "load",
    "pull",
    "push",
    "record",
    "resume",
    "train",
]

_HOMES = {
    "BadInput": "sauna.system.errors",
    "SaunaError": "sauna.system.errors",
    "Result": "sauna.api",
    "compare": "sauna.api",
    "load": "sauna.api",
    "resume": "sauna.api",
    "train": "sauna.api",
    "JaxEnv": "sauna.envs.device.contract",
    "Transition": "sauna.envs.device.contract",
    "TrackedRun": "sauna.training.tracking.tracker",
    "Tracker": "sauna.training.tracking.tracker",
    "evaluate": "sauna.experiments.evaluate.episodes",
    "export": "sauna.experiments.share.export",
    "pull": "sauna.experiments.share.exchange",
    "push": "sauna.experiments.share.exchange",
    "inspect": "sauna.experiments.inspect.command",
    "record": "sauna.experiments.record",
    **dict.fromkeys(
        (
            "Choice",
            "Hypers",
            "LossTerms",
            "LossWeight",
            "Sampler",
            "SamplerSetup",
            "Samples",
            "ScoredStep",
            "StepFilter",
            "StopRule",
        ),
        "sauna.algorithm.types",
    ),
    "VexTarget": "sauna.algorithm.learner.vex_targets",
}


def __getattr__(name: str) -> Any:
    """Public names are imported when first used, so that the command line starts without JAX."""
    if name not in _HOMES:
        raise AttributeError(f"module 'sauna' has no attribute {name!r}")
    import importlib

    if _HOMES[name] != "sauna.system.errors":
        importlib.import_module("sauna.system.supported").check_system()
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """Lists the public names too, which are not imported yet."""
    return sorted({*globals(), *__all__})


_register()
