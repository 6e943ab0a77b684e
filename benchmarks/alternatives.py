"""What other ways of making an update's parts on a CPU would take: `results/alternatives.json`.

    python benchmarks/alternatives.py [--rounds 5]      (two minutes, on a quiet machine)

The products of a network's layer are made by XLA and by BLAS, which Numba calls (SciPy's OpenBLAS):
forward, for the weights' gradient and for the input's. A step of Adam with its clipping is made by
XLA and by one loop of Numba over the parameters. Both take turns. The least CPU time counts.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

from sauna.system.jax_setup import configure_jax  # noqa: E402

configure_jax()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numba  # noqa: E402
import numpy as np  # noqa: E402
import optax  # noqa: E402

from sauna.system import run_directory  # noqa: E402

PATH = Path(__file__).parent / "results" / "alternatives.json"
# Samples of a minibatch, inputs and outputs of a layer.
LAYERS = ((64, 64, 64), (1024, 64, 64), (1024, 400, 64), (64, 256, 256), (64, 512, 256))
PARAMETERS = (11_000, 143_000, 345_000)  # of 64-64, 256-256 and 512-256-128 on HalfCheetah
REPEATS = 300
RATE, NORM, EPSILON = np.float32(3e-4), np.float32(0.5), np.float32(1e-5)


@numba.njit(error_model="numpy")
def products_by_blas(x: Any, weights: Any, y: Any, of_weights: Any, of_x: Any, times: int) -> None:
    """Multiplies forward, for the weights' gradient, and for the input's."""
    for _ in range(times):
        np.dot(x, weights, y)
        np.dot(x.T, y, of_weights)
        np.dot(y, weights.T, of_x)


def products_by_xla(x: Any, weights: Any) -> Callable[[], Any]:
    """The same products, of which each repetition needs those of the one before."""

    def step(_: Any, now: Any) -> Any:
        x, weights = now
        y = x @ weights
        return x + 1e-9 * (y @ weights.T), weights + 1e-9 * (x.T @ y)

    run = jax.jit(lambda start: jax.lax.fori_loop(0, REPEATS, step, start))
    start = jnp.asarray(x), jnp.asarray(weights)
    return lambda: jax.block_until_ready(run(start))


@numba.njit(error_model="numpy")
def adam_in_one_loop(p: Any, g: Any, m: Any, v: Any, times: int) -> None:
    """Takes steps of Adam down a clipped gradient, `p / 1000`, 0 beyond whole blocks of 16."""
    number = np.float32
    for k in range(times):
        parts = np.zeros(16, np.float32)  # sums of their own, so that the loop can be vectorised
        for i in range(0, len(p) - 15, 16):
            for j in range(16):
                g[i + j] = number(1e-3) * p[i + j]
                parts[j] += g[i + j] * g[i + j]
        norm = np.sqrt(parts.sum())
        scale = number(1) if norm < NORM else NORM / norm
        rate = RATE / (number(1) - number(0.9) ** number(k + 1))
        squares = number(1) / (number(1) - number(0.999) ** number(k + 1))
        for i in range(len(p)):
            clipped = g[i] * scale
            m[i] = number(0.9) * m[i] + number(0.1) * clipped
            v[i] = number(0.999) * v[i] + number(0.001) * clipped * clipped
            p[i] -= rate * m[i] / (np.sqrt(v[i] * squares) + EPSILON)


def adam_by_xla(p: Any) -> Callable[[], Any]:
    """The same steps by optax, as in an update."""
    norm, epsilon = float(NORM), float(EPSILON)
    transform = optax.chain(optax.clip_by_global_norm(norm), optax.scale_by_adam(eps=epsilon))

    def step(_: Any, now: Any) -> Any:
        p, state = now
        direction, state = transform.update(1e-3 * p, state, p)
        return p - RATE * direction, state

    run = jax.jit(lambda start: jax.lax.fori_loop(0, REPEATS, step, start))
    start = jnp.asarray(p), transform.init(jnp.asarray(p))
    return lambda: jax.block_until_ready(run(start))


def least_of_both(xla: Callable[[], Any], own: Callable[[], Any], rounds: int) -> dict[str, float]:
    """The least CPU microseconds of a repetition, by XLA and by the other way, in turn."""
    least = {"xla_us": np.inf, "own_us": np.inf}
    for turn in range(rounds + 1):  # the first compiles
        for name, call in (("xla_us", xla), ("own_us", own)):
            clock = time.process_time()
            call()
            spent = (time.process_time() - clock) / REPEATS * 1e6
            least[name] = min(least[name], spent) if turn else np.inf
    return {name: round(float(value), 2) for name, value in least.items()}


def measure(rounds: int) -> dict[str, Any]:
    rng, products, adam = np.random.default_rng(0), [], []
    for samples, inputs, outputs in LAYERS:
        x = rng.normal(size=(samples, inputs)).astype(np.float32)
        weights = (rng.normal(size=(inputs, outputs)) / inputs).astype(np.float32)
        places = np.empty((samples, outputs), np.float32), np.empty_like(weights), np.empty_like(x)
        both = least_of_both(
            products_by_xla(x, weights),
            partial(products_by_blas, x, weights, *places, REPEATS),
            rounds,
        )
        products.append({"samples": samples, "inputs": inputs, "outputs": outputs, **both})
        print(products[-1], flush=True)
    for size in PARAMETERS:
        p = rng.normal(size=size).astype(np.float32)
        state = np.zeros_like(p), np.zeros_like(p), np.zeros_like(p)
        both = least_of_both(
            adam_by_xla(p),
            partial(adam_in_one_loop, p.copy(), *state, REPEATS),
            rounds,
        )
        adam.append({"parameters": size, **both})
        print(adam[-1], flush=True)
    return {"products": products, "adam": adam}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=PATH)
    options = parser.parse_args()
    result = {
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
        "rounds": options.rounds,
        **measure(options.rounds),
    }
    options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
