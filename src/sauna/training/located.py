"""Where a policy is that somebody names: in a folder, in the zoo, or on the Hugging Face Hub."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from sauna.system.errors import BadInput, nearest
from sauna.system.hub import cached

ZOO, HUB = "zoo:", "hf:"


class Located(NamedTuple):
    """Folders of a policy.

    Attributes:
      folder: what is read.
      written: where evaluations and videos of it go.
    """

    folder: Path
    written: Path


def locate(run: str | Path) -> Located:
    """Finds a run or an exported policy.

    Args:
      run: its folder; `zoo:NAME`, one that comes with this package; or `hf:USER/NAME[@REVISION]`,
        which is fetched from the Hugging Face Hub.

    Raises:
      BadInput: the zoo has no such policy, or the Hub none.
      SaunaError: the Hub cannot be reached.
    """
    text, runs = str(run), Path.cwd() / "runs"
    if text.startswith(ZOO):
        name = text.removeprefix(ZOO)
        return Located(_of_zoo(name), runs / f"zoo-{name}")
    if text.startswith(HUB):
        name = text.removeprefix(HUB)
        return Located(cached(name), runs / f"hf-{name.replace('/', '-')}")
    folder = Path.cwd() / run  # an environment may go elsewhere
    return Located(folder, folder)


def zoo() -> dict[str, Path]:
    """The policies that come with this package: `name -> folder`."""
    folder = Path(__file__).parent / "zoo"
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return {path.name: path for path in found if (path / "policy.json").is_file()}


def _of_zoo(name: str) -> Path:
    known = zoo()
    if name not in known:
        raise BadInput(f"zoo: no policy {name!r} (known: {', '.join(known)}){nearest(name, known)}")
    return known[name]
