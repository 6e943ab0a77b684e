"""Small mistakes planted in `algorithm/`: which share of them do the fast tests catch?

    python tests/faults/mutants.py                every mutant; results/mutants.json
    python tests/faults/mutants.py --only NAME    those whose name contains NAME; nothing is stored

Each mistake is made in a copy of the sources, and pytest runs on it: first the tests of that part,
then all that are about numbers, then whole small trainings. The processes are forked from one that
has imported JAX. Each result is stored as it comes, and stands as long as the mutant's file is
the same; survivors are tried again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent.parent
RESULTS = ROOT / "results" / "mutants.json"
QUICK = (
    "advantages",
    "samples",
    "ppo",
    "selected",
    "algorithm/selection/test_rules",
    "loss_rules",
    "control",
    "draws",
    "vex_filter",
    "vex_targets",
    "networks",
    "host",
    "reference",
    "properties",
)
SLOW = ("probes", "algorithm/test_population")  # for what the others let pass
CHEAP_COMPILING = {  # as `make test` does
    "XLA_FLAGS": "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
}


class Mutant(NamedTuple):
    """`old` becomes `new` in a file of `src/sauna`; `tests` are those that should know it best."""

    file: str
    name: str
    old: str
    new: str
    tests: str


def _of(file: str, tests: str, *changes: tuple[str, str, str]) -> list[Mutant]:
    return [Mutant(file, name, old, new, tests) for name, old, new in changes]


MUTANTS = [
    *_of(
        "algorithm/learner/advantages.py",
        "advantages",
        ("value is added", "* next_value - value\n", "* next_value + value\n"),
        ("no bootstrap mask", "gamma * bootstrap * next_value", "gamma * next_value"),
        ("no mask between episodes", "gae_lambda * not_last_t * later", "gae_lambda * later"),
        ("no lambda", "gamma * gae_lambda * not_last_t", "gamma * not_last_t"),
        ("no gamma in the sum", "gamma * gae_lambda * not_last_t", "gae_lambda * not_last_t"),
        ("forwards in time", "reverse=True", "reverse=False"),
    ),
    *_of(
        "algorithm/learner/samples.py",
        "advantages samples reference vex_targets",
        ("dropped steps are kept", "jnp.argsort(~keep", "jnp.argsort(keep"),
        (
            "stream goes on at its end",
            "zeros_like(rollout.valid[:1])])\n    bootstrap",
            "ones_like(rollout.valid[:1])])\n    bootstrap",
        ),
        (
            "truncation never bootstraps",
            "~rollout.terminated if bootstrap_truncated else ~ended",
            "~ended",
        ),
        (
            "truncation always bootstraps",
            "~rollout.terminated if bootstrap_truncated else ~ended",
            "~rollout.terminated",
        ),
        ("episode ends leak", "~(ended | last)", "~last"),
        ("truncated ends leak", "~(ended | last)", "~(rollout.terminated | last)"),
        ("last kept step off by one", ">= number - 1", ">= number"),
        ("ends of the wrong step", "take(ended_before, following)", "take(ended, following)"),
        (
            "other value at the stream's end",
            "take(rollout.next_value, final_row)",
            "take(rollout.value, final_row)",
        ),
        ("episodes start a step early", "jnp.cumsum(ended, 0) - ended", "jnp.cumsum(ended, 0)"),
        (
            "return without its value",
            "rows, advantage, advantage + take(rollout.value, rows), config, target",
            "rows, advantage, advantage, config, target",
        ),
        (
            "empty slots count",
            "weight = take(rollout.keep, rows).astype(jnp.float32)",
            "weight = jnp.ones(value.shape, jnp.float32)",
        ),
        (
            "Vex of swapped arguments",
            "target.target(return_, value,",
            "target.target(value, return_,",
        ),
        (
            "log-probabilities of other steps",
            "take(rollout.log_prob, rows)",
            "take(rollout.log_prob, rows[::-1])",
        ),
    ),
    *_of(
        "algorithm/learner/losses.py",
        "ppo samples",
        (
            "mean over empty slots, too",
            "jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)",
            "jnp.sum(x * weight) / weight.shape[0]",
        ),
        (
            "advantages not centred",
            "centred = advantage - weighted_mean(advantage, weight)",
            "centred = advantage",
        ),
        (
            "advantages not scaled",
            "centred / (jnp.sqrt(weighted_mean(centred**2, weight)) + 1e-8)",
            "centred",
        ),
        (
            "entropy is punished",
            "policy_loss - hypers.entropy_coef",
            "policy_loss + hypers.entropy_coef",
        ),
        ("Vex weighted as value", "hypers.vex_coef * vex_loss", "hypers.value_coef * vex_loss"),
        ("no value loss", "total + hypers.value_coef * value_loss +", "total +"),
    ),
    *_of(
        "algorithm/learner/ppo.py",
        "ppo samples",
        (
            "optimistic surrogate",
            "jnp.maximum(-advantage * ratio",
            "jnp.minimum(-advantage * ratio",
        ),
        (
            "flipped advantage",
            "jnp.maximum(-advantage * ratio, -advantage * clipped)",
            "jnp.maximum(advantage * ratio, advantage * clipped)",
        ),
        ("lower clip twice as wide", "1.0 - clip_range,", "1.0 - 2.0 * clip_range,"),
        ("optimistic value clip", "jnp.maximum(error,", "jnp.minimum(error,"),
        ("value error not halved", "return 0.5 * error", "return error"),
        ("clip around zero", "old + jnp.clip(value - old", "jnp.clip(value - old"),
        ("KL with the wrong sign", "(ratio - 1.0) - log_ratio", "(ratio - 1.0) + log_ratio"),
        (
            "clip fraction inverted",
            "jnp.abs(ratio - 1.0) > hypers",
            "jnp.abs(ratio - 1.0) < hypers",
        ),
        (
            "masked ratios count",
            "jnp.where(rows.weight > 0, log_prob - rows.log_prob, 0.0)",
            "log_prob - rows.log_prob",
        ),
    ),
    *_of(
        "algorithm/learner/a2c.py",
        "a2c",
        (
            "policy gradient downhill",
            "-log_prob * minibatch.advantage",
            "log_prob * minibatch.advantage",
        ),
        (
            "value error halved",
            "errors = (critic.value - values.return_) ** 2",
            "errors = 0.5 * (critic.value - values.return_) ** 2",
        ),
        (
            "value and Vex loss swapped",
            "weigh(policy_loss, value_loss, vex_loss,",
            "weigh(policy_loss, vex_loss, value_loss,",
        ),
        ("masked samples count", "jnp.where(rows.weight > 0, log_prob, 0.0)", "log_prob"),
        ("no Vex loss", "vex_loss, mean_entropy, hypers)", "0.0 * vex_loss, mean_entropy, hypers)"),
    ),
    *_of(
        "algorithm/learner/optimizers.py",
        "a2c",
        ("RMSProp starts at 0", '"initial_scale": 1.0', '"initial_scale": 0.0'),
        ("epsilon beside the root", '"eps_in_sqrt": True', '"eps_in_sqrt": False'),
    ),
    *_of(
        "algorithm/policy/normalize.py",
        "host",
        ("spread of the means forgotten", "moments.variance + delta * move", "moments.variance"),
        ("mean moves the wrong way", "Moments(moments.mean + move", "Moments(moments.mean - move"),
        (
            "observations not clipped",
            "(variance + EPSILON) ** 0.5).clip(-clip, clip)",
            "(variance + EPSILON) ** 0.5)",
        ),
        ("rewards not clipped", "[:, None] ** 0.5).clip(-clip, clip)", "[:, None] ** 0.5)"),
        ("variance about the old mean", "square / count - shift**2", "square / count"),
        ("starts with a whole sample", "1e-4)", "1.0)"),
        (
            "inactive rows count",
            "    number = weight.sum(-2)",
            "    number = weight.sum(-2) * 0 + weight.shape[-2]",
        ),
        (
            "batch variance weighted by count",
            "batch_variance * fraction, total",
            "batch_variance * (1 - fraction), total",
        ),
    ),
    *_of(
        "algorithm/learner/optimizers.py",
        "ppo samples optimizers faults/test_07_poisoned_batch",
        (
            "element-wise clipping",
            "optax.clip_by_global_norm(hypers.max_grad_norm)",
            "optax.clip(hypers.max_grad_norm)",
        ),
        ("no clipping", "optax.clip_by_global_norm(hypers.max_grad_norm)", "optax.identity()"),
        ("other epsilon of Adam", '"eps": config.adam_epsilon', '"eps": 1e-2'),
        ("the KL raises the rate", "kl > 2.0 * config.desired_kl", "kl < 2.0 * config.desired_kl"),
        ("the rate has no floor", "rate / FACTOR, config.learning_rate_min", "rate / FACTOR, 0.0"),
    ),
    *_of(
        "algorithm/learner/update.py",
        "ppo samples faults/test_07_poisoned_batch",
        (
            "uphill",
            "state.params - rate * step",
            "state.params + rate * step",
        ),
        (
            "Adam forgets",
            "return TrainState(params, scale, state.sampler",
            "return TrainState(params, state.optimizer, state.sampler",
        ),
        ("minibatches repeat", "default_rng([seed, iteration])", "default_rng([seed])"),
        ("one order for all members", "default_rng([seed, iteration])", "default_rng([iteration])"),
        (
            "minibatches in time order",
            "generator.permuted(np.tile(samples, (config.epochs, 1)), axis=1)",
            "np.tile(samples, (config.epochs, 1))",
        ),
    ),
    *_of(
        "algorithm/learner/learn.py",
        "faults/test_07_poisoned_batch",
        ("only the loss is checked", " & jnp.all(jnp.isfinite(state.params))", ""),
    ),
    *_of(
        "algorithm/learner/metrics.py",
        "ppo samples",
        ("explained variance of a sum", "variance(return_ - value)", "variance(return_ + value)"),
        ("median off by one", "ordered[(number - 1) // 2]", "ordered[number // 2]"),
    ),
    *_of(
        "algorithm/policy/policy.py",
        "networks",
        (
            "value and Vex swapped",
            "[log_prob, output.value, output.vex]",
            "[log_prob, output.vex, output.value]",
        ),
        (
            "acts without noise",
            "policy.sample(params, output, noise)\n    return action",
            "policy.sample(params, output, 0.0 * noise)\n    return action",
        ),
    ),
    *_of(
        "algorithm/policy/distributions.py",
        "networks",
        (
            "density not normalised",
            "jnp.sum(log_std, -1) - constant",
            "jnp.sum(log_std, -1) + constant",
        ),
        (
            "noise scaled by the logarithm",
            "mean + jnp.exp(log_std) * noise",
            "mean + log_std * noise",
        ),
        (
            "entropy without its constant",
            "(1.0 + math.log(2.0 * math.pi))",
            "math.log(2.0 * math.pi)",
        ),
        ("bits inverted", "(parameters > 0).astype", "(parameters < 0).astype"),
        (
            "categorical entropy flipped",
            "sum(-jnp.sum(jnp.exp(log_p)",
            "sum(jnp.sum(jnp.exp(log_p)",
        ),
    ),
    *_of(
        "algorithm/policy/convolutions.py",
        "convolutions networks",
        ("pixels not scaled", "x = x / high", "x = x / 1.0"),
        ("floats without a gradient", "rectified, not of_bytes)", "rectified, of_bytes)"),
        ("the ReLU forgotten", "[stride, rectified], np.int32))", "[stride, 0], np.int32))"),
    ),
    *_of(
        "algorithm/policy/compiled_convolution.py",
        "convolutions networks",
        ("kernel upside down", "i * stride + k]", "i * stride + width - 1 - k]"),
        ("overlapping patches not added", "pixels[c] += patch[c]", "pixels[c] = patch[c]"),
        ("dead units learn", "output[begin + i, j] > 0.0 or not rectified", "True"),
        ("gradient of the last turn only", "total[i, j] += part[i, j]", "total[i, j] = part[i, j]"),
        (
            "each turn writes to the first one's place",
            "output[first * pixels : last * pixels]",
            "output[: (last - first) * pixels]",
        ),
        ("a turn of no pictures", "max(min(PATCHES // numbers, count), 1)", "min(1, count)"),
        (
            "what is not a number becomes 0",
            "rectified and value < 0.0",
            "rectified and not value > 0.0",
        ),
        ("another interface is accepted", "here if np.int32(here) == MAJOR else OLDEST", "here"),
    ),
    *_of(
        "algorithm/policy/networks.py",
        "networks",
        (
            "policy head starts large",
            'self.num_outputs, 0.01, "policy_head"',
            'self.num_outputs, 1.0, "policy_head"',
        ),
        (
            "Vex on the policy's trunk",
            '"vex_head")(value_features)',
            '"vex_head")(policy_features)',
        ),
        (
            "activations swapped",
            "getattr(nn, self.activation)",
            'getattr(nn, {"tanh": "relu", "relu": "tanh"}[self.activation])',
        ),
    ),
    *_of(
        "algorithm/rollout/program.py",
        "samples ppo",
        (
            "noise repeats in a rollout",
            "jax.random.fold_in(jax.random.fold_in(root, iteration), block)",
            "jax.random.fold_in(root, iteration)",
        ),
        (
            "one key for every segment",
            "jax.random.fold_in(key, first + t)",
            "jax.random.fold_in(key, t)",
        ),
        ("one step too many", "carry[0] < length", "carry[0] <= length"),
    ),
    *_of(
        "algorithm/types.py",
        "samples selected",
        ("one key for all members", "jax.random.key(seed)", "jax.random.key(0)"),
        ("draws by the key of an epoch's order", "SELECTION = 2**31 - 1", "SELECTION = 1"),
    ),
    *_of(
        "algorithm/selection/history.py",
        "vex_filter samples reference coverage",
        ("median off by one", "jnp.maximum(history.number - 1, 0) // 2", "history.number // 2"),
        (
            "history does not grow",
            "History(ordered, history.number + 1)",
            "History(ordered, history.number)",
        ),
        ("rank off by one", "jnp.clip(rank - 1, 0,", "jnp.clip(rank, 0,"),
    ),
    *_of(
        "algorithm/selection/random_drop.py",
        "vex_filter samples",
        ("random drop inverted", ">= hypers.drop_rate", "< hypers.drop_rate"),
    ),
    *_of(
        "training/loop/schedules.py",
        "vex_filter schedules coverage",
        ("schedule the other way", "value * (1.0 - left)", "value * left"),
        ("half a cosine", "1.0 + cos(np.pi", "1.0 + cos(0.5 * np.pi"),
        ("the warm-up counts from the start", "(used + coming)", "used"),
        ("no schedule after the warm-up", "left / (1.0 - config.warmup)", "left"),
    ),
    *_of(
        "algorithm/selection/gigaflow.py",
        "algorithm/selection/test_rules",
        ("other running rate", "rate: float = 0.25", "rate: float = 0.75"),
        ("threshold of today's largest", ">= threshold * largest", ">= threshold * now"),
    ),
    *_of(
        "algorithm/selection/top_advantage.py",
        "algorithm/selection/test_rules",
        ("sign of the advantage counts", "jnp.abs(samples.advantage)", "samples.advantage"),
    ),
    *_of(
        "algorithm/selection/prioritized.py",
        "algorithm/selection/test_rules",
        ("corrected the other way", "** -b, 0.0)", "** b, 0.0)"),
        ("correction does not rise", "(1.0 - correction) * progress", "0.0 * progress"),
        ("divided by the largest weight", "jnp.sum(p * weight)", "jnp.max(weight)"),
    ),
    *_of(
        "algorithm/selection/gradient_norm.py",
        "algorithm/selection/test_rules",
        ("weights of all slots", "_inverse(number * p)", "_inverse(len(p) * p)"),
        ("biases forgotten", "jnp.sum(hidden**2, -1) + 1.0", "jnp.sum(hidden**2, -1)"),
    ),
    *_of(
        "algorithm/selection/pods.py",
        "algorithm/selection/test_rules",
        ("last segment cut off", "pieces = -(-steps // length)", "pieces = steps // length"),
    ),
    *_of(
        "algorithm/selection/scores.py",
        "algorithm/selection/test_rules control",
        (
            "one row too many",
            "found = jax.lax.top_k(jnp.where(eligible, score, -jnp.inf), count)",
            "found = jax.lax.top_k(jnp.where(eligible, score, -jnp.inf), count + 1)",
        ),
    ),
    *_of(
        "algorithm/selection/delight.py",
        "loss_rules",
        ("likely and good", "jnp.clip(-log_prob - centre", "jnp.clip(log_prob + centre"),
    ),
    *_of(
        "algorithm/selection/stops.py",
        "loss_rules",
        ("KL with the wrong sign", "- 1.0 - log_ratio", "- 1.0 + log_ratio"),
    ),
    *_of(
        "algorithm/selection/control.py",
        "control",
        ("low advantage is high", "largest(-jnp.abs(advantage)", "largest(jnp.abs(advantage)"),
        (
            "absent rows deal weights",
            "rows[(jnp.cumsum(present) - 2)",
            "rows[(jnp.cumsum(present) - 1)",
        ),
        ("first step at risk", "return chosen | (keep & first)", "return chosen"),
    ),
    *_of(
        "algorithm/selection/draws.py",
        "draws selected",
        ("drawn by the left edge", 'side="right"', 'side="left"'),
        ("last minibatch left out", "(number + size - 1) // size", "number // size"),
        ("steps without a row", "jnp.minimum(number, minibatches)", "minibatches"),
    ),
    *_of(
        "algorithm/learner/selected.py",
        "selected",
        (
            "the step that is forbidden is taken",
            "jnp.where(stop, old, new)",
            "jnp.where(stop, new, new)",
        ),
        (
            "the critic loses rows, too",
            "choice = Choice(keep=batch.weight > 0)",
            "choice = Choice(keep=choice.keep)",
        ),
        (
            "weights of rows drawn otherwise",
            "choice.value_weight if for_all else None",
            "choice.value_weight",
        ),
        ("one order for all epochs", "order[e]", "order[0]"),
    ),
    *_of(
        "algorithm/selection/vex_filter.py",
        "vex_filter samples reference",
        (
            "filter inverted",
            "~(ratio_to_median(vex, history) <",
            "~(ratio_to_median(vex, history) >",
        ),
        (
            "strict threshold",
            "~(ratio_to_median(vex, history) <",
            "~(ratio_to_median(vex, history) <=",
        ),
        ("first step compared with nothing", "(history.number == 0) | ", ""),
        ("sign of Vex counts", "jnp.abs(vex) /", "vex /"),
        (
            "sign of the median counts",
            "(jnp.abs(median(history)) + EPSILON)",
            "(median(history) + EPSILON)",
        ),
        ("joint decision by the largest", "jnp.mean(vex), state", "jnp.max(vex), state"),
    ),
    *_of(
        "algorithm/selection/vex_filter.py",
        "vex_filter coverage",
        (
            "target keep rate pushed away",
            "(state.kept - rate * number) / SETTLE",
            "(rate * number - state.kept) / SETTLE",
        ),
        ("share dropped for share kept", "level = (1.0 - rate) +", "level = rate +"),
    ),
    *_of(
        "experiments/measure/gradient.py",
        "noise",
        ("downhill", "return -jax.grad(loss)(params)", "return jax.grad(loss)(params)"),
        ("never standardised", "if standardized:", "if False:"),
    ),
    *_of(
        "algorithm/learner/vex_targets.py",
        "vex_targets samples",
        (
            "unexplained instead of explained",
            "jnp.where(varies, 1.0 - unexplained /",
            "jnp.where(varies, unexplained /",
        ),
        (
            "constant returns are explained",
            "jnp.where(varies, variance, 1.0), 0.0)",
            "jnp.where(varies, variance, 1.0), 1.0)",
        ),
        (
            "minibatch residual not centred",
            "_mean((residual - _mean(residual, weight)) ** 2, weight)",
            "_mean(residual**2, weight)",
        ),
        (
            "segments not centred",
            "over_segment((return_ - over_segment(return_)) ** 2)",
            "over_segment(return_**2)",
        ),
        ("other clip", "CLIP_BELOW = -5.0", "CLIP_BELOW = -10.0"),
        ("rounding counts as variance", "ROUNDING = 1e-8", "ROUNDING = 0.0"),
        (
            "samples of weight 0 count",
            "jnp.sum(x * weight, 0, keepdims=True)",
            "jnp.sum(x, 0, keepdims=True)",
        ),
        (
            "minibatch target once per rollout",
            "minibatch_target, per_minibatch=True",
            "minibatch_target",
        ),
    ),
]

# Survivors that are no mistakes: the program they make is the same one.
EQUIVALENT = {
    "algorithm/learner/samples.py: stream goes on at its end": "behind the last row there is "
    "nothing: the sum over later steps starts at 0, which the mask multiplies",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    chosen = [m for m in MUTANTS if given.only in f"{m.file}: {m.name}"]
    os.environ.update(JAX_PLATFORMS="cpu", PJRT_NPROC="1", OMP_NUM_THREADS="1", **CHEAP_COMPILING)
    _import_libraries()
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "src"
        shutil.copytree(ROOT / "src", copy, ignore=shutil.ignore_patterns("__pycache__"))
        broken = _failing_test(copy, QUICK)
        log = (copy.parent / "log").read_text()[-3000:]
        assert broken is None, f"{broken} fails on the sources as they are\n{log}"
        found, before = [], {} if given.only else _caught_before()
        for mutant in chosen:
            found.append(before.get(_identity(mutant)) or _try(mutant, copy))
            result = _counted(found)
            if not given.only:
                RESULTS.write_text(json.dumps(result, indent=1) + "\n")
    print(f"{result['caught']} of {len(found)} caught, {result['equivalent']} equivalent")
    return int(result["share"] < 1.0)


def _identity(mutant: Mutant) -> tuple[str, str]:
    """Of a mutant and the file that it is made in, as it is now."""
    source = (ROOT / "src" / "sauna" / mutant.file).read_bytes()
    return f"{mutant.file}: {mutant.name}", hashlib.sha256(source).hexdigest()[:16]


def _caught_before() -> dict[tuple[str, str], dict[str, Any]]:
    rows = json.loads(RESULTS.read_text())["rows"] if RESULTS.exists() else []
    return {(row["name"], row["source"]): row for row in rows if row["caught_by"] is not None}


def _counted(rows: list[dict[str, Any]]) -> dict[str, Any]:
    caught = sum(row["caught_by"] is not None for row in rows)
    alike = sum(row["equivalent"] is not None for row in rows)
    share = caught / max(len(rows) - alike, 1)
    return {
        "mutants": len(rows),
        "caught": caught,
        "equivalent": alike,
        "share": share,
        "rows": rows,
    }


def _import_libraries() -> None:
    """Before forking; not our own package, which each child imports from its copy."""
    import flax.linen
    import gymnasium
    import hypothesis
    import jax
    import numba
    import optax
    import pytest
    import scipy.stats

    del flax, gymnasium, hypothesis, jax, numba, optax, pytest, scipy


def _try(mutant: Mutant, copy: Path) -> dict[str, Any]:
    path, (name, source) = copy / "sauna" / mutant.file, _identity(mutant)
    plain = path.read_text()
    assert plain.count(mutant.old) == 1, f"{name}: {plain.count(mutant.old)} places"
    clock = time.monotonic()
    path.write_text(plain.replace(mutant.old, mutant.new))
    try:
        stages = [tuple(mutant.tests.split()), QUICK] + [SLOW] * (name not in EQUIVALENT)
        caught = next(filter(None, (_failing_test(copy, stage) for stage in stages)), None)
    finally:
        path.write_text(plain)
    row = {
        "name": name,
        "source": source,
        "caught_by": caught,
        "equivalent": None if caught else EQUIVALENT.get(name),
        "seconds": round(time.monotonic() - clock, 1),
    }
    print(json.dumps(row), flush=True)
    return row


def _failing_test(copy: Path, tests: tuple[str, ...]) -> str | None:
    """The first test that fails on the copy, or None."""
    log = copy.parent / "log"
    shutil.rmtree(copy.parent / "__pycache__", ignore_errors=True)
    pid = os.fork()
    if pid == 0:
        _test(copy, tests, log)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if code == 0:
        return None
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", log.read_text(), re.M)
    return found.group(1) if found else f"pytest ended with {code}"


def _test(copy: Path, tests: tuple[str, ...], log: Path) -> None:
    import pytest

    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    os.dup2(out, 2)
    os.chdir(ROOT)
    os.environ["PYTHONPATH"] = str(copy)
    sys.path[:0] = [str(copy), str(ROOT / "tests")]
    sys.dont_write_bytecode = True
    _same_examples_each_time()
    files = [str(_test_file(t)) for t in tests]
    code = 1
    try:
        quiet = ["-x", "-q", "-p", "no:cacheprovider", "--tb=short", "-m", "not slow"]
        code = int(pytest.main([*quiet, *files]))
        code = 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else code
    finally:
        sys.stdout.flush()
        os._exit(code)


def _test_file(name: str) -> Path:
    """`faults/test_07_poisoned_batch`, or a module's name anywhere below `tests/`."""
    if "/" in name:
        return ROOT / "tests" / f"{name}.py"
    (path,) = (ROOT / "tests").rglob(f"test_{name}.py")
    return path


def _same_examples_each_time() -> None:
    """A mutant must not be caught by luck, nor by a machine that is slow."""
    from hypothesis import HealthCheck, settings

    settings.register_profile(
        "mutants", derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    settings.load_profile("mutants")


if __name__ == "__main__":
    sys.exit(main())
