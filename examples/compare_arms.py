"""Does a filter help? Train two arms with several seeds, and read the verdicts.

    python examples/compare_arms.py [--steps 100000] [--seeds 6]

Run it again after an interruption: it continues and repeats nothing.
"""

import argparse

import sauna

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=100_000)
parser.add_argument("--seeds", type=int, default=6)
given = parser.parse_args()

summary = sauna.compare(
    "InvertedPendulum-v5",
    arms=("ppo", "sauna"),  # the first one is the baseline
    seeds=given.seeds,
    steps=given.steps,
    threshold=0.8,
)
for row in summary["table"]:
    iqm, low, high = row["final_iqm"]
    print(
        f"{row['label']}: final training return, IQM {iqm:.1f} [{low:.1f}, {high:.1f}], "
        f"keep rate {row['keep_rate']:.3f}, {row['seeds']} seeds"
    )
for verdict in summary["verdicts"]:
    print(verdict["text"])
print("The report is in the folder runs/compare_InvertedPendulum-v5_...")
