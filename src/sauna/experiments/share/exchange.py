"""`sauna push` and `sauna pull`: policies to and from the Hugging Face Hub."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from sauna.experiments.share.card import placed
from sauna.experiments.share.export import check_empty, export
from sauna.system import hub, run_directory
from sauna.system.errors import BadInput
from sauna.system.safe_read import JSON_BYTES, read_file
from sauna.training.artifact import load_artifact
from sauna.training.located import locate


def push(
    run: str | Path,
    repo: str,
    *,
    private: bool = False,
    revision: str | None = None,
    trust: bool = False,
    **how: Any,
) -> str:
    """Uploads one policy to the Hugging Face Hub, with its model card.

    The token is that of `hf auth login`, or `HF_TOKEN`.

    Args:
      run: a run directory, whose policy is exported first, or an exported policy.
      repo: `USER/NAME`; made if there is none.
      private: if it is made, only its owner sees it.
      revision: a branch, made if there is none; default the main one.
      trust: the code that the run names may run, even if another user named it.
      **how: of a run: what `export` takes (`member`, `best`, `onnx`, `numpy`, `episodes`, ...).

    Returns:
      the address of the commit.

    Raises:
      BadInput: as `export`, or `repo` is no name.
      SaunaError: the Hub refuses it, or cannot be reached.
    """
    if hub.read_name(repo)[1] is not None:
        raise BadInput("hub: give the revision as revision (--revision)")
    path = locate(run).folder
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "policy"
        if run_directory.is_exported(path):
            if how:
                raise BadInput(f"{next(iter(how))}: {run} is exported already")
            load_artifact(path, trust=trust)  # refuses what cannot be opened
            _copy(path, folder)
        else:
            export(path, folder, trust=trust, **how)
        card = folder / "README.md"
        card.write_text(placed(card.read_text(), f"hf:{repo}"))
        return hub.upload(folder, repo, "A policy of SAUNA", private, revision)


def _copy(path: Path, folder: Path) -> None:
    """Copies the known files of an exported policy; no link is followed."""
    for name in hub.present(path):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        limit = JSON_BYTES if name.endswith((".json", ".md", ".py")) else hub.LARGEST
        (folder / name).write_bytes(read_file(path / name, limit))


def pull(name: str, to: str | Path) -> Path:
    """Fetches a policy from the Hugging Face Hub into a folder; nothing of it is executed.

    Args:
      name: `USER/NAME`, or `USER/NAME@REVISION`.
      to: the folder, which must not be there or be empty.

    Raises:
      BadInput: the folder holds something, or the repository no policy.
      SaunaError: it cannot be had.
    """
    return hub.download(name, check_empty(Path.cwd() / to))
