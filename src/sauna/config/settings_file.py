"""The settings of a run, or in a file that a user wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sauna.config.presets import overrides_of
from sauna.config.stored import read_stored
from sauna.config.trust import check_trusted
from sauna.system.run_directory import read_config_file


def settings_in(file: str, trust: bool) -> dict[str, Any]:
    """Reads the settings that a new run takes from another one, or from a file.

    Args:
      file: a run directory, its `config.json`, or a JSON file of plain settings.
      trust: the code that the file names may be another user's.

    Raises:
      BadInput: there is no such file, or it names code of somebody else's.
    """
    path = Path(file)
    stored = read_config_file(path / "config.json" if path.is_dir() else path)
    check_trusted(stored, file, stored.pop("seal", None), trust)
    if "config" not in stored:
        return stored
    found = overrides_of(read_stored(stored))
    if earlier := stored.get("extended"):  # resumed, perhaps with `--restart-schedule`
        start = earlier[0]["schedule_start"]
        found = {name: value for name, value in found.items() if name != "schedule_start"}
        return found | ({"schedule_start": start} if start else {})
    return found
