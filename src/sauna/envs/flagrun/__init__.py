"""HumanoidFlagrunHarder: a humanoid runs to flags, gets up when it fell, and is thrown a cube at.

`host.py` is the Gymnasium environment on MuJoCo, `device.py` the same for the accelerator; both
step `humanoid.xml` and share `task.py`.
"""

from __future__ import annotations

ID = "sauna/HumanoidFlagrunHarder-v0"


def register() -> None:
    """Tells Gymnasium of the environment; its own time limit truncates, so none is asked for."""
    import gymnasium

    if ID not in gymnasium.registry:
        gymnasium.register(ID, "sauna.envs.flagrun.host:HumanoidFlagrunHarder")
