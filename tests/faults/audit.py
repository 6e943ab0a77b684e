"""Opening hostile files under an audit hook, with little memory: what happened, as JSON lines."""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faults.result import Tally

MEMORY = 2**28  # bytes that opening may take beyond what the process has
SECONDS = 1.0  # of CPU
HUNG = 20.0  # by the clock, which other programs move, too
# What opening never does; opening files is judged by their place.
FORBIDDEN = (
    "exec",
    "compile",
    "import",
    "pickle.",
    "marshal.",
    "os.system",
    "os.exec",
    "os.fork",
    "os.posix_spawn",
    "os.spawn",
    "subprocess.",
    "socket.",
    "ctypes.",
    "os.remove",
    "os.rename",
    "os.mkdir",
    "os.truncate",
    "os.link",
    "os.symlink",
    "shutil.",
)


def audit(
    places: dict[str, Path], opened: Callable[[str], Any], shared: tuple[str, ...] = ()
) -> None:
    """Opens each place; a line of JSON for each.

    Args:
      places: by name, the folder that opening may read and write.
      opened: opens the one of that name.
      shared: what else may be read.
    """
    from sauna.system.errors import SaunaError

    events: list[str] = []
    inside: list[str] = []

    def hook(event: str, arguments: tuple) -> None:
        if not inside:
            return
        named = arguments[0] if event == "open" else None
        written = event == "open" and int(arguments[2]) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        fine = (inside[0],) if written else (inside[0], *shared)
        outside = isinstance(named, (str, bytes, Path)) and not str(named).startswith(fine)
        # `inspect` parses the signature that a function of C has as text; nothing is run.
        source = arguments[0] if event == "compile" else None
        parsed = isinstance(source, bytes) and source.startswith(b"def foo(")
        if outside or (event.startswith(FORBIDDEN) and not parsed):
            events.append(f"{event} {str(arguments)[:80]}")

    sys.addaudithook(hook)
    base, before = _memory(), _resident("VmRSS")
    resource.setrlimit(resource.RLIMIT_AS, (base + MEMORY, resource.RLIM_INFINITY))
    for name, place in places.items():
        error, refused = None, False
        events.clear()
        clock, start = time.process_time(), time.monotonic()
        inside.append(str(place.resolve()))
        try:
            opened(name)
        except SaunaError as found:
            error, refused = str(found), True
        except BaseException as found:
            error = repr(found)
        inside.clear()
        line = {
            "name": name,
            "error": error,
            "refused": refused,
            "events": list(events),
            "seconds": time.process_time() - clock,
            "waited": time.monotonic() - start,
            "MiB": (_resident("VmHWM") - before) // 1024,
        }
        print(json.dumps(line), flush=True)


def judge(line: dict[str, Any], tally: Tally) -> None:
    """Counts one line: it has to be a refusal, at once, and nothing else."""
    name = line["name"]
    tally.tried += 1
    tally.took(line["seconds"])
    name_of_most = "most MiB beyond what the process had"
    tally.notes[name_of_most] = max(tally.notes.get(name_of_most, 0), line["MiB"])
    if line["error"] is None:
        tally.miss(f"{name}: was opened")
    elif not line["refused"]:
        tally.lose(f"{name}: ended with {line['error']}")
    if line["events"]:
        tally.miss(f"{name}: did {line['events']}")
    if line["seconds"] >= SECONDS or line["waited"] >= HUNG:
        tally.lose(f"{name}: took {line['seconds']} s, waited {line['waited']} s")


def _memory() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _resident(field: str) -> int:
    """KiB of resident memory: now, or the most there ever was."""
    status = Path("/proc/self/status").read_text()
    return int(status.split(f"{field}:")[1].split()[0])
