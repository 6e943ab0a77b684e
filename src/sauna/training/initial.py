"""The weights and the normaliser from which a new run starts: of a trained run, or of a clone.

They are copied into the new run's directory before it begins (`init/`), so that what becomes of the
other run does not matter any more.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sauna.config.checks import is_read
from sauna.config.presets import Member
from sauna.config.settings import FIELDS, Config
from sauna.envs.spaces import difference
from sauna.system import checkpoint
from sauna.system.errors import BadInput
from sauna.system.run_directory import INITIAL, is_exported, run_below
from sauna.training.artifact import Artifact, find_member, load_artifact, policy_arrays
from sauna.training.cloning import clone_members, is_data
from sauna.training.located import HUB, ZOO, locate
from sauna.training.prepare import Prepared

# What has to be the same, beside the spaces, for weights to mean the same.
SHAPES = (
    "network",
    "hidden",
    "activation",
    "layer_norm",
    "value_hidden",
    "trunk",
    "recurrent",
    "recurrent_width",
    "distribution",
    "sde_expln",
    "rescale_actions",
    "normalize_observations",
)


class Source:
    """The run, the member and the moment that `init_from` names."""

    def __init__(self, text: str) -> None:
        path, self.best = Path(text), False
        if text.startswith((ZOO, HUB)):
            self.run, self.member = locate(text).folder, ""
            return
        if path.name == "best":
            path, self.best = path.parent, True
        self.run, self.member = path, ""
        if not _is_run(path) and _is_run(path.parent.parent):
            self.run, self.member = path.parent.parent, "/".join(path.parts[-2:])


def _is_run(path: Path) -> bool:
    return (path / "config.json").is_file() or is_exported(path)


def read_initial(
    prepared: Prepared, say: Callable[[str], None], trust: bool
) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Reads what the members of a new run start from; None: they start afresh.

    Returns:
      arrays, named as in a checkpoint of the new run, and where they come from.

    Raises:
      BadInput: there is no such run or member, it is somebody else's and not trusted, or its spaces
        or its network differ; the part is named. Or recorded episodes cannot be cloned.
    """
    config = prepared.config
    if not config.init_from:
        return None
    if is_data(config.init_from):
        return clone_members(prepared, say)
    source = Source(config.init_from)
    if not _is_run(source.run):
        below = run_below(source.run)
        raise BadInput(
            f"init_from: {config.init_from} is no run, and no RUN/ARM/SEED of one{below}"
        )
    artifact = load_artifact(source.run, say, trust=trust)
    check_fits(artifact, prepared)
    arrays: dict[str, np.ndarray] = {}
    chosen = {}
    for member in prepared.members:
        chosen[member.name] = name = _source_of(member, artifact.members, source.member)
        own = policy_arrays(artifact, name, source.best, config.init_normalizer)
        arrays |= {f"{member.name}/{key}": array for key, array in own.items()}
    manifest = artifact.checkpoint.manifest
    origin = {
        "run": str(source.run),
        "iteration": manifest["iteration"],
        "sha256": manifest["sha256"],
        "best": source.best,
        "members": chosen,
    }
    return arrays, origin


def weights_of(run: str) -> str | None:
    """Returns the digest of the weights that a run has now; None if it is not there.

    Nothing is run that it names, so nobody has to trust it.
    """
    if not _is_run(Path(run)):
        return None
    artifact = load_artifact(Path(run), lambda text: None, trust=True)
    return str(artifact.checkpoint.manifest["sha256"])


def check_fits(artifact: Artifact, prepared: Prepared) -> None:
    """Refuses a run whose weights would mean something else here.

    Raises:
      BadInput: naming the part that differs.
    """
    name, theirs, ours = prepared.config.init_from, artifact.config, prepared.config
    if differs := difference(artifact.spaces, prepared.spaces):
        raise BadInput(f"init_from: {name} has other spaces than {ours.env}: {differs}")
    for field in SHAPES:
        before, now = getattr(theirs, field), getattr(ours, field)
        if before != now and _matters(field, prepared):
            raise BadInput(
                f"init_from: {field} is {_text(before)} in {name}, and {_text(now)} here; that run "
                f"has preset {theirs.preset}"
            )


def _matters(field: str, prepared: Prepared) -> bool:
    """Whether the run reads a field, with its settings and its spaces."""
    needs = FIELDS[field].metadata["needs_spaces"]
    fits = needs is None or needs[1](prepared.spaces)
    return fits and is_read(field, prepared.config)


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _source_of(member: Member, known: list[str], named: str) -> str:
    """Names the member that `member` starts from: the named one, the only one, or its namesake.

    In a run of one arm, that of the same seed is the namesake.
    """
    if named:
        return find_member(known, named)
    if len(known) == 1:
        return known[0]
    arms = {name.rpartition("/")[0] for name in known}
    arm = member.arm if len(arms) > 1 else next(iter(arms))
    if f"{arm}/{member.seed}" not in known:
        raise BadInput(
            f"init_from: no member {arm}/{member.seed} for {member.name}; name one: "
            f"RUN/{known[0]} (there are: {', '.join(known)})"
        )
    return f"{arm}/{member.seed}"


def save_initial(run: Path, arrays: dict[str, np.ndarray], manifest: dict[str, Any]) -> None:
    """Copies what a run starts from into its directory."""
    checkpoint.save_checkpoint(run / INITIAL, 0, arrays, manifest, keep=1)


def load_initial(run: Path, config: Config) -> dict[str, np.ndarray]:
    """Loads what a run starts from; nothing if it starts afresh.

    Raises:
      BadCheckpoint: it is missing, or not what was written.
    """
    if not config.init_from:
        return {}
    return checkpoint.load_checkpoint(run / INITIAL / f"{0:08d}").arrays
