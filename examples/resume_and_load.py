"""Interrupt a run, resume it, and load its policy.

    python examples/resume_and_load.py [--steps 100000]

The run ends with the same bytes as one that nobody interrupted. The script shows it: it trains
twice, interrupts the second training, resumes it, and compares the rows of metrics.
"""

import argparse
import os
import signal
import tempfile
import threading
from pathlib import Path

import sauna

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=100_000)
settings = {"arm": "ppo", "steps": parser.parse_args().steps, "checkpoint_every": 1, "quiet": True}
folder = Path(tempfile.mkdtemp(prefix="resume_"))

alone = sauna.train("InvertedPendulum-v5", out=folder / "alone", **settings)


def interrupt_after_the_first_row(rows: Path) -> None:
    """Presses Ctrl-C once the run has written something."""
    while not (rows.exists() and rows.stat().st_size):
        stopped.wait(0.05)
    os.kill(os.getpid(), signal.SIGINT)


stopped = threading.Event()
rows = folder / "interrupted" / "metrics.jsonl"
threading.Thread(target=interrupt_after_the_first_row, args=(rows,), daemon=True).start()
try:
    sauna.train("InvertedPendulum-v5", out=folder / "interrupted", **settings)
except (KeyboardInterrupt, sauna.SaunaError) as error:
    print("interrupted:", error)

resumed = sauna.resume(folder / "interrupted", quiet=True)
print("rows are the same:", resumed.metrics == alone.metrics)

policy = sauna.load(folder / "interrupted")  # of the newest checkpoint, normaliser included
print("policy of", policy.name, "loaded from", folder / "interrupted")
