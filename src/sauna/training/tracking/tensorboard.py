"""TensorBoard: one event folder per member, over its env steps.

The settings are a text and, beside the final numbers, a row of the tab HPARAMS.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.system.safe_write import own_folder
from sauna.training.tracking.tracker import TrackedRun, Tracker, scalars


class TensorBoard(Tracker):
    """Writes `RUN/tensorboard/ARM/SEED`."""

    def __init__(self) -> None:
        self._writers: dict[str, Any] = {}
        self._last: dict[str, int] = {}  # env steps of each member

    def open(self, run: TrackedRun) -> dict[str, Any]:
        self._run, self._folder = run, run.path / "tensorboard"
        return {}

    def row(self, row: Mapping[str, Any]) -> None:
        writer = self._writer(row)
        self._last[row["member"]] = row["env_steps"]
        for name, value in scalars(row).items():
            writer.add_scalar(name, value, row["env_steps"])

    def picture(self, name: str, path: Path) -> None:
        import numpy as np
        from PIL import Image

        image = np.asarray(Image.open(path).convert("RGB"))
        for writer in self._writers.values():
            writer.add_image(name, image, dataformats="HWC")

    def summary(self, members: Mapping[str, Mapping[str, Any]], complete: bool) -> None:
        for member, writer in self._writers.items():
            finals = {
                f"final/{name}": float(x)
                for name, x in members.get(member, {}).items()
                if isinstance(x, int | float)
            }
            for name, value in finals.items():
                writer.add_scalar(name, value, self._last[member])
            for part in _hparams(self._settings(member), finals):
                writer.file_writer.add_summary(part)

    def _settings(self, member: str) -> dict[str, Any]:
        """The settings of a member, with the run directory."""
        return {**self._run.members.get(member, {}), "run_directory": str(self._run.path)}

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()

    def _writer(self, row: Mapping[str, Any]) -> Any:
        from tensorboardX import SummaryWriter

        name = row["member"]
        if name not in self._writers:
            for folder in (self._folder, self._folder / row["arm"], self._folder / name):
                own_folder(folder)
            step = row["env_steps"]
            self._writers[name] = writer = SummaryWriter(str(self._folder / name), purge_step=step)
            writer.add_text("settings", _table(self._settings(name)), step)
        return self._writers[name]


def _table(settings: Mapping[str, Any]) -> str:
    """Settings as a table in Markdown, which TensorBoard renders."""
    cells = ((name, json.dumps(value).replace("|", "\\|")) for name, value in settings.items())
    return "\n".join(["| setting | value |", "|---|---|", *(f"| {n} | `{v}` |" for n, v in cells)])


def _hparams(settings: Mapping[str, Any], finals: Mapping[str, float]) -> Any:
    """What makes a row of the tab HPARAMS. `add_hparams` would make a run of its own for it."""
    from tensorboardX.summary import hparams

    plain = {
        name: value if isinstance(value, bool | int | float | str) else json.dumps(value)
        for name, value in settings.items()
        if value is not None
    }
    return hparams(plain, finals)
