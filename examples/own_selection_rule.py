"""Train with a selection rule of your own, next to a random control.

    python examples/own_selection_rule.py [--steps 100000]

The rule keeps the steps where the Vex head predicts least, by rank. It drops about half of the
steps, so it also learns from half of them. Therefore a control is trained, too, which drops as
many at random. Two seeds decide nothing: `examples/compare_arms.py` shows how to get a verdict.
"""

import argparse

import sauna
from sauna.algorithm.selection.history import empty_history, insert, median


def init(num_envs, capacity):
    """The rule's state at the start of a rollout: no prediction seen yet."""
    return empty_history((num_envs,), capacity)


def keep(history, step, key, hypers):
    """The new state, and which of the N environments keep this step."""
    return insert(history, step.vex), (step.vex <= median(history)) | (history.number == 0)


lower_half = sauna.StepFilter(init, keep)

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    settings = {
        "arm": "sauna",
        "filter": "own_selection_rule:lower_half",
        "seeds": 2,
        "steps": parser.parse_args().steps,
    }
    rule = sauna.train("InvertedPendulum-v5", **settings)
    control = sauna.train("InvertedPendulum-v5", control="random", **settings)
    for name, result in (("rule", rule), ("random control", control)):
        for member, row in result.summary.items():
            returned = row.get("return_mean", float("nan"))
            print(
                f"{name}, {member}: training return {returned:.1f}, "
                f"kept {row['kept_steps']:,} of {row['env_steps']:,} env steps"
            )
