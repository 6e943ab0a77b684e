"""Row 4: a hostile file is refused at once, in little memory, and runs or opens nothing else."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

from faults import hostile
from faults.nursery import environment
from faults.result import Result, Tally, assert_held

MEMORY = 2**28  # bytes that a load may take beyond what the process has
SECONDS = 1.0  # of CPU
HUNG = 20.0  # by the clock, which other programs move, too
# What a load never does; opening files is judged by their place.
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
    "shutil.",
)


def experiment(least: int, seed: int, place: Path) -> Result:
    """Loads every case in one process. `worst`: its CPU seconds for the slowest refusal."""
    tally, cases = Tally(), hostile.cases()
    assert len(cases) >= least
    for number, make in enumerate(cases.values()):
        make(place / f"{number}")
    hostile.forge(place / "good")
    done = subprocess.run(
        [sys.executable, "-m", "faults.test_04_malicious_checkpoint", str(place), str(len(cases))],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=300,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == len(cases) + 1, done.stderr[-2000:]
    assert lines.pop()["error"] is None, "the harmless one was refused"
    for name, line in zip(cases, lines, strict=True):
        _judge(name, line, tally)
    return tally.result()


def _judge(name: str, line: dict, tally: Tally) -> None:
    tally.tried += 1
    tally.took(line["seconds"])
    name_of_most = "most MiB beyond what the process had"
    tally.notes[name_of_most] = max(tally.notes.get(name_of_most, 0), line["MiB"])
    if line["error"] is None:
        tally.miss(f"{name}: was loaded")
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


def _load(run: Path) -> None:
    """What `sauna eval` does before it makes a network."""
    from sauna.envs.make import env_maker
    from sauna.experiments.evaluate.artifact import load_artifact

    said: list[str] = []
    artifact = load_artifact(run, said.append)
    if artifact.config.env:
        env_maker(artifact.config.env, {})


def main() -> None:
    """Loads run directories 0, 1, ... under an audit hook; a line of JSON for each."""
    import gymnasium
    import safetensors.numpy

    import sauna.envs.host.gymnasium_envs
    import sauna.envs.make
    import sauna.experiments.evaluate.artifact
    from sauna.system.errors import SaunaError

    del gymnasium, safetensors, sauna
    place, number = Path(sys.argv[1]), int(sys.argv[2])
    events: list[str] = []
    inside: list[str] = []

    def audit(event: str, arguments: tuple) -> None:
        if not inside:
            return
        outside = (
            event == "open"
            and isinstance(arguments[0], (str, bytes, Path))
            and not str(arguments[0]).startswith(inside[0])
        )
        if outside or event.startswith(FORBIDDEN):
            events.append(f"{event} {str(arguments)[:80]}")

    sys.addaudithook(audit)
    base, before = _memory(), _resident("VmRSS")
    resource.setrlimit(resource.RLIMIT_AS, (base + MEMORY, resource.RLIM_INFINITY))
    for name in [*map(str, range(number)), "good"]:
        run, error, refused = (place / name).resolve(), None, False
        events.clear()
        clock, start = time.process_time(), time.monotonic()
        inside.append(str(run))
        try:
            _load(run)
        except SaunaError as found:
            error, refused = str(found), True
        except BaseException as found:
            error = repr(found)
        inside.clear()
        peak = (_resident("VmHWM") - before) // 1024
        print(
            json.dumps(
                {
                    "error": error,
                    "refused": refused,
                    "events": list(events),
                    "seconds": time.process_time() - clock,
                    "waited": time.monotonic() - start,
                    "MiB": peak,
                }
            )
        )


if __name__ == "__main__":
    main()


def test_every_hostile_file_is_refused_at_once(tmp_path: Path) -> None:
    assert_held(experiment(60, 0, tmp_path), 60)
    assert not Path("/tmp/sauna-was-here").exists()
