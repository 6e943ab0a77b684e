"""Row 15: a hostile run, study or config is refused at once, and runs or touches nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from faults import hostile_runs
from faults.audit import audit, judge
from faults.nursery import SOURCE, environment
from faults.result import Result, Tally, assert_held


def experiment(least: int, seed: int, place: Path) -> Result:
    """Opens every case in one process. `worst`: its CPU seconds for the slowest refusal."""
    tally, cases = Tally(), hostile_runs.cases()
    assert len(cases) >= least
    trace = place / "was-run"
    (place / "evil_of_somebody.py").write_text(hostile_runs.TRAP.format(file=str(trace)))
    folders = {}
    for number, (name, (opener, change)) in enumerate(cases.items()):
        folders[name] = (str(place / f"{number:03d}"), opener)
        hostile_runs.make_good(place / f"{number:03d}")
        change(place / f"{number:03d}")
    for opener in ("resume", "eval"):
        folders[f"good {opener}"] = (str(place / f"good-{opener}"), opener)
        hostile_runs.make_good(place / f"good-{opener}")
    listed = place / "cases.json"
    listed.write_text(json.dumps(folders))
    done = subprocess.run(
        [sys.executable, "-m", "faults.test_15_hostile_runs", str(listed)],
        capture_output=True,
        text=True,
        env=environment(),
        cwd=place,
        timeout=600,
    )
    lines = {line["name"]: line for line in map(json.loads, done.stdout.splitlines())}
    assert list(lines) == list(folders), done.stderr[-2000:]
    for opener in ("resume", "eval"):
        assert lines.pop(f"good {opener}")["error"] is None, "the harmless one was refused"
    for line in lines.values():
        judge(line, tally)
    if trace.exists():
        tally.miss("a module of somebody else's was imported")
    return tally.result()


def _resume(run: Path) -> None:
    """What `sauna resume` does before it starts a worker."""
    from sauna.system import logs, run_directory
    from sauna.training import run as runs
    from sauna.training.display import PlainDisplay
    from sauna.training.train import _load

    run_directory.is_complete(run)
    display = PlainDisplay()
    display.say = lambda text: None  # type: ignore[method-assign]
    reopened = runs.reopen(run, {}, display)
    try:
        _load(reopened, display)
        for name in logs.NAMES:
            logs.check_own(run / name)
    finally:
        reopened.lock.close()


def _eval(run: Path) -> None:
    """What `sauna eval` does before it plays."""
    from sauna.envs.make import make_env
    from sauna.experiments.evaluate.policy import TrainedPolicy
    from sauna.training.artifact import check_spaces, find_member, load_artifact

    artifact = load_artifact(run, lambda text: None)
    name = find_member(artifact.members, artifact.members[0])
    env = make_env(artifact.config.env, {})
    check_spaces(artifact, env)
    env.close()
    if run.name != "good-eval":  # whose network is of another environment
        TrainedPolicy(artifact, name, env)


def _study(run: Path) -> None:
    """What `sauna study FILE` does before it looks at the environments."""
    from sauna.experiments.study.command import check_study
    from sauna.experiments.study.spec import load_spec

    load_spec(str(run / "study.toml"), lambda text: check_study(text, run, False))


def _train(run: Path) -> None:
    """What `sauna train --config FILE` does first."""
    from sauna.config.settings_file import settings_in

    settings_in(str(run / "config.json"), False)


OPENERS = {"resume": _resume, "eval": _eval, "study": _study, "train": _train}


def main() -> None:
    """Opens all cases under an audit hook, once everything of ours is imported."""
    import jax

    from sauna.config.trust import key_file, seal

    # The last is imported by `importlib.resources`, at its first use.
    ours = ("sauna.cli", "sauna.config.settings_file", "sauna.experiments.study.command")
    for module in (*ours, "importlib.readers"):
        import_module(module)
    seal({"env": "a:b"})  # makes the key
    folders = json.loads(Path(sys.argv[1]).read_text())
    jax.numpy.zeros(3).block_until_ready()
    for opener in ("resume", "eval"):  # imports what they import, before anybody watches
        OPENERS[opener](Path(folders[f"good {opener}"][0]))
    audit(
        {name: Path(folder) for name, (folder, _) in folders.items()},
        lambda name: OPENERS[folders[name][1]](Path(folders[name][0])),
        # Versions of packages, a model of Gymnasium's, our studies, and this user's key.
        ("/proc/", sys.prefix, sys.base_prefix, str(SOURCE), str(key_file().resolve())),
    )


if __name__ == "__main__":
    main()


def test_every_hostile_run_is_refused_at_once(tmp_path: Path) -> None:
    assert_held(experiment(60, 0, tmp_path), 60)
