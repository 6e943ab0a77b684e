"""TensorBoard: one event folder per member, over its env steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sauna.system.safe_write import own_folder
from sauna.training.tracking.tracker import TrackedRun, Tracker, scalars


class TensorBoard(Tracker):
    """Writes `RUN/tensorboard/ARM/SEED`."""

    def __init__(self) -> None:
        self._writers: dict[str, Any] = {}

    def open(self, run: TrackedRun) -> dict[str, Any]:
        self._folder = run.path / "tensorboard"
        return {}

    def row(self, row: Mapping[str, Any]) -> None:
        writer = self._writer(row)
        for name, value in scalars(row).items():
            writer.add_scalar(name, value, row["env_steps"])

    def picture(self, name: str, path: Path) -> None:
        import numpy as np
        from PIL import Image

        image = np.asarray(Image.open(path).convert("RGB"))
        for writer in self._writers.values():
            writer.add_image(name, image, dataformats="HWC")

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()

    def _writer(self, row: Mapping[str, Any]) -> Any:
        from tensorboardX import SummaryWriter

        name = row["member"]
        if name not in self._writers:
            for folder in (self._folder, self._folder / row["arm"], self._folder / name):
                own_folder(folder)
            self._writers[name] = SummaryWriter(
                str(self._folder / name), purge_step=row["env_steps"]
            )
        return self._writers[name]
