"""How close an update comes to this machine's peak of products of matrices: `results/peak.json`.

    python benchmarks/peak.py [--rounds 5]      (five minutes, on a quiet machine)
    python benchmarks/peak.py --bounds          counts the operations of an env step anew, no more

The peak is the best rate, on one thread, of a float32 product of two 1024 x 1024 matrices, by XLA
or by NumPy's BLAS. Then four things take turns for each network: the update of PPO, the same
without its loss and its optimiser (the products alone: what both trunks multiply, forward and
backward), the optimiser alone, and the peak. The floating-point operations are those of the
products. The least CPU time of all rounds counts.

For each training of `make.py`'s tables beside another trainer, it also stores the operations of an
env step's update. `make.py` makes of them what no trainer with these settings can exceed.
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
from pathlib import Path
from typing import Any

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

from sauna.system.jax_setup import configure_jax  # noqa: E402

configure_jax()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import optax  # noqa: E402
from make import BOUNDED, MEASURED, RESULTS  # noqa: E402
from selection import CHEETAH, PONG, config_of, least_of_a_block, one_update  # noqa: E402

from sauna.algorithm.learner.optimizers import optimizer, scaling  # noqa: E402
from sauna.algorithm.policy.convolutions import LAYERS  # noqa: E402
from sauna.algorithm.policy.policy import make_policy  # noqa: E402
from sauna.algorithm.types import Hypers  # noqa: E402
from sauna.config.settings import Config  # noqa: E402
from sauna.envs.spaces import Spaces  # noqa: E402
from sauna.system import run_directory  # noqa: E402
from sauna.training.prepare import prepare  # noqa: E402

PATH = RESULTS / "peak.json"
SIDE = 1024
PICTURES = 8  # whose products of the convolutions are made together
POLE = Spaces("vector", (4,), "discrete", (2,), "", "")
BREAKOUT = Spaces("vector", (400,), "discrete", (3,), "", "")
# Whose update, its settings, and the spaces.
UPDATES: list[tuple[str, dict[str, Any], Spaces]] = [
    ("HalfCheetah", {"hidden": "64,64"}, CHEETAH),
    ("HalfCheetah", {"hidden": "256,256"}, CHEETAH),
    ("HalfCheetah", {"hidden": "512,256,128"}, CHEETAH),
    ("gymnax CartPole", {"preset": "minatar"}, POLE),
    ("MinAtar Breakout", {"preset": "minatar"}, BREAKOUT),
]


def layers(config: Config, spaces: Spaces) -> list[list[int]]:
    """Widths from the observation to the output, of the policy's trunk and of the value's, or of
    the one that both share."""
    inputs = math.prod(spaces.observation_shape)
    outputs = sum(spaces.action_sizes) if spaces.action_kind == "discrete" else spaces.action_width
    value_hidden = config.value_hidden or config.hidden
    if config.trunk == "shared":
        return [[inputs, *config.hidden, outputs + 1]]
    return [[inputs, *config.hidden, outputs], [inputs, *value_hidden, 1]]


def operations(trunks: Sequence[Sequence[int]]) -> int:
    """Operations of the products for one sample: each layer forward, for its weights' gradient and,
    but for the first, for its input's."""
    total = 0
    for widths in trunks:
        sizes = [a * b for a, b in pairwise(widths)]
        total += 2 * (3 * sum(sizes) - sizes[0])
    return total


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

    return timed(update, weights, data)


def largest_products() -> list[Callable[[], float]]:
    """Functions that multiply two large matrices, by XLA and by NumPy; CPU seconds of each."""
    matrix = np.random.default_rng(0).normal(size=(SIDE, SIDE)).astype(np.float32)
    product = jax.jit(jnp.matmul)
    return [timed(product, matrix, matrix), timed(np.matmul, matrix, matrix)]


def sizes_of_the_cnn(pictures: Spaces) -> list[tuple[int, int, int]]:
    """Of each of the Nature CNN's layers, the matrix that a picture is multiplied with, and how
    many rows a picture has there: `(rows, inputs, outputs)`."""
    side, channels, sizes = pictures.observation_shape[0], pictures.observation_shape[-1], []
    for features, width, stride in LAYERS:
        side = (side - width) // stride + 1
        sizes.append((side**2, width**2 * channels, features))
        channels = features
    return [*sizes, (1, side**2 * channels, 512), (1, 512, sum(pictures.action_sizes) + 1)]


def convolutions_of(pictures: Spaces) -> int:
    """Operations of the Nature CNN for one picture, with both heads, counted as in `operations`."""
    each = [math.prod(size) for size in sizes_of_the_cnn(pictures)]
    return 2 * (3 * sum(each) - each[0])


def products_of_the_cnn(config: Config, pictures: Spaces) -> Callable[[], float]:
    """A function that makes the products of one update of the Nature CNN and returns their CPU
    seconds: up to the last convolution `PICTURES` at a time; the update takes a few, too."""
    batch = config.envs * config.rollout_steps
    size, rng = batch // config.minibatches, np.random.default_rng(0)
    sizes = sizes_of_the_cnn(pictures)

    def drawn(rows: int, columns: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=(rows, columns)), jnp.float32)

    def inputs_of(layers: Sequence[tuple[int, int, int]], number: int) -> list[jax.Array]:
        return [drawn(number * rows, inputs) for rows, inputs, _ in layers]

    convolved, dense = sizes[: len(LAYERS)], sizes[len(LAYERS) :]
    weights = [drawn(inputs, outputs) / inputs for _, inputs, outputs in sizes]
    of_a_piece, of_a_minibatch = inputs_of(convolved, PICTURES), inputs_of(dense, size)

    def multiplied(weights: list[jax.Array], inputs: list[jax.Array], first: int) -> list[Any]:
        """Each layer forward, for its weights' gradient and, but for the first, its input's."""
        after = []
        for i, (matrix, x) in enumerate(zip(weights, inputs, strict=True), first):
            output = x @ matrix
            gradient = x.T @ output
            if i:
                gradient += 1e-9 * jnp.sum((output @ matrix.T) ** 2)
            after.append(matrix - 1e-9 * gradient)
        return after

    def minibatch(_: Any, weights: list[jax.Array]) -> list[jax.Array]:
        kernels, matrices = weights[: len(LAYERS)], weights[len(LAYERS) :]
        piece = lambda _, now: multiplied(now, of_a_piece, 0)  # noqa: E731
        kernels = jax.lax.fori_loop(0, size // PICTURES, piece, kernels)
        return kernels + multiplied(matrices, of_a_minibatch, len(LAYERS))

    steps = config.epochs * config.minibatches
    return timed(jax.jit(lambda weights: jax.lax.fori_loop(0, steps, minibatch, weights)), weights)


def optimiser_alone(config: Config, spaces: Spaces) -> Callable[[], float]:
    """A function that takes the steps of one update without their gradients, and returns its CPU
    seconds: the gradient's norm, its clipping, Adam."""
    policy = make_policy(config, spaces)
    values: dict[str, Any] = {n: np.float32(getattr(config, n)) for n in Hypers._fields}
    transform = optimizer(config, policy, Hypers(**values))
    params = policy.init(jax.random.key(0))
    start = params, (optax.EmptyState(), scaling(config, policy).init(params))

    def step(_: Any, now: tuple[Any, Any]) -> tuple[Any, Any]:
        params, state = now
        step, state = transform.update(1e-3 * params, state, params)
        return params - values["learning_rate"] * step, state

    steps = config.epochs * config.minibatches
    return timed(jax.jit(lambda start: jax.lax.fori_loop(0, steps, step, start)), start)


def timed(function: Callable[..., Any], *arguments: Any) -> Callable[[], float]:
    """A function that calls another one, compiled already, and returns its CPU seconds."""

    def call() -> float:
        clock = time.process_time()
        jax.block_until_ready(function(*arguments))
        return time.process_time() - clock

    call()
    return call


def measure(
    name: str,
    config: Config,
    spaces: Spaces,
    of_a_sample: int,
    products: Callable[[], float],
    rounds: int,
) -> dict[str, Any]:
    """The rates of an update, of its products and of its optimiser beside the peak, in turn.

    Args:
      of_a_sample: operations.
    """
    calls = {
        "update": [one_update(config, spaces, False, time.process_time)],
        "products": [products],
        "optimiser": [optimiser_alone(config, spaces)],
        "large": largest_products(),
    }
    least = dict.fromkeys(calls, math.inf)
    for _ in range(rounds):
        for what, alike in calls.items():
            least[what] = min(least[what], *(least_of_a_block(call) for call in alike))
    peak = 2 * SIDE**3 / least["large"]
    samples = config.envs * config.rollout_steps
    done = of_a_sample * samples * config.epochs
    return {
        "of": name,
        "hidden": list(config.hidden) if config.network == "mlp" else config.network,
        "gradient_steps": config.epochs * config.minibatches,
        "samples_of_a_minibatch": samples // config.minibatches,
        "operations_of_a_sample": of_a_sample,
        "peak_gflops": peak / 1e9,
        "update_seconds": least["update"],
        "update_of_peak": done / least["update"] / peak,
        "products_seconds": least["products"],
        "products_of_peak": done / least["products"] / peak,
        "optimiser_seconds": least["optimiser"],
    }


def measure_all(rounds: int) -> list[dict[str, Any]]:
    found = []
    for name, settings, spaces in UPDATES:
        config = config_of(settings, spaces)
        products = products_alone(config, spaces)
        count = operations(layers(config, spaces))
        found.append(measure(name, config, spaces, count, products, rounds))
        print(json.dumps(found[-1]), flush=True)
    config = config_of({"preset": "atari"}, PONG)
    products, count = products_of_the_cnn(config, PONG), convolutions_of(PONG)
    found.append(measure("Pong", config, PONG, count, products, rounds))
    print(json.dumps(found[-1]), flush=True)
    return found


def operations_of_an_env_step(name: str) -> int:
    """Operations that the update makes for one env step, in the setting of a bench."""
    stored = json.loads((RESULTS / f"{name}.json").read_text())
    settings = stored["peer"]["settings"]
    if stored["env"].startswith("ALE/"):
        return round(convolutions_of(PONG) * settings["epochs"] * share_of(MEASURED[name]))
    hidden = ",".join(map(str, settings["hidden"]))
    run = {"env": stored["env"], "env_kwargs": settings.get("env_kwargs", "{}"), "hidden": hidden}
    job = prepare({**run, "trunk": settings.get("trunk", "separate")}).job()
    return operations(layers(job.config, job.spaces)) * settings["epochs"]


def share_of(flags: Sequence[str]) -> float:
    """The share of the samples that a row of `make.py` learns from, by its flags."""
    if "--sampler-kwargs" not in flags:
        return 1.0
    return float(json.loads(flags[flags.index("--sampler-kwargs") + 1])["share"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--bounds", action="store_true", help="only count operations")
    parser.add_argument("--out", type=Path, default=PATH)
    options = parser.parse_args()
    sys.path.append(str(RESULTS.parent))  # `own_envs`
    result: dict[str, Any] = json.loads(options.out.read_text()) if options.bounds else {}
    if not options.bounds:
        result = {
            "machine": run_directory.machine(),
            "versions": run_directory.versions(),
            "rounds": options.rounds,
            "networks": measure_all(options.rounds),
        }
    stored = [name for name in BOUNDED if (RESULTS / f"{name}.json").exists()]
    result["operations_of_an_env_step"] = {name: operations_of_an_env_step(name) for name in stored}
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
