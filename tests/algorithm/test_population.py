"""Promise 3: a member depends on its own seed alone. And off means off."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sauna
from helpers import SMALL, environment, equal, make_job, own, train_here
from sauna.config.presets import resolve, resolve_run
from sauna.system import checkpoint
from sauna.system.errors import BadInput
from threads import trained_here

ENV = "small_envs:Scripted"
ARMS = [
    ("sauna-reference", {"threshold": 0.6}),
    pytest.param("ppo", {}, marks=pytest.mark.slow),
    pytest.param("sauna", {"threshold": 0.9}, marks=pytest.mark.slow),
    pytest.param("random-drop", {"drop_rate": 0.3}, marks=pytest.mark.slow),
]


@pytest.mark.processes
@pytest.mark.parametrize("arm, settings", ARMS)
def test_member_3_alone_among_six_and_in_another_process(arm, settings, tmp_path) -> None:
    common = {"arm": arm, "envs": 2, "steps": 256, **settings}
    alone = train_here(make_job(ENV, seeds="3,", **common))
    among = train_here(make_job(ENV, seeds=6, **common))
    assert equal(own(alone.final, f"{arm}/3"), own(among.final, f"{arm}/3"))
    assert alone.rows == [row for row in among.rows if row["seed"] == 3]
    elsewhere = sauna.train(
        ENV,
        quiet=True,
        out=tmp_path / "run",
        **{**SMALL, **common, "seeds": "3,4,5", "processes": 2},
    )
    stored = checkpoint.load_newest(elsewhere.path / "checkpoints", print)
    assert stored is not None
    assert equal(own(alone.final, f"{arm}/3"), own(stored.arrays, f"{arm}/3"))
    assert alone.rows == [row for row in elsewhere.metrics if row["seed"] == 3]


def test_members_differ() -> None:
    """The negative control: other seeds give other bits."""
    final = train_here(make_job(ENV, arm="ppo", seeds=2)).final
    assert not np.array_equal(own(final, "ppo/0")["/adam/mean"], own(final, "ppo/1")["/adam/mean"])


@pytest.mark.parametrize(
    "target, trunk",
    [
        ("rollout", "separate"),
        ("sample", "separate"),
        ("sample", "shared"),
        pytest.param("minibatch", "separate", marks=pytest.mark.slow),
        pytest.param("episode", "separate", marks=pytest.mark.slow),
        pytest.param("rollout", "shared", marks=pytest.mark.slow),
        pytest.param("minibatch", "shared", marks=pytest.mark.slow),
        pytest.param("episode", "shared", marks=pytest.mark.slow),
    ],
)
def test_off_means_off(target: str, trunk: str) -> None:
    """Threshold 0 and c2 = 0 are PPO bit for bit, whatever the head would have learned."""
    common = {"envs": 2, "trunk": trunk, "steps": 256}
    ppo = train_here(make_job(ENV, arm="ppo", **common))
    job = make_job(ENV, arm="sauna", threshold=0.0, vex_coef=0.0, **common)
    off = train_here(job._replace(config=dataclasses.replace(job.config, vex_target=target)))
    assert equal(own(ppo.final, "ppo/0"), own(off.final, "sauna/0"))
    on = train_here(make_job(ENV, arm="sauna", threshold=0.9, vex_target=target, **common))
    assert not equal(own(ppo.final, "ppo/0"), own(on.final, "sauna/0"))


MOVED = {
    "eval_every": 64,
    "eval_episodes": 2,
    "clip_range_schedule": "cosine",
    "entropy_coef": 0.01,
    "entropy_coef_schedule": "linear",
    "warmup": 0.25,
}


def test_off_means_off_with_evaluations_schedules_and_a_callback(tmp_path: Path) -> None:
    """Also where the callback stops a member, of the run as a user starts it."""

    def callback(row: dict[str, Any]) -> bool:
        return row["seed"] == 1 and row["env_steps"] >= 128

    settings = {**SMALL, **MOVED, "envs": 2, "steps": 256, "seeds": 2, "processes": 1}
    found = {}
    with trained_here():
        for arm, off in (("ppo", {}), ("sauna", {"threshold": 0.0, "vex_coef": 0.0})):
            out = tmp_path / arm
            how = {"arm": arm, "out": out, "quiet": True, "callback": callback}
            result = sauna.train(ENV, **how, **settings, **off)
            stops = [member.get("stopped_early") for member in result.summary.values()]
            assert stops == [None, "callback"]
            found[arm] = checkpoint.load_newest(out / "checkpoints", print).arrays
    for seed in (0, 1):
        ppo = own(found["ppo"], f"ppo/{seed}")
        assert equal(ppo, own(found["sauna"], f"sauna/{seed}"))
        assert ppo["/evaluation/best_env_steps"] > 0 and any(n.startswith("/best/") for n in ppo)


def test_off_is_off_for_the_reference_options_too() -> None:
    """With everything kept the released GAE is the usual one, time limits being termination."""
    common = {"envs": 2, "steps": 256, "truncation": "terminate"}
    ppo = train_here(make_job(ENV, arm="ppo", **common))
    off = train_here(make_job(ENV, arm="sauna-reference", threshold=0.0, vex_coef=0.0, **common))
    for name, value in own(ppo.final, "ppo/0").items():
        if name.startswith("/params"):
            np.testing.assert_allclose(own(off.final, "sauna-reference/0")[name], value, atol=1e-5)


def test_arms_that_differ_in_traced_values_share_a_program() -> None:
    """Each trains as it would alone, by the compiler's usual options: `make test` has others."""
    check = "from algorithm.test_population import check_arms; check_arms()"
    usual = {**environment(), "XLA_FLAGS": ""}
    subprocess.run([sys.executable, "-c", check], env=usual, check=True)


def check_arms() -> None:
    common = {"steps": 256, "envs": 2}
    together = train_here(make_job(ENV, arm="ppo,vex-head,sauna", seeds=2, threshold=0.9, **common))
    for arm, settings in (("ppo", {}), ("vex-head", {}), ("sauna", {"threshold": 0.9})):
        alone = train_here(make_job(ENV, arm=arm, seeds=2, **settings, **common))
        for seed in (0, 1):
            one, other = own(alone.final, f"{arm}/{seed}"), own(together.final, f"{arm}/{seed}")
            assert equal(one, other), (arm, seed)


def test_unfiltered_arms_take_the_rules_of_the_filtered_one() -> None:
    arms = resolve_run({"env": "x", "arm": "ppo,sauna-reference"}).arms
    ppo, reference = arms["ppo"], arms["sauna-reference"]
    for name in ("truncation", "budget", "gae_over", "decision"):
        assert getattr(ppo, name) == getattr(reference, name)
    assert (ppo.threshold, ppo.vex_coef, reference.vex_coef) == (0.0, 0.0, 0.5)


def test_arms_of_other_programs_are_refused() -> None:
    refused = ("sauna,random-drop", "sauna,sauna-reference", "sauna,sauna-paper")
    for arms in (*refused, "ppo,gigaflow", "gigaflow,ppo", "ppo,avec", "ppo,sauna+avec"):
        with pytest.raises(BadInput, match="shapes the compiled program"):
            resolve(
                {"env": "x", "arm": arms, "drop_rate": 0.1}
                if "random" in arms
                else {"env": "x", "arm": arms}
            )
