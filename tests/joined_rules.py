"""Every rule of selection once, joined so that few programs have to be compiled."""

from __future__ import annotations

from typing import Any

JOINED = (
    "ppo",
    "sauna+gigaflow+spo",
    "sauna-paper+top-advantage+avec",
    "sauna-reference",
    "random-drop+prioritized+target-kl",
    "gradient-norm+sample-dropout+espo",
    "kondo+merl",
    "pods+recompute",
    "vex-oracle+delight",
    "vex-head+positive",
)


def joined(arm: str) -> dict[str, Any]:
    """The arm, and what its rules need besides."""
    return {"arm": arm, **({"drop_rate": 0.3} if "random-drop" in arm else {})}
