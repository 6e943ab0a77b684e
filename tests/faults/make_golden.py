"""Writes `golden/format-N-BACKEND`: a run as this version leaves it when it is killed.

    python tests/faults/make_golden.py

Once for every format of checkpoints, by the last version that writes it; never again after that.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]
GOLDEN = Path(__file__).resolve().parent / "golden"


def main() -> None:
    import sauna
    from faults.canned import BACKENDS, SETTINGS
    from sauna.system.checkpoint import FORMAT, numbered

    GOLDEN.mkdir(exist_ok=True)
    os.chdir(GOLDEN)
    for backend, env in BACKENDS.items():
        run = Path(f"format-{FORMAT}-{backend}")
        if run.exists():
            continue
        with (
            patch("sauna.system.run_directory.git_revision", lambda: None),
            patch("sauna.system.run_directory.machine", dict),
        ):
            sauna.train(
                env, out=run, quiet=True, checkpoint_every=2, keep_checkpoints=3, **SETTINGS
            )
        for path in (run / "summary.json", run / ".lock"):
            path.unlink()
        shutil.rmtree(run / "figures")
        shutil.rmtree(numbered(run / "checkpoints")[-1])


if __name__ == "__main__":
    main()
