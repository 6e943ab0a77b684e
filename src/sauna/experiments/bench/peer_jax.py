"""PPO of rejax, or of PureJaxRL's script, with our settings; prints its env steps per second.

Run by an interpreter of the peer's own environment, with one argument: the settings as JSON, by our
names (`peer_settings.py`), besides `peer`, `seed`, `seconds` and `script`, PureJaxRL's `ppo.py`.

A training is one compiled function of a key. It is compiled before it is timed. It has as many
iterations as fill the seconds, without evaluations.

Equal to ours: one thread of XLA, the environment and its parameters, environments and steps of a
rollout, minibatches, epochs, both networks, and the numbers of the loss and of the optimiser.

Not equal:

- gymnax is older: since version 1 a step returns six values, and both read five.
- Both take a time limit for an end. We bootstrap the value there.
- rejax clips each element of a gradient at `max_grad_norm`. We and PureJaxRL clip the norm.
- rejax leaves Adam's epsilon at 1e-8 and starts from flax's usual weights.
- PureJaxRL returns the episode's length and return at every env step. rejax returns nothing.
"""

import importlib.util
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

FEW = 16  # iterations, to learn how long one takes


def env_steps_per_second(
    training: Callable[[int], Callable[[Any], Any]], batch: int, seconds: float, seed: int
) -> float:
    """The rate of a training that takes at least `seconds`.

    Args:
      training: gives the function that trains for so many iterations.
      batch: env steps of an iteration.
    """
    import jax

    iterations, key = FEW, jax.random.PRNGKey(seed)
    while True:
        compiled = jax.jit(training(iterations)).lower(key).compile()
        clock = time.perf_counter()
        jax.block_until_ready(compiled(key))
        taken = time.perf_counter() - clock
        if taken >= seconds:
            return iterations * batch / taken
        iterations = math.ceil(iterations * max(2.0, 1.2 * seconds / taken))


def rejax_training(settings: dict[str, Any], iterations: int) -> Callable[[Any], Any]:
    import gymnax
    import optax
    from flax import linen
    from rejax import PPO
    from rejax.networks import VNetwork

    env, params = gymnax.make(settings["env"])
    batch = settings["envs"] * settings["rollout_steps"]
    learning_rate = settings["learning_rate"]
    if settings["learning_rate_schedule"] == "linear":
        updates = iterations * settings["epochs"] * settings["minibatches"]
        learning_rate = optax.linear_schedule(learning_rate, 0.0, updates)
    hidden, activation = tuple(settings["hidden"]), settings["activation"]
    algorithm = PPO.create(
        env=env,
        env_params=params.replace(**json.loads(settings["env_kwargs"])),
        agent_kwargs={"hidden_layer_sizes": hidden, "activation": activation},
        total_timesteps=iterations * batch,
        eval_freq=iterations * batch,
        skip_initial_evaluation=True,
        num_envs=settings["envs"],
        num_steps=settings["rollout_steps"],
        num_minibatches=settings["minibatches"],
        num_epochs=settings["epochs"],
        learning_rate=learning_rate,
        max_grad_norm=settings["max_grad_norm"],
        gamma=settings["gamma"],
        gae_lambda=settings["gae_lambda"],
        clip_eps=settings["clip_range"],
        ent_coef=settings["entropy_coef"],
        vf_coef=settings["value_coef"],
        normalize_observations=settings["normalize_observations"],
        normalize_rewards=settings["normalize_rewards"],
        reward_normalization_discount=settings["gamma"],
    )
    value = VNetwork(tuple(settings["value_hidden"]) or hidden, getattr(linen, activation))
    algorithm = algorithm.replace(critic=value, eval_callback=lambda algorithm, state, key: ())
    return lambda key: algorithm.train(key)[0]


def purejaxrl_training(
    settings: dict[str, Any], script: ModuleType, iterations: int
) -> Callable[[Any], Any]:
    return script.make_train(
        {
            "ENV_NAME": settings["env"],
            "NUM_ENVS": settings["envs"],
            "NUM_STEPS": settings["rollout_steps"],
            "TOTAL_TIMESTEPS": iterations * settings["envs"] * settings["rollout_steps"],
            "NUM_MINIBATCHES": settings["minibatches"],
            "UPDATE_EPOCHS": settings["epochs"],
            "LR": settings["learning_rate"],
            "ANNEAL_LR": settings["learning_rate_schedule"] == "linear",
            "MAX_GRAD_NORM": settings["max_grad_norm"],
            "GAMMA": settings["gamma"],
            "GAE_LAMBDA": settings["gae_lambda"],
            "CLIP_EPS": settings["clip_range"],
            "ENT_COEF": settings["entropy_coef"],
            "VF_COEF": settings["value_coef"],
            "ACTIVATION": settings["activation"],
        }
    )


def load(script: Path) -> ModuleType:
    """Imports PureJaxRL's script and, from beside it, its wrappers.

    The wrappers of Brax and of NAVIX, which it does not use, import these two: empty modules do.
    """
    unused = ("brax", "brax.envs", "brax.envs.wrappers", "brax.envs.wrappers.training", "navix")
    for name in unused:
        sys.modules[name] = ModuleType(name)
    sys.modules["brax"].__dict__["envs"] = sys.modules["brax.envs"]
    for name in ("EpisodeWrapper", "AutoResetWrapper"):
        sys.modules["brax.envs.wrappers.training"].__dict__[name] = None
    sys.path.insert(0, str(script.parent))
    spec = importlib.util.spec_from_file_location("purejaxrl_ppo", script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(settings: dict[str, Any]) -> None:
    settings["env"] = settings["env"].removeprefix("gymnax/")
    if settings["peer"] == "rejax":

        def training(iterations: int) -> Callable[[Any], Any]:
            return rejax_training(settings, iterations)
    else:
        script = load(Path(settings["script"]))

        def training(iterations: int) -> Callable[[Any], Any]:
            return purejaxrl_training(settings, script, iterations)

    batch = settings["envs"] * settings["rollout_steps"]
    rate = env_steps_per_second(training, batch, settings["seconds"], settings["seed"])
    print(json.dumps({"rate": rate}))


if __name__ == "__main__":
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ.setdefault("PJRT_NPROC", "1")  # threads, as in our own trainings
    main(json.loads(sys.argv[1]))
