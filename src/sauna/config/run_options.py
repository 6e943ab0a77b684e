"""The settings of a run that say what is trained, where, and how it is watched.

`Config` adds those that say how it learns. Nothing here imports JAX.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from sauna.config import readers
from sauna.config.fields import option

_task = partial(option, group="task")
_run = partial(option, group="run", shapes_program=False)
_where = partial(option, group="where it runs", shapes_program=False)
_evaluation = partial(option, group="evaluation", shapes_program=False)


@dataclass(frozen=True)
class RunOptions:
    """The first half of `Config`."""

    env: str = _task(
        "",
        "Gymnasium id, or module:function that makes an environment",
        common=True,
        plugin=True,
        decided_by_study=True,
    )
    env_kwargs: str = _task("{}", "keyword arguments of the environment, as a JSON object")
    wrap: tuple[str, ...] = _task(
        (),
        "module:function, ...: each takes an environment and gives one, the first the innermost",
        read_when=readers.ON_HOST,
    )
    stack: int = _task(1, "how many of the last observations are shown as one", at_least=1)
    action_mask: bool = _task(
        False,
        "learn and act by the environment's masks of valid actions: action_masks(), or "
        "info['action_mask']",
        needs_spaces=readers.CHOICES,
    )
    arm: tuple[str, ...] = _run(
        ("ppo",), "what to train, a name or several: see `sauna list arms`", common=True
    )
    algorithm: str = _run(
        "ppo",
        "how the policy is improved: by PPO, or by A2C",
        choices=("ppo", "a2c"),
        shapes_program=True,
    )
    preset: str = _run(
        "mujoco",
        "settings to start from, see `sauna list presets`; auto: the environment's own, which "
        "`train` takes if none is named (with A2C: a2c)",
        common=True,
    )
    seeds: tuple[int, ...] = _run(
        (0,),
        "how many seeds (6: seeds 0 to 5; 42: 42 of them), or which ones (100,101,110)",
        common=True,
    )
    steps: int = _run(
        1_000_000,
        "env steps per member",
        at_least=1,
        common=True,
        shapes_program=True,
        extends_run=True,
    )

    out: str = _run(
        "",
        "run directory; none: runs/ENV_ARM_SEEDS_TIME",
        common=True,
        machine_local=True,
        decided_by_study=True,
    )
    processes: int = _where(
        0,
        "processes that share the members (0: one per core)",
        at_least=0,
        common=True,
        resumable=True,
        machine_local=True,
        decided_by_study=True,
    )
    env_processes: int = _where(
        0,
        "worker processes that step the environments of one process (0: stepped in-process)",
        at_least=0,
        read_when=readers.ON_HOST,
        resumable=True,
    )
    backend: str = _where(
        "auto",
        "what steps the environments (auto: the fastest with the same "
        "numbers; device: inside the compiled program)",
        choices=("auto", "gymnasium", "device"),
        resumable=True,
    )
    reset: str = _where(
        "fresh",
        "on the device: an episode starts in a new state, or in the first of its environment",
        choices=("fresh", "cached"),
        shapes_program=True,
        device_only=True,
    )
    device: str = _where(
        "auto",
        "where the policy learns (auto: with backend device the GPU if there is one, else the CPU)",
        choices=("auto", "cpu", "gpu"),
        common=True,
        resumable=True,
    )
    devices: int = _where(
        0,
        "devices that share the population (0: every GPU, or one CPU; 8 simulates 8 on a CPU)",
        at_least=0,
        device_only=True,
        resumable=True,
    )
    distributed: str = _where(
        "",
        "HOST:PORT,COUNT,INDEX: COUNT machines train together; INDEX 0 writes the run",
        device_only=True,
        resumable=True,
        machine_local=True,
        decided_by_study=True,
    )
    env_timeout: float = _where(
        60.0,
        "seconds to wait for an environment worker",
        above=0,
        read_when=readers.WORKERS,
        resumable=True,
    )
    checkpoint_every: int = _run(50, "iterations between checkpoints", at_least=1, resumable=True)
    keep_checkpoints: int = _run(
        2,
        "how many of the newest checkpoints to keep",
        at_least=1,
        resumable=True,
        machine_local=True,
    )
    track: tuple[str, ...] = _run(
        ("none",),
        "where else the metrics go: tensorboard, wandb, trackio, mlflow, module:Class, or several",
        resumable=True,
        machine_local=True,
        decided_by_study=True,
    )
    track_project: str = _run(
        "sauna",
        "the trackers' project or experiment",
        read_when=readers.TRACKED,
        resumable=True,
        machine_local=True,
        decided_by_study=True,
    )

    init_from: str = _run(
        "",
        "start from the weights of a trained run: RUN, or RUN/ARM/SEED for one member of it; with "
        "/best behind it, as of its best evaluation; or from a clone of recorded episodes: "
        "data:FILE.parquet, data:minari:NAME",
    )
    init_normalizer: str = _run(
        "observations",
        "which running statistics come with them: those of observations and rewards (kept), of "
        "observations alone, or none (fresh)",
        choices=("kept", "observations", "fresh"),
        read_when=readers.FINE_TUNED,
    )
    clone_epochs: int = _run(
        20,
        "passes over recorded episodes before training begins",
        at_least=1,
        read_when=readers.CLONED,
    )
    clone_learning_rate: float = _run(
        1e-3, "Adam's step size in these passes", above=0, read_when=readers.CLONED
    )

    eval_every: int = _evaluation(
        0,
        "env steps of a member between evaluations in environments of their own (0: none)",
        at_least=0,
        extends_run=True,
    )
    eval_episodes: int = _evaluation(
        10,
        "episodes of an evaluation",
        at_least=1,
        read_when=readers.EVALUATED,
        extends_run=True,
    )
    eval_deterministic: bool = _evaluation(
        True,
        "evaluate the most likely actions; no: sampled ones, as in training",
        read_when=readers.EVALUATED,
        extends_run=True,
    )
    stop_at: float | None = _evaluation(
        None,
        "a member stops once an evaluation's mean return reaches this",
        read_when=readers.EVALUATED,
        extends_run=True,
    )
    stop_when_flat: int = _evaluation(
        0,
        "a member stops once so many evaluations in a row brought no new best (0: never)",
        at_least=0,
        read_when=readers.EVALUATED,
        extends_run=True,
    )
