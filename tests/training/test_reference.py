"""The collector against plain-Python re-statements, step for step, on a scripted environment.

`released_runner` says once more, with lists and branches, what the authors' released code does:
whole vector steps kept or dropped by the mean over envs against the pooled median of kept steps,
rewards of dropped steps lost, episode ends seen only through the flag of the step before, and GAE
over the kept steps as if adjacent.
"""

from __future__ import annotations

import statistics

import jax
import numpy as np
import pytest

from arrays import no_key
from helpers import make_job
from oracles import RunningNormalizer
from sauna.algorithm.learner.program import make_learner
from sauna.algorithm.rollout.host import HostCollector
from sauna.algorithm.rollout.program import make_program
from sauna.algorithm.types import member_keys
from sauna.envs.host.contract import episode_seed
from sauna.envs.host.gymnasium_envs import GymnasiumEnvs
from sauna.training.loop.budget import hypers_now, step_limit
from sauna.training.loop.member_state import Counters
from small_envs import Scripted

T, N = 24, 2


class Actors:
    """N scripted environments behind a VecNormalize, as the released code sees them."""

    def __init__(self, seed: int, gamma: float) -> None:
        self.envs, self.seed, self.gamma = [Scripted() for _ in range(N)], seed, gamma
        self.episode = [0] * N
        self.obs_rms, self.ret_rms = RunningNormalizer(3), RunningNormalizer(1)
        self.ret, self.score = np.zeros(N), np.zeros(N)
        self.raw = np.stack([self._reset(n) for n in range(N)])
        self.obs_rms.update(self.raw)

    def _reset(self, n: int) -> np.ndarray:
        return self.envs[n].reset(seed=episode_seed(self.seed, n, self.episode[n]))[0]

    def normalized(self, raw: np.ndarray) -> np.ndarray:
        z = (raw - self.obs_rms.mean) / np.sqrt(self.obs_rms.var + 1e-8)
        return np.clip(z, -10, 10).astype(np.float32)

    def step(self, actions: np.ndarray) -> tuple:
        rewards, dones, cut, final, scores = np.zeros(N), np.zeros(N, bool), [], {}, {}
        for n in range(N):
            action = np.clip(actions[n], -1, 1).astype(np.float32)
            raw, rewards[n], terminated, truncated, _ = self.envs[n].step(action)
            self.score[n] += rewards[n]
            dones[n] = terminated or truncated
            cut.append(truncated)
            if dones[n]:
                final[n], scores[n] = raw, self.score[n]
                self.score[n] = 0.0
                self.episode[n] += 1
                raw = self._reset(n)
            self.raw[n] = raw
        self.obs_rms.update(self.raw)
        self.ret = self.ret * self.gamma + rewards
        self.ret_rms.update(self.ret[:, None])
        scaled = np.clip(rewards / np.sqrt(self.ret_rms.var + 1e-8), -10, 10)
        self.ret[dones] = 0.0
        return scaled, dones, np.array(cut), final, scores


def released_runner(
    actors: Actors, act, value, threshold: float, gamma: float, lam: float, dones: np.ndarray, noise
) -> dict:
    obs, rewards, values, vexp, started, scores = [], [], [], [], [], []
    t = 0
    while len(obs) < T:
        seen = actors.normalized(actors.raw)
        action, _, v, x = act(seen, noise(t))
        t += 1
        pooled = [float(p) for row in vexp for p in row]
        keep = not pooled or (
            abs(float(np.mean(x))) / (abs(statistics.median(pooled)) + 1e-8) >= threshold
        )
        if keep:
            obs.append(seen)
            values.append(v)
            vexp.append(x)
            started.append(dones)
        reward, dones, _, _, finished = actors.step(action)
        if keep:
            rewards.append(reward)
            scores += list(finished.values())
    last = value(actors.normalized(actors.raw))
    advantage, later = np.zeros((T, N)), 0.0
    for k in reversed(range(T)):
        alive = 1.0 - (dones if k == T - 1 else started[k + 1])
        following = last if k == T - 1 else values[k + 1]
        delta = rewards[k] + gamma * following * alive - values[k]
        advantage[k] = later = delta + gamma * lam * alive * later
    return {
        "obs": np.stack(obs),
        "advantage": advantage,
        "value": np.stack(values),
        "steps": t,
        "dones": dones,
        "scores": scores,
        "reward": np.stack(rewards),
    }


def corrected_runner(
    actors: Actors, act, value, threshold: float, gamma: float, lam: float, noise
) -> dict:
    """The corrected rules: per env, all earlier steps, full-stream GAE, final values."""
    kept: list[list[int]] = [[] for _ in range(N)]
    stream: list[dict] = []
    history: list[list[float]] = [[] for _ in range(N)]
    while min(map(len, kept)) < T:
        t = len(stream)
        seen = actors.normalized(actors.raw)
        action, _, v, x = act(seen, noise(t))
        for n in range(N):
            middle = statistics.median(history[n]) if history[n] else None
            if middle is None or abs(x[n]) / (abs(middle) + 1e-8) >= threshold:
                kept[n].append(t)
            history[n].append(float(x[n]))
        reward, dones, cut, final, _ = actors.step(action)
        ends = {n: value(actors.normalized(np.stack([raw] * N)))[n] for n, raw in final.items()}
        stream.append({"obs": seen, "v": v, "r": reward, "d": dones, "cut": cut, "ends": ends})
    last = value(actors.normalized(actors.raw))
    advantage = np.zeros((len(stream), N))
    for n in range(N):
        later = 0.0
        for t in reversed(range(len(stream))):
            s = stream[t]
            if s["d"][n]:
                later, successor = 0.0, (s["ends"][n] if s["cut"][n] else 0.0)
            else:
                successor = last[n] if t == len(stream) - 1 else stream[t + 1]["v"][n]
            delta = s["r"][n] + gamma * successor - s["v"][n]
            advantage[t, n] = later = delta + gamma * lam * later
    return {"kept": kept, "advantage": advantage, "stream": stream}


class Setup:
    """One member of the real program and what the re-statements need of it."""

    def __init__(self, arm: str, **settings) -> None:
        job = make_job(
            "small_envs:Scripted",
            arm=arm,
            seeds="3,",
            envs=N,
            rollout_steps=T,
            steps=10_000,
            minibatches=4,
            **settings,
        )
        self.job, self.config = job, job.config
        self.program = make_program(job.config, job.spaces)
        self.learner = make_learner(job.config, self.program.policy, job.spaces)
        self.keys = member_keys(3)
        self.params = self.program.policy.init(self.keys.init)
        envs = GymnasiumEnvs(Scripted, [(3, n) for n in range(N)])
        self.collector = HostCollector(self.program, job.spaces, envs, [self.keys])
        self.collector.start()
        self.hypers = hypers_now(job.members[0].config, Counters())

    def collect(self, iteration: int):
        limit = np.array([step_limit(self.config, Counters())])
        collected = self.collector.collect(
            np.asarray(self.params)[None], [self.hypers], iteration, limit
        )[0]
        return collected, self.learner.make_batch(collected.rollout, self.hypers, no_key())

    def act(self, seen, noise):
        found = self.program.act(self.params[None], seen[None], noise[None])
        action, scores = (np.asarray(x)[0] for x in found)
        return action, *scores.T

    def value(self, seen):
        return np.asarray(self.program.value(self.params, seen))

    def noise(self, iteration: int):
        def of(t: int):
            block = self.program.draw(self.keys.action, np.int32(iteration), np.int32(t // T))
            return np.asarray(block)[t % T]

        return of


@pytest.mark.parametrize("threshold", [0.0, 0.6, 0.9, 1.1])
def test_reference_preset_equals_the_released_runner(threshold: float) -> None:
    setup = Setup("sauna-reference", threshold=threshold)
    actors, dones = Actors(3, setup.config.gamma), np.zeros(N, bool)
    dropped = 0
    for iteration in range(3):
        collected, batch = setup.collect(iteration)
        expected = released_runner(
            actors, setup.act, setup.value, threshold, 0.99, 0.95, dones, setup.noise(iteration)
        )
        dones = expected["dones"]
        assert collected.env_steps == expected["steps"] * N
        assert collected.kept_steps == T * N
        dropped += expected["steps"] - T
        shaped = {
            k: np.asarray(v).reshape((T, N, *v.shape[1:]))
            for k, v in batch._asdict().items()
            if v is not None
        }
        np.testing.assert_allclose(shaped["observation"], expected["obs"], atol=1e-6)
        np.testing.assert_allclose(shaped["value"], expected["value"], atol=1e-6)
        np.testing.assert_allclose(shaped["advantage"], expected["advantage"], atol=1e-4)
        reported = [episode.return_ for episode in collected.episodes if episode.kept]
        np.testing.assert_allclose(reported, expected["scores"])
    assert dropped == 0 if threshold == 0 else dropped > 5


def test_the_released_runner_loses_ends_and_rewards() -> None:
    """The quirks are really met on this script: fewer episodes reported than finished, and other
    advantages than the full stream's."""
    setup = Setup("sauna-reference", threshold=0.9)
    corrected = Setup("sauna-reference", threshold=0.9, gae_over="all")
    finished = reported = 0
    for iteration in range(3):
        collected, batch = setup.collect(iteration)
        other = corrected.collect(iteration)[1]
        finished += len(collected.episodes)
        reported += sum(episode.kept for episode in collected.episodes)
        assert np.abs(np.asarray(batch.advantage) - np.asarray(other.advantage)).max() > 0.1
    assert 0 < reported < finished


@pytest.mark.parametrize("threshold", [0.0, 0.8, 1.05])
def test_corrected_preset_equals_its_restatement(threshold: float) -> None:
    """Envs differ in how many steps they need, so their streams end at different rows."""
    setup = Setup("sauna", threshold=threshold)
    actors = Actors(3, setup.config.gamma)
    collected, batch = setup.collect(0)
    rollout = collected.rollout
    # An env that is full stops acting, and the normaliser sees the others alone. The restatement
    # steps all envs, so it is compared up to the row where the first env is full.
    first_full = int(min(rollout.valid.sum(0)))
    expected = corrected_runner(
        actors, setup.act, setup.value, threshold, 0.99, 0.95, setup.noise(0)
    )
    for n in range(N):
        kept = [t for t in expected["kept"][n] if t < first_full]
        np.testing.assert_array_equal(np.flatnonzero(rollout.keep[:first_full, n]), kept)
    stream = expected["stream"][:first_full]
    np.testing.assert_allclose(
        rollout.observation[:first_full], [s["obs"] for s in stream], atol=1e-6
    )
    np.testing.assert_allclose(rollout.reward[:first_full], [s["r"] for s in stream], atol=1e-6)
    np.testing.assert_array_equal(
        (rollout.terminated | rollout.truncated)[:first_full], [s["d"] for s in stream]
    )
    for t, s in enumerate(stream):
        for n, final in s["ends"].items():
            if s["cut"][n]:
                np.testing.assert_allclose(rollout.next_value[t, n], final, atol=1e-5)
    if threshold == 0.0:
        np.testing.assert_allclose(
            np.asarray(batch.advantage).reshape(T, N), expected["advantage"], atol=1e-4
        )
    assert collected.kept_steps == T * N
    assert (collected.env_steps > T * N) == (threshold > 0)


def test_what_the_bound_leaves_empty_has_weight_0() -> None:
    setup = Setup("sauna", threshold=50.0, max_env_steps_factor=2)
    collected, batch = setup.collect(0)
    assert collected.env_steps == 2 * T * N
    assert 0 < collected.kept_steps < T * N
    assert float(np.asarray(batch.weight).sum()) == collected.kept_steps
    jax.tree.map(lambda x: np.testing.assert_array_equal(np.isfinite(x), True), batch)


def test_mask_drops_without_replacing() -> None:
    setup = Setup("sauna", threshold=0.9, dropped="mask")
    collected, batch = setup.collect(0)
    assert collected.env_steps == T * N > collected.kept_steps
    assert float(np.asarray(batch.weight).sum()) == collected.kept_steps
