"""Brax's PPO on the same task, batch and network; prints its env steps per second.

Run by this project's interpreter (it needs the extra `brax`, and for Playground's tasks
`playground`), so that both see the same JAX and the same device.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from typing import Any

from sauna.config.presets import resolve_run
from sauna.system.jax_setup import configure_jax
from sauna.training.prepare import place

EPOCHS = 4  # the first holds the compilation


def rate(overrides: dict[str, Any], iterations: int) -> float:
    config = place(resolve_run(overrides)).config
    configure_jax(0, config.device)
    import jax

    if not hasattr(jax, "device_put_replicated"):  # gone since JAX 0.10, and Brax calls it
        jax.device_put_replicated = lambda x, devices: jax.tree.map(
            lambda leaf: jax.numpy.stack([leaf] * len(devices)), x
        )
    from brax.training.agents.ppo import networks, train

    backend, _, name = config.env.partition("/")
    kwargs = json.loads(config.env_kwargs)
    if backend == "playground":
        from mujoco_playground import registry, wrapper

        from sauna.envs.device.playground_envs import own_config

        own = own_config(name, kwargs)
        env = registry.load(name, config=own)
        length, repeat = own.episode_length, own.action_repeat
        more: dict[str, Any] = {"wrap_env_fn": wrapper.wrap_for_brax_training}
    else:
        from brax import envs

        length, repeat = kwargs.pop("episode_length", 1000), kwargs.pop("action_repeat", 1)
        env, more = envs.get_environment(name, **kwargs), {}
    batch = config.envs * config.rollout_steps
    seen: list[tuple[float, int]] = []
    train.train(
        environment=env,
        num_timesteps=batch * repeat * iterations * EPOCHS,  # Brax counts repeated steps, too
        num_evals=EPOCHS + 1,
        run_evals=False,
        episode_length=length,
        action_repeat=repeat,
        num_envs=config.envs,
        unroll_length=config.rollout_steps,
        batch_size=config.envs // config.minibatches,
        num_minibatches=config.minibatches,
        num_updates_per_batch=config.epochs,
        normalize_observations=True,
        learning_rate=config.learning_rate,
        discounting=config.gamma,
        clipping_epsilon=config.clip_range,
        max_grad_norm=config.max_grad_norm,
        network_factory=functools.partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=config.hidden,
            value_hidden_layer_sizes=config.value_hidden or config.hidden,
            activation=getattr(jax.nn, config.activation),
        ),
        progress_fn=lambda steps, metrics: seen.append((time.perf_counter(), steps)),
        **more,
    )
    (first, before), (last, after) = seen[1] if len(seen) > 2 else seen[0], seen[-1]
    return (after - before) / repeat / (last - first)


if __name__ == "__main__":
    print(json.dumps({"brax": rate(json.loads(sys.argv[1]), int(sys.argv[2]))}))
