"""The Hugging Face Hub, by its own client: its token store, its cache variables, its endpoint.

Only files of known names are fetched, of a known size, and none of them is executed.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sauna.system.errors import BadInput, SaunaError, one_line
from sauna.system.safe_write import new_folder

POLICY = "policy.json"
FILES = (
    "README.md",
    POLICY,
    "policy.safetensors",
    "policy.onnx",
    "numpy/policy.py",
    "numpy/policy.safetensors",
)
LARGEST = 2**32  # bytes of one policy
COMMIT = re.compile("[0-9a-f]{40}")
NAME = re.compile(r"(?P<repo>[\w.-]+/[\w.-]+)(?:@(?P<revision>[\w./-]+))?")


def read_name(text: str) -> tuple[str, str | None]:
    """`USER/NAME[@REVISION]` as the repository and the revision.

    Raises:
      BadInput: it is something else.
    """
    found = NAME.fullmatch(text)
    if found is None or ".." in text:
        raise BadInput(f"hub: {text!r} is not USER/NAME, or USER/NAME@REVISION")
    return found["repo"], found["revision"]


def download(name: str, folder: Path) -> Path:
    """Fetches a policy into a folder that is not there yet.

    Raises:
      BadInput: the repository holds no policy of SAUNA, or a larger one than is expected.
      SaunaError: it cannot be had.
    """
    repo, revision = read_name(name)
    with _client() as hub:
        info = hub.model_info(repo, revision=revision, files_metadata=True)
    return _fetch(repo, info, folder)


def cached(name: str) -> Path:
    """Fetches a policy into the cache, unless that has its newest commit; returns its folder.

    A commit that the cache has is opened without the network.

    Raises:
      BadInput, SaunaError: as `download`.
    """
    repo, revision = read_name(name)
    if revision and COMMIT.fullmatch(revision) and _holds_policy(_kept(repo, revision)):
        return _kept(repo, revision)
    with _client() as hub:
        info = hub.model_info(repo, revision=revision, files_metadata=True)
    folder = _kept(repo, str(info.sha))
    try:
        return folder if folder.is_dir() else _fetch(repo, info, folder)
    except SaunaError:
        if _holds_policy(folder):  # another process fetched it meanwhile
            return folder
        raise


def _kept(repo: str, commit: str) -> Path:
    """The folder of one commit in the cache."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base) / "sauna" / "hub" / repo / re.sub(r"\W", "-", commit)


def _holds_policy(folder: Path) -> bool:
    return (folder / POLICY).is_file()


def _fetch(repo: str, info: Any, folder: Path) -> Path:
    """Fetches the known files of one commit; the folder is there whole or not at all."""
    sizes = {file.rfilename: file.size or 0 for file in info.siblings}
    wanted = [name for name in FILES if name in sizes]
    if POLICY not in wanted:
        raise BadInput(f"hub: {repo} holds no policy of SAUNA (it has no {POLICY})")
    if sum(sizes[name] for name in wanted) > LARGEST:
        raise BadInput(f"hub: {repo} has more than {LARGEST} bytes")
    try:
        with new_folder(folder) as new:
            with _client() as hub:
                hub.snapshot_download(
                    repo, revision=info.sha, local_dir=new, allow_patterns=wanted, max_workers=1
                )
            shutil.rmtree(new / ".cache", ignore_errors=True)  # the client's notes
    except OSError as error:
        raise SaunaError(f"hub: cannot make {folder}: {one_line(error)}") from error
    return folder


def upload(
    folder: Path, repo: str, message: str, private: bool = False, revision: str | None = None
) -> str:
    """Uploads a policy, into a repository that is made if there is none; returns the commit's page.

    Args:
      private: if the repository is made, only its owner sees it.
      revision: a branch, made if there is none; default the main one.

    Raises:
      SaunaError: the Hub refuses it, or cannot be reached.
    """
    with _client() as hub:
        hub.create_repo(repo, private=private, exist_ok=True)
        if revision is not None:
            hub.create_branch(repo, branch=revision, exist_ok=True)
        done = hub.upload_folder(
            repo_id=repo,
            folder_path=folder,
            allow_patterns=list(FILES),
            commit_message=message,
            revision=revision,
        )
    return str(done.commit_url)


def present(folder: Path, names: Sequence[str] = FILES) -> list[str]:
    """The known files that a folder has."""
    return [name for name in names if (folder / name).is_file()]


@contextmanager
def _client() -> Iterator[Any]:
    """The Hub's client; what goes wrong with it is one line.

    Raises:
      BadInput: it is not installed.
      SaunaError: whatever it raises.
    """
    try:
        from huggingface_hub import HfApi
        from huggingface_hub.utils import disable_progress_bars
    except ImportError as error:
        raise BadInput(f"hub: {error}; pip install 'sauna-rl[hub]'") from error
    disable_progress_bars()
    try:
        yield HfApi(endpoint=os.environ.get("HF_ENDPOINT"), library_name="sauna-rl")
    except SaunaError:
        raise
    except Exception as error:  # of HTTP, of the disk, of what it checks itself
        raise SaunaError(f"hub: {one_line(error)}") from error
