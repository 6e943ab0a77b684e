"""The rows of `metrics.jsonl` for TensorBoard, one event folder per member."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from sauna.config.settings import Config
from sauna.system.errors import BadInput
from sauna.system.safe_write import own_folder


class TensorBoard:
    """Writes nothing unless the config asks for it. The x-axis is the member's env steps."""

    def __init__(self, run: Path, config: Config) -> None:
        self._folder = run / "tensorboard" if config.tensorboard else None
        self._writers: dict[str, Any] = {}

    @staticmethod
    def check(config: Config) -> None:
        """Refuses the setting where the library is missing, naming the extra."""
        if config.tensorboard and importlib.util.find_spec("tensorboardX") is None:
            raise BadInput("tensorboard: needs `pip install sauna-rl[tensorboard]`")

    def write(self, rows: list[dict[str, Any]], timing: dict[str, Any]) -> None:
        if self._folder is None:
            return
        for row in rows:
            writer, step = self._writer(row), row["env_steps"]
            for name, value in row.items():
                if isinstance(value, float):
                    writer.add_scalar(name, value, step)
            for name in ("kept_steps", "episodes"):
                writer.add_scalar(name, row[name], step)
            if row["episode_returns"]:
                mean = sum(row["episode_returns"]) / len(row["episode_returns"])
                writer.add_scalar("episode_return", mean, step)
            for name in ("steps_per_second", "wall_seconds"):
                writer.add_scalar(name, timing[name], step)

    def _writer(self, row: dict[str, Any]) -> Any:
        from tensorboardX import SummaryWriter

        assert self._folder is not None
        name = row["member"]
        if name not in self._writers:
            for folder in (self._folder, self._folder / row["arm"], self._folder / name):
                own_folder(folder)
            self._writers[name] = SummaryWriter(str(folder), purge_step=row["env_steps"])
        return self._writers[name]

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()
