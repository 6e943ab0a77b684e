"""What `results/clone.json` says, for `docs/how-to/record_and_clone.md`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ROWS = {
    "expert": "the policy that was recorded",
    "clone": "clones, before any step of PPO",
    "clone_trained": "clones, trained on",
    "from_scratch": "trained as long from scratch",
}


def clone_text(tasks: Mapping[str, Any]) -> str:
    """A table for each task: mean returns of the members, least to most."""
    parts = [
        "`python results/clone.py` (numbers in `results/clone.json`); three members each, "
        "returns of 10 episodes:"
    ]
    for env, found in tasks.items():
        data, more = found["recorded"], found["env_steps_afterwards"]
        parts.append(
            f"{env}: {data['episodes']} recorded episodes, {data['env_steps']:,} env steps, "
            f"sampled actions, mean return {data['mean_return']:.1f}; {more:,} env steps of PPO "
            "afterwards."
        )
        rows = ["| | sampled actions | most likely actions |", "|---|---|---|"]
        for name, words in ROWS.items():
            returns = found["returns"][name]
            cells = (_text(returns[mode]) for mode in ("sampled", "likeliest"))
            rows.append(f"| {words} | {' | '.join(cells)} |")
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _text(returns: list[float]) -> str:
    return ", ".join(f"{x:.0f}" for x in sorted(returns))
