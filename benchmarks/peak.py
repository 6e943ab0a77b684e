"""How close an update comes to this machine's peak of products of matrices: `results/peak.json`.

    python benchmarks/peak.py [--rounds 5]      (two minutes, on a quiet machine)

The peak is the best rate, on one thread, of a float32 product of two 1024 x 1024 matrices, by XLA
or by NumPy's BLAS. Then three things take turns for each network: the update of PPO, the same
without its loss and its optimiser (the products alone: what both trunks multiply, forward and
backward), and the peak. The floating-point operations are those of the products. The least CPU time
of all rounds counts.

For each environment of `make.py`'s table beside Stable-Baselines3, it also stores the operations of
an env step's update. `make.py` makes of them what no trainer with these settings can exceed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

from sauna.system.jax_setup import configure_jax  # noqa: E402

configure_jax()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from make import OTHERS, RESULTS  # noqa: E402
from selection import CHEETAH, PONG, config_of, least_of_a_block, one_update  # noqa: E402

from sauna.algorithm.policy.convolutions import LAYERS  # noqa: E402
from sauna.config.settings import Config  # noqa: E402
from sauna.envs.spaces import Spaces  # noqa: E402
from sauna.system import run_directory  # noqa: E402
from sauna.training.prepare import prepare  # noqa: E402

PATH = RESULTS / "peak.json"
SIDE = 1024
NETWORKS = ("64,64", "256,256", "512,256,128")


def layers(config: Config, spaces: Spaces) -> list[list[int]]:
    """Widths from the observation to the output, of the policy's trunk and of the value's."""
    inputs = math.prod(spaces.observation_shape)
    outputs = sum(spaces.action_sizes) if spaces.action_kind == "discrete" else spaces.action_width
    value_hidden = config.value_hidden or config.hidden
    return [[inputs, *config.hidden, outputs], [inputs, *value_hidden, 1]]


def operations(trunks: Sequence[Sequence[int]]) -> int:
    """Operations of the products for one sample: each layer forward, for its weights' gradient and,
    but for the first, for its input's."""
    total = 0
    for widths in trunks:
        sizes = [a * b for a, b in pairwise(widths)]
        total += 2 * (3 * sum(sizes) - sizes[0])
    return total


def convolutions_of(pictures: Spaces) -> int:
    """Operations of the Nature CNN for one picture, with both heads, counted as in `operations`."""
    side, channels, sizes = pictures.observation_shape[0], pictures.observation_shape[-1], []
    for features, width, stride in LAYERS:
        side = (side - width) // stride + 1
        sizes.append(side**2 * width**2 * channels * features)
        channels = features
    flat = side**2 * channels
    sizes += [flat * 512, 512 * (sum(pictures.action_sizes) + 1)]
    return 2 * (3 * sum(sizes) - sizes[0])


def products_alone(config: Config, spaces: Spaces) -> Callable[[], float]:
    """A function that makes the products of one update and returns their CPU seconds."""
    trunks, batch = layers(config, spaces), config.envs * config.rollout_steps
    size = batch // config.minibatches
    rng = np.random.default_rng(0)
    weights = [
        [jnp.asarray(rng.normal(size=pair), jnp.float32) / pair[0] for pair in pairwise(widths)]
        for widths in trunks
    ]
    data = rng.normal(size=(batch, trunks[0][0])).astype(np.float32)

    def minibatch(weights: Any, x: jax.Array) -> tuple[Any, None]:
        def output(weights: Any) -> jax.Array:
            total = jnp.zeros(())
            for trunk in weights:
                hidden = x
                for matrix in trunk:
                    hidden = hidden @ matrix
                total += (hidden * hidden).sum()
            return total

        gradient = jax.grad(output)(weights)
        return jax.tree.map(lambda w, g: w - 1e-9 * g, weights, gradient), None

    @jax.jit
    def update(weights: Any, data: jax.Array) -> Any:
        pieces = data.reshape(config.minibatches, size, -1)
        epoch = lambda _, w: jax.lax.scan(minibatch, w, pieces)[0]  # noqa: E731
        return jax.lax.fori_loop(0, config.epochs, epoch, weights)

    def call() -> float:
        clock = time.process_time()
        jax.block_until_ready(update(weights, data))
        return time.process_time() - clock

    call()
    return call


def largest_products() -> list[Callable[[], float]]:
    """Functions that multiply two large matrices, by XLA and by NumPy; CPU seconds of each."""
    matrix = np.random.default_rng(0).normal(size=(SIDE, SIDE)).astype(np.float32)
    product = jax.jit(jnp.matmul)
    jax.block_until_ready(product(matrix, matrix))

    def timed(multiply: Callable[[Any, Any], Any]) -> Callable[[], float]:
        def call() -> float:
            clock = time.process_time()
            jax.block_until_ready(multiply(matrix, matrix))
            return time.process_time() - clock

        return call

    return [timed(product), timed(np.matmul)]


def measure(hidden: str, rounds: int) -> dict[str, Any]:
    """The update's and its products' rates beside the peak, in turn."""
    config = config_of({"hidden": hidden}, CHEETAH)
    of_a_sample = operations(layers(config, CHEETAH))
    samples = config.envs * config.rollout_steps * config.epochs
    update = one_update(config, CHEETAH, False, time.process_time)
    products, large = products_alone(config, CHEETAH), largest_products()
    least = dict.fromkeys(("update", "products", "large"), math.inf)
    for _ in range(rounds):
        for name, calls in (("update", [update]), ("products", [products]), ("large", large)):
            least[name] = min(least[name], *(least_of_a_block(call) for call in calls))
    peak = 2 * SIDE**3 / least["large"]
    done = of_a_sample * samples
    return {
        "hidden": list(config.hidden),
        "gradient_steps": config.epochs * config.minibatches,
        "samples_of_a_minibatch": config.envs * config.rollout_steps // config.minibatches,
        "operations_of_a_sample": of_a_sample,
        "peak_gflops": peak / 1e9,
        "update_seconds": least["update"],
        "update_of_peak": done / least["update"] / peak,
        "products_seconds": least["products"],
        "products_of_peak": done / least["products"] / peak,
    }


def measure_cnn(rounds: int, peak: float) -> dict[str, Any]:
    """The rate of Pong's update, of the peak."""
    config = config_of({"preset": "atari"}, PONG)
    update, samples = one_update(config, PONG, False, time.process_time), config.epochs
    samples *= config.envs * config.rollout_steps
    seconds = min(least_of_a_block(update) for _ in range(rounds))
    done = convolutions_of(PONG) * samples
    return {
        "operations_of_a_sample": convolutions_of(PONG),
        "update_seconds": seconds,
        "update_of_peak": done / seconds / (1e9 * peak),
    }


def operations_of_an_env_step(name: str) -> int:
    """Operations that the update makes for one env step, in the setting of a bench."""
    stored = json.loads((RESULTS / f"{name}.json").read_text())
    env_kwargs = json.loads(stored["peer"]["settings"]["env_kwargs"])
    hidden = ",".join(map(str, stored["peer"]["settings"]["hidden"]))
    run = {"env": stored["env"], "env_kwargs": env_kwargs, "preset": stored["preset"]}
    job = prepare({**run, "hidden": hidden, "arm": "ppo"}).job()
    return operations(layers(job.config, job.spaces)) * job.config.epochs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    sys.path.append(str(RESULTS.parent))  # `own_envs`
    measured = [name for name in OTHERS if (RESULTS / f"{name}.json").exists()]
    networks = [measure(hidden, rounds) for hidden in NETWORKS]
    peak = max(network["peak_gflops"] for network in networks)
    result = {
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
        "rounds": rounds,
        "networks": networks,
        "nature_cnn": measure_cnn(rounds, peak),
        "operations_of_an_env_step": {name: operations_of_an_env_step(name) for name in measured},
    }
    PATH.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
