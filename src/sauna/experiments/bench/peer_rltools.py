"""RLtools' PPO with our settings, compiled for this machine; prints its env steps per second.

Run by an interpreter of its own environment, with one argument: the settings as JSON, by our names
(`peer_settings.py`), besides `seed` and `seconds`. The training loop is C++ with every size a
constant, compiled by RLtools itself with `-O3 -march=native -ffast-math` and MKL in one thread,
once for these settings. The environment is Gymnasium's, which it calls from C++ at every env step.
The rate is that of whole rollouts and updates, after the first two.

What stays different: it has no normalisation of observations and rewards, no clipping of the
gradient's norm or of the value's change, and a constant learning rate. So it has less to do than
we have. Its tanh is the fast of its two, an approximation. Its Adam has an epsilon of 1e-7. Each
layer has the same width. An action reaches the simulator unclipped.
"""

import fcntl
import hashlib
import json
import math
import os
import sys
import tempfile
import time
from types import ModuleType

import gymnasium
import numpy as np

settings = json.loads(sys.argv[1])
# It keeps what it compiles in the folder of temporary files, as it finds it when it is imported.
compiled = os.path.join(sys.prefix, "compiled")
os.makedirs(compiled, exist_ok=True)
tempfile.tempdir = compiled
import rltools  # noqa: E402

tempfile.tempdir = None
OF_A_RUN = ("seed", "seconds", "folder")
ACTIVATIONS = {"tanh": "FAST_TANH"}  # the others have our names, in capitals
FOREVER = 1_000_000_000


def make_env() -> gymnasium.Env:
    kwargs = json.loads(settings["env_kwargs"])
    env = gymnasium.make(settings["env"], disable_env_checker=True, **kwargs)
    box = env.action_space
    if np.all(box.low == -1) and np.all(box.high == 1):
        return env
    return gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))


def network(role: str) -> dict[str, object]:
    """Sizes of the `ACTOR` or of the `CRITIC`; it counts the layer of the outputs."""
    activation = settings["activation"]
    return {
        f"{role}_HIDDEN_DIM": settings["hidden"][0],
        f"{role}_NUM_LAYERS": len(settings["hidden"]) + 1,
        f"{role}_ACTIVATION_FUNCTION": ACTIVATIONS.get(activation, activation.upper()),
    }


def compiled_training() -> ModuleType:
    """The module of these settings, which only the first process compiles."""
    shaping = {name: value for name, value in settings.items() if name not in OF_A_RUN}
    digest = hashlib.sha256(json.dumps(shaping, sort_keys=True).encode()).hexdigest()[:16]
    batch = settings["envs"] * settings["rollout_steps"]
    with open(os.path.join(compiled, f"{digest}.lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return rltools.PPO(
            make_env,
            interface_name=digest,
            enable_evaluation=False,
            STEP_LIMIT=FOREVER,
            N_ENVIRONMENTS=settings["envs"],
            ON_POLICY_RUNNER_STEPS_PER_ENV=settings["rollout_steps"],
            BATCH_SIZE=batch // settings["minibatches"],
            N_EPOCHS=settings["epochs"],
            OPTIMIZER_ALPHA=settings["learning_rate"],
            EPSILON_CLIP=settings["clip_range"],
            NORMALIZE_ADVANTAGE=settings["normalize_advantages"],
            ACTION_ENTROPY_COEFFICIENT=settings["entropy_coef"],
            GAMMA=settings["gamma"],
            LAMBDA=settings["gae_lambda"],
            INITIAL_ACTION_STD=math.exp(settings["log_std_init"]),
            **network("ACTOR"),
            **network("CRITIC"),
        )


training = compiled_training().State(settings["seed"])
seen: list[float] = []
while len(seen) < 5 or seen[-1] - seen[2] < settings["seconds"]:
    seen.append(time.perf_counter())
    training.step()
env_steps = settings["envs"] * settings["rollout_steps"] * (len(seen) - 3)
print(json.dumps({"rate": env_steps / (seen[-1] - seen[2])}))
