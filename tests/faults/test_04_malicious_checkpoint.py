"""Row 4: a hostile file is refused at once, in little memory, and runs or opens nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from faults import hostile
from faults.audit import audit, judge
from faults.nursery import environment
from faults.result import Result, Tally, assert_held


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
        judge({**line, "name": name}, tally)
    return tally.result()


def _load(run: Path) -> None:
    """What `sauna eval` does before it makes a network."""
    from sauna.envs.make import env_maker
    from sauna.training.artifact import load_artifact

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
    import sauna.training.artifact

    del gymnasium, safetensors, sauna
    place, number = Path(sys.argv[1]), int(sys.argv[2])
    places = {name: place / name for name in [*map(str, range(number)), "good"]}
    audit(places, lambda name: _load(places[name].resolve()))


if __name__ == "__main__":
    main()


def test_every_hostile_file_is_refused_at_once(tmp_path: Path) -> None:
    assert_held(experiment(60, 0, tmp_path), 60)
    assert not Path("/tmp/sauna-was-here").exists()
