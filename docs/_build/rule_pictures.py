"""Draws the pictures of the pages about rules of selection, one per family.

    python docs/_build/rule_pictures.py         all of them, into docs/images/rules/

The rules are the package's own, asked about one rollout of 2048 random steps whose advantages have
heavy tails and keep their sign for a while, as those of episodes do. Same bytes in every run.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sauna.algorithm.learner.ppo import surrogate
from sauna.algorithm.selection.avec import avec
from sauna.algorithm.selection.control import matched
from sauna.algorithm.selection.delight import delight
from sauna.algorithm.selection.objectives import spo, unclipped
from sauna.algorithm.selection.positive import cut_at_zero
from sauna.algorithm.selection.registry import SAMPLERS
from sauna.algorithm.types import Choice, LossTerms, SamplerSetup, Samples
from sauna.experiments.report.style import applied, as_svg

FOLDER = Path(__file__).resolve().parents[1] / "images" / "rules"
ROWS = 2048
SETUP = SamplerSetup(ROWS, 1, 100, "continuous", (2,))
BLUE, ORANGE, GREY, GREEN = "#0072B2", "#D55E00", "#B9BCC0", "#009E73"


def rollout() -> Samples:
    """One rollout of 2048 steps of a Gaussian policy with two actions."""
    rng = np.random.default_rng(0)
    noise, drift = rng.standard_t(3, ROWS), np.zeros(ROWS)
    for t in range(1, ROWS):
        drift[t] = 0.97 * drift[t - 1] + 0.25 * noise[t]
    advantage = drift + 0.3 * noise
    z = rng.normal(size=(ROWS, 2))
    log_std = np.full((ROWS, 2), -0.5)
    log_prob = (-0.5 * z**2 - log_std - 0.5 * np.log(2 * np.pi)).sum(-1)
    value = np.cumsum(0.1 * rng.normal(size=ROWS))
    error = 0.5 * noise
    columns: dict[str, Any] = {
        "observation": np.zeros((ROWS, 1)),
        "action": np.exp(log_std) * z,
        "log_prob": log_prob,
        "advantage": advantage,
        "standardized": (advantage - advantage.mean()) / advantage.std(),
        "return_": value + error,
        "value": value,
        "error": error,
        "vex": np.zeros(ROWS),
        "log_ratio": np.zeros(ROWS),
        "policy": np.concatenate([np.zeros((ROWS, 2)), log_std], -1),
        "hidden": np.tanh(rng.normal(size=(ROWS, 8))),
        "entropy": (log_std + 0.5 * np.log(2 * np.pi * np.e)).sum(-1),
    }
    found = {name: jnp.asarray(x, jnp.float32) for name, x in columns.items()}
    return Samples(present=jnp.ones(ROWS, bool), **found)


def asked(name: str, samples: Samples, **settings: Any) -> Choice:
    """What a sampler takes, as numpy arrays."""
    sampler = SAMPLERS[name](SETUP, **settings)
    choice = sampler.choose(sampler.init(), samples, jax.random.key(0))[1]
    return jax.tree.map(np.asarray, choice)


def by_advantage(axes: Any) -> None:
    """How many steps there are, and how many of them each rule takes, by their advantage."""
    samples = rollout()
    advantage = np.asarray(samples.advantage)
    edges = np.linspace(-6, 6, 49)
    rules = ("gigaflow", "top-advantage", "pods", "positive")
    settings: dict[str, dict[str, Any]] = {"gigaflow": {"threshold": 0.05}}
    for ax, name in zip(axes, rules, strict=True):
        keep = asked(name, samples, **settings.get(name, {})).keep
        ax.hist(advantage, edges, color=GREY, label="all")
        ax.hist(advantage[keep], edges, color=BLUE, label="taken")
        ax.set_title(f"{name}: {keep.mean():.0%}")
        ax.set_xlabel("advantage")
    axes[0].set_ylabel("steps")
    axes[0].legend()


def by_probability(axes: Any) -> None:
    """How often a step is drawn in an epoch, and how much it then counts."""
    samples = rollout()
    size = np.abs(np.asarray(samples.advantage))
    for name, colour in (("gradient-norm", ORANGE), ("prioritized", BLUE)):
        choice = asked(name, samples)
        axes[0].plot(size, ROWS * choice.probability, ".", ms=2.5, color=colour, label=name)
        axes[1].plot(size, choice.weight, ".", ms=2.5, color=colour, label=name)
    axes[0].set(title="draws of an epoch, expected", xlabel="|advantage|", xlim=(0, 6))
    axes[1].set(title="weight of the policy term", xlabel="|advantage|", xlim=(0, 6), ylim=(0, 4))
    axes[0].legend()


def ratios(axes: Any) -> None:
    """The policy term against the ratio, for a good and a bad action."""
    ratio = np.linspace(0.4, 1.8, 281)
    forms: list[tuple[str, Callable[..., Any], str]] = [
        ("PPO's clip", surrogate, GREY),
        ("spo", spo, ORANGE),
        ("unclipped (espo)", unclipped, GREEN),
    ]
    for ax, sign in zip(axes, (1.0, -1.0), strict=True):
        for label, form, colour in forms:
            term = form(jnp.log(jnp.asarray(ratio)), jnp.full(len(ratio), sign), 0.2)
            ax.plot(ratio, -np.asarray(term), color=colour, label=label, lw=1.8)
        ax.axvspan(1.25, 1.8, color=BLUE, alpha=0.08)
        ax.axvspan(0.4, 0.75, color=BLUE, alpha=0.08)
        ax.set(title=f"advantage {sign:+.0f}", xlabel="ratio of today's policy to then")
    axes[0].set_ylabel("what is maximised")
    axes[0].legend()


def weights(axes: Any) -> None:
    """Delight's weight, and what `positive` makes of advantages."""
    surprisal = np.linspace(-4, 6, 201)
    colours = ("#882255", ORANGE, GREEN, BLUE)
    for advantage, colour in zip((-2.0, -0.5, 0.5, 2.0), colours, strict=True):
        number = jnp.asarray(surprisal, jnp.float32)
        none = jnp.zeros_like(number)
        terms = LossTerms(-number, none, none + advantage, none, none + 1, True)
        scale = delight().weight(terms)[1]
        axes[0].plot(surprisal, scale, color=colour, lw=1.8, label=f"advantage {advantage:+.1f}")
    axes[0].set(title="delight", xlabel="surprisal - entropy", ylabel="weight")
    axes[0].legend()
    advantage = jnp.asarray(rollout().advantage)
    one = jnp.ones(ROWS)
    order = np.argsort(np.asarray(advantage))
    plain = np.asarray((advantage - advantage.mean()) / advantage.std())
    axes[1].plot(np.asarray(advantage)[order], plain[order], color=GREY, lw=1.8, label="PPO")
    cut = np.asarray(cut_at_zero(advantage, one))
    axes[1].plot(np.asarray(advantage)[order], cut[order], color=BLUE, lw=1.8, label="positive")
    axes[1].set(title="positive", xlabel="advantage", ylabel="as the loss uses it", xlim=(-6, 6))
    axes[1].legend()


def critics(axes: Any) -> None:
    """The value loss when a constant is added to V, and when V is right up to a factor."""
    rng = np.random.default_rng(1)
    returns, value = rng.normal(size=512), None
    added, factor = np.linspace(-2, 2, 81), np.linspace(0, 2, 81)
    value = returns + 0.5 * rng.normal(size=512)

    def curves(make: Callable[[float], np.ndarray], at: np.ndarray) -> tuple[list[Any], list[Any]]:
        errors = [jnp.asarray(returns - make(float(x))) for x in at]
        squared = [0.5 * jnp.mean(e**2) for e in errors]
        return squared, [avec(e, jnp.ones(512)) for e in errors]

    for ax, at, make, label in (
        (axes[0], added, lambda c: value + c, "constant added to V"),
        (axes[1], factor, lambda f: f * value, "factor of V"),
    ):
        squared, variance = curves(make, at)
        ax.plot(at, squared, color=GREY, lw=1.8, label="squared errors")
        ax.plot(at, variance, color=BLUE, lw=1.8, label="avec: their variance")
        ax.set(xlabel=label)
    axes[0].set_ylabel("value loss")
    axes[0].legend()


def vex(axes: Any) -> None:
    """Each step's share of the explained variance against its error, and who is kept."""
    samples = rollout()
    samples = samples._replace(advantage=samples.error)  # of one step, as with lambda 0
    error = np.asarray(samples.error)
    share = 1 - error**2 / np.asarray(samples.return_).var()
    settings: dict[str, dict[str, Any]] = {
        "threshold 0.8": {"threshold": 0.8},
        "keep high": {"keep": "high"},
        "keep low": {"keep": "low"},
    }
    for ax, (title, chosen) in zip(axes, settings.items(), strict=True):
        keep = asked("vex-oracle", samples, **chosen).keep
        ax.plot(error[~keep], share[~keep], ".", ms=2.5, color=GREY, label="left out")
        ax.plot(error[keep], share[keep], ".", ms=2.5, color=BLUE, label="taken")
        ax.set(title=f"{title}: {keep.mean():.0%}", xlabel="R - V", xlim=(-3, 3), ylim=(-2, 1.1))
    axes[0].set_ylabel("share of explained variance")
    axes[0].legend()


def controls(axes: Any) -> None:
    """40 steps in a row: which of them a rule takes, and which its controls take."""
    samples = rollout()
    advantage = samples.advantage[600:640]
    size = jnp.abs(advantage)
    keep = size >= jnp.sort(size)[-16]
    noise = jax.random.uniform(jax.random.key(3), (40,))
    every = jnp.ones(40, bool)
    rows = {"top-advantage": keep}
    for kind in ("random", "stride", "low-advantage", "reversed"):
        rows[kind] = matched(kind, keep, size, advantage, every, noise)
    ax = axes[0]
    for y, (name, mask) in enumerate(reversed(rows.items())):
        taken = np.asarray(mask)
        ax.bar(range(40), 0.8, 0.8, y - 0.4, color=[BLUE if m else GREY for m in taken])
        ax.text(-1, y, f"{name}: {taken.sum()}", ha="right", va="center", fontsize=9)
    ax.bar(range(40), np.asarray(size) / float(size.max()) * 1.6, 0.8, 5.0, color="#4B5563")
    ax.text(-1, 5.6, "|advantage|", ha="right", va="center", fontsize=9)
    ax.set(yticks=[], xlim=(-1, 40), xlabel="40 steps of one environment")
    ax.grid(False)
    ax.spines["left"].set_visible(False)


PICTURES: dict[str, tuple[Callable[[Any], None], int]] = {
    "by_advantage": (by_advantage, 4),
    "by_probability": (by_probability, 2),
    "ratios": (ratios, 2),
    "loss_weights": (weights, 2),
    "critics": (critics, 2),
    "vex": (vex, 3),
    "controls": (controls, 1),
}


def draw(name: str) -> bytes:
    """Draws one picture as SVG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    make, number = PICTURES[name]
    with applied():
        figure, axes = pyplot.subplots(
            1, number, figsize=(9, 2.8), squeeze=False, layout="constrained"
        )
        make(axes[0])
        for collection in (line for ax in axes[0] for line in ax.get_lines()):
            collection.set_rasterized(len(collection.get_xdata()) > 1000)
        drawn = as_svg(figure)
        pyplot.close(figure)
    return drawn


def main() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in PICTURES:
        (FOLDER / f"{name}.svg").write_bytes(draw(name))


if __name__ == "__main__":
    main()
