"""HumanoidFlagrunHarder: a humanoid runs to flags, gets up when it fell, and is thrown a cube at.

`host.py` is the Gymnasium environment on MuJoCo, `device.py` the same for the accelerator; both
step `humanoid.xml` and share `task.py`. Importing this package registers the environment.
"""

from __future__ import annotations

import gymnasium

ID = "sauna/HumanoidFlagrunHarder-v0"

# The environment truncates by itself, so that both forms share the time limit.
gymnasium.register(ID, "sauna.envs.flagrun.host:HumanoidFlagrunHarder")
