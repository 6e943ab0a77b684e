"""How fast `stepper.cpp` collects, beside raw `mj_step` and today's collector: a prototype.

    python benchmarks/compiled_stepper/measure.py [--rounds 15]

It compiles the stepper against the installed MuJoCo wheel, checks that it computes what today's
collector computes, measures everything alternately in one process on one core, and writes
`benchmarks/results/compiled_stepper.json` and the tables of `README.md`. Seconds are the
process's processor time: other jobs on the machine share its core, and theirs does not count.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from sauna.training.loop.host.loop import host

from sauna.algorithm.learner.update import minibatch_order
from sauna.algorithm.rollout.host import Collected, HostCollector
from sauna.algorithm.rollout.program import Program, make_program
from sauna.algorithm.types import TrainState, member_keys
from sauna.config.presets import members, resolve
from sauna.envs.host.contract import Step, episode_seed
from sauna.envs.host.mujoco_envs import MujocoEnvs
from sauna.envs.make import env_maker
from sauna.envs.probe import probe
from sauna.experiments.bench.rates import ratio
from sauna.system import run_directory
from sauna.system.jax_setup import configure_jax
from sauna.training.loop.member_state import Counters
from sauna.training.prepare import settle

HERE = Path(__file__).parent
RESULT = HERE.parent / "results" / "compiled_stepper.json"
README = HERE / "README.md"
FLAGS = ["-O3", "-march=native", "-ffp-contract=off", "-std=c++17", "-shared", "-fPIC"]
MEMBERS = 3
TRAINED = 40  # iterations of the trained cases: a trained Hopper's episodes are longer
NORMAL_VELOCITY = {"HalfCheetah-v5": True, "Hopper-v5": False}  # how resets draw velocities
CASES = [(env, iterations) for env in NORMAL_VELOCITY for iterations in (0, TRAINED)]
LABELS = {
    "raw_python": "`mj_step` in a Python loop",
    "raw_c": "`mj_step` in a C loop",
    "compiled_acting": "compiled: the stepper alone",
    "compiled_collect": "compiled: all of collecting",
    "today_acting": "today: acting and stepping alone",
    "today_collect": "today: all of collecting",
    "compiled_training": "compiled: collecting and update",
    "today_training": "today: collecting and update",
}


class Fields(ctypes.Structure):
    """`Stepper` of stepper.cpp."""

    _fields_ = (
        [(name, ctypes.c_int32) for name in
         ("members", "rows", "nq", "nv", "nu", "frame_skip", "limit", "judged",
          "normal_velocity", "given")]
        + [("reset_count", ctypes.c_int64)]
        + [(name, ctypes.c_double) for name in
           ("dt", "forward_weight", "control_cost", "healthy_reward", "speed_limit",
            "reset_scale", "clip")]
        + [(name, ctypes.c_void_p) for name in
           ("model", "data", "low", "high", "healthy_low", "healthy_high", "initial", "first",
            "second", "head", "mean", "variance", "count", "seen", "length", "random", "resets",
            "next_reset", "observation", "action", "final_observation", "means", "reward",
            "states", "terminated", "truncated")]
    )  # fmt: skip


def build() -> ctypes.CDLL:
    package = Path(mujoco.__file__).parent
    library = next(package.glob("libmujoco.so.*"))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "stepper.so"
        command = ["g++", *FLAGS, f"-I{package / 'include'}", str(HERE / "stepper.cpp"),
                   str(library), f"-Wl,-rpath,{package}", "-o", str(out)]  # fmt: skip
        subprocess.run(command, check=True)
        built = ctypes.CDLL(str(out))
    built.raw.restype = ctypes.c_double
    assert built.same_version()
    return built


class CompiledCollector(HostCollector):
    """Acts by the stepper; drawing noise, scoring and scaling rewards stay what they are.

    Args:
      case: what is played.
      envs: their models and data are stepped, behind the back of their `step`.
      library: from `build`.
      resets: `[P, R, nq + nv]` states that episodes start from; None: drawn by the stepper.
    """

    def __init__(
        self, case: Case, envs: MujocoEnvs, library: ctypes.CDLL, resets: np.ndarray | None
    ) -> None:
        super().__init__(case.program, case.job.spaces, envs, case.keys)
        config, number = case.job.config, len(case.keys)
        assert config.envs == 1 and config.hidden == (64, 64) and config.activation == "tanh"
        self._library = library
        seen = np.ascontiguousarray(self._buffers.observation)  # members first, as the rest
        self._buffers = self._buffers._replace(observation=seen)
        self.arrays = self._shared(envs, config.rollout_steps, resets)
        self.fields = Fields(**_task_fields(envs, config.env))
        self.fields.members, self.fields.rows = number, self._capacity
        self.fields.clip = config.clip_observations
        self.fields.reset_count = 0 if resets is None else resets.shape[1]
        for name, array in self.arrays.items():
            assert array.flags.c_contiguous
            setattr(self.fields, name, array.ctypes.data)

    def _shared(
        self, envs: MujocoEnvs, rows: int, resets: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """The arrays that the stepper reads and writes; most are the collector's own."""
        bare, number = [slot.env.unwrapped for slot in envs._slots], len(envs._slots)
        moments, buffers = self.observation_moments, self._buffers
        shared = {name: getattr(buffers, name) for name in
                  ("observation", "action", "terminated", "truncated")}  # fmt: skip
        shared |= {name: getattr(moments, name) for name in ("mean", "variance", "count")}
        shared |= zip(("first", "second", "head"), self._actor._weights, strict=True)
        shared |= {
            "model": np.array([env.model._address for env in bare], np.uintp),
            "data": np.array([env.data._address for env in bare], np.uintp),
            "low": envs._low,
            "high": envs._high,
            "initial": np.concatenate([bare[0].init_qpos, bare[0].init_qvel]),
            "seen": self.state.observation,
            "length": np.zeros(number, np.int64),
            "random": np.arange(number, dtype=np.uint64),
            "next_reset": np.zeros(number, np.int64),
            "final_observation": np.zeros_like(buffers.observation),
            "reward": self._rewards,
        }
        low, high = envs._task._constants[6:8]
        if len(low):
            shared |= {"healthy_low": low, "healthy_high": high}
        if resets is not None:
            shared["resets"] = resets
        return shared

    def record(self) -> None:
        """Has the states after each step, and the policy's means, written as well."""
        lead = (len(self._keys), self._capacity)
        self.arrays["means"] = np.zeros((*lead, self.fields.nu), np.float32)
        self.arrays["states"] = np.zeros((*lead, self.fields.nq + self.fields.nv))
        for name in ("means", "states"):
            setattr(self.fields, name, self.arrays[name].ctypes.data)

    def _act(
        self,
        params: np.ndarray,
        noise: np.ndarray,
        first: int,
        last: int,
        acting: np.ndarray,
        final_values: dict[tuple[int, int, int], float],
    ) -> None:
        assert noise.flags.c_contiguous and noise.dtype == np.float32
        fields, on = ctypes.byref(self.fields), acting.reshape(-1).astype(np.uint8)
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (on, noise)]
        failed = self._library.collect(fields, *pointers, first, last)
        assert failed < 0, f"member {failed}: a number is not finite"
        for member, row in np.argwhere(self._buffers.truncated[:, first:last, 0]).tolist():
            final = self.arrays["final_observation"][member, first + row]
            value = self._program.value(params[member], final)
            final_values[member, first + row, 0] = float(np.asarray(value)[0])


def _task_fields(envs: MujocoEnvs, name: str) -> dict[str, Any]:
    task, env = envs._task, envs._slots[0].env.unwrapped
    judged = len(task._constants[6])
    return {
        "nq": env.model.nq,
        "nv": env.model.nv,
        "nu": env.model.nu,
        "frame_skip": env.frame_skip,
        "limit": envs._limit,
        "judged": judged,
        "normal_velocity": NORMAL_VELOCITY[name],
        "dt": env.dt,
        "forward_weight": env._forward_reward_weight,
        "control_cost": env._ctrl_cost_weight,
        "healthy_reward": env._healthy_reward if judged else 0.0,
        "speed_limit": task._constants[2],
        "reset_scale": env._reset_noise_scale,
    }


class RecordedEnvs(MujocoEnvs):
    """Today's environments, keeping the states after each step."""

    def __init__(self, make: Callable[[], Any], seeds: list[tuple[int, int]]) -> None:
        super().__init__(make, seeds)
        self.states: list[np.ndarray] = []

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        told = super().step(action, active)
        self.states.append(self._task.state.copy())
        return told


class Case(NamedTuple):
    """What is played: a task, and members at some point of their training."""

    job: host.Job
    program: Program
    keys: list[Any]
    states: list[TrainState]
    moments: list[np.ndarray] | None  # mean, variance and count; None: before the first step

    @property
    def params(self) -> np.ndarray:
        return np.stack([np.asarray(state.params) for state in self.states])

    def envs(self, kind: type[MujocoEnvs] = MujocoEnvs) -> MujocoEnvs:
        seeds = [(member.seed, 0) for member in self.job.members]
        return kind(env_maker(self.job.config.env, {}), seeds)

    def start(self, collector: HostCollector) -> None:
        """Brings a collector to the case's start, so that every round plays the same."""
        collector.reward_moments.mean[:], collector.reward_moments.variance[:] = 0.0, 1.0
        collector.reward_moments.count[:] = 1e-4
        own = collector.observation_moments
        own.mean[:], own.variance[:], own.count[:] = 0.0, 1.0, 1e-4
        for part in collector.state[1:]:
            part[:] = 0
        collector.start()
        if self.moments is not None:
            own.mean[:], own.variance[:], own.count[:] = self.moments
        if isinstance(collector, CompiledCollector):
            collector.arrays["length"][:] = 0
            collector.arrays["next_reset"][:] = 0

    def collect(self, collector: HostCollector, iteration: int = 0) -> list[Collected]:
        hypers = [host._hypers(self.job, p, Counters(), 0) for p in range(len(self.keys))]
        limit = np.full(len(self.keys), self.job.config.rollout_steps)
        return collector.collect(self.params, hypers, iteration, limit)


def make_case(env: str, iterations: int) -> Case:
    given = {"env": env, "arm": "ppo", "seeds": MEMBERS, "processes": 1}
    config, found = resolve(given), probe(env, {})
    config = settle(config, found.spaces)
    job = host.Job(config, found.spaces, {}, members(config, given), [], None, 0, True)
    program, keys = make_program(config, found.spaces), [member_keys(s) for s in config.seeds]
    case = Case(job, program, keys, [program.init(k.init) for k in keys], None)
    if not iterations:
        return case
    collector = HostCollector(program, found.spaces, case.envs(), keys)
    case.start(collector)
    for iteration in range(iterations):
        collected = case.collect(collector, iteration)
        case = case._replace(states=learn(case, collected, iteration))
    own = collector.observation_moments
    return case._replace(moments=[own.mean.copy(), own.variance.copy(), own.count.copy()])


def learn(case: Case, collected: list[Collected], iteration: int) -> list[TrainState]:
    """The members' states after an update; those of `case` stay usable."""
    states = []
    for p, member in enumerate(case.job.members):
        order = minibatch_order(case.job.config, member.seed, iteration)
        hypers = host._hypers(case.job, p, Counters(), iteration)
        copy = jax.tree.map(lambda leaf: leaf.copy(), case.states[p])  # the update takes it over
        states.append(host._learn(case.program, copy, collected[p], hypers, order)[0])
    return jax.block_until_ready(states)


def prepared_resets(case: Case, episodes: int) -> np.ndarray:
    """The states that Gymnasium's resets give after each member's first episode."""
    env = env_maker(case.job.config.env, {})()
    found = []
    for member in case.job.members:
        for episode in range(1, episodes):
            env.reset(seed=episode_seed(member.seed, 0, episode))
            found.append(env.unwrapped.state_vector())
    env.close()
    return np.array(found).reshape(len(case.keys), episodes - 1, -1)


def validate(case: Case, library: ctypes.CDLL) -> tuple[CompiledCollector, dict[str, Any]]:
    """Plays one rollout by today's collector and its actions again by the stepper.

    Returns:
      the stepper's collector, which still holds the rollout, and what was found.
    """
    recorded = case.envs(RecordedEnvs)
    today = HostCollector(case.program, case.job.spaces, recorded, case.keys)
    case.start(today)
    expected = case.collect(today)
    most = max(len(collected.episodes) for collected in expected)
    replayed = CompiledCollector(case, case.envs(), library, prepared_resets(case, most + 3))
    replayed.record()
    case.start(replayed)
    replayed.fields.given = 1
    replayed._buffers.action[:] = today._buffers.action
    found = case.collect(replayed)
    states = replayed.arrays["states"]
    report = {
        "states_equal": bool(np.array_equal(states, np.stack(recorded.states, 1))),
        "moments_equal": all(
            np.array_equal(getattr(replayed.observation_moments, name),
                           getattr(today.observation_moments, name))
            for name in ("mean", "variance", "count")
        ),
        "rollout_equal": {
            name: all(np.array_equal(getattr(a.rollout, name), getattr(b.rollout, name))
                      for a, b in zip(found, expected, strict=True))
            for name in expected[0].rollout._fields
        },
        "episodes_equal": [c.episodes for c in found] == [c.episodes for c in expected],
        "episodes": sum(len(collected.episodes) for collected in expected),
        "largest_mean_difference": mean_difference(replayed),
    }  # fmt: skip
    return replayed, report


def mean_difference(collector: CompiledCollector) -> float:
    """Between the policy's means by the stepper and by today's loop, of the same observations."""
    actor, means = collector._actor, collector.arrays["means"]
    worst = 0.0
    for row in range(means.shape[1]):
        seen = np.ascontiguousarray(collector._buffers.observation[:, row])
        mean = actor.act(seen, np.zeros_like(means[:, row, None]))[:, 0]
        worst = max(worst, float(np.abs(mean - means[:, row]).max()))
    return worst


def validate_acting(case: Case, collector: CompiledCollector) -> dict[str, float]:
    """The stepper choosing its own actions, which are noise added to the means it reports."""
    collector.record()
    case.start(collector)
    case.collect(collector)
    noise = collector._draw(0, 0) * collector._actor._scale
    action = collector._buffers.action[:, :, 0]
    chosen = collector.arrays["means"] + noise[:, :, 0].swapaxes(0, 1)
    found = {
        "own_actions_largest_mean_difference": mean_difference(collector),
        "own_actions_are_mean_plus_noise": bool(np.array_equal(chosen, action)),
        "own_actions_episodes": int(np.sum(collector._buffers.terminated)
                                    + np.sum(collector._buffers.truncated)),
    }  # fmt: skip
    collector.fields.means = collector.fields.states = None
    return found


def raw_c(case: Case, replayed: CompiledCollector) -> float:
    """Seconds of `mj_step` for the recorded rollout, in a C loop."""
    case.start(replayed)
    rows = case.job.config.rollout_steps
    seconds = replayed._library.raw(ctypes.byref(replayed.fields), rows)
    assert_same_end(replayed)
    return float(seconds)


def raw_python(case: Case, replayed: CompiledCollector) -> float:
    """Seconds of `mj_step` for the recorded rollout, in a Python loop as in `sauna bench`."""
    case.start(replayed)
    envs = replayed._envs
    actions = np.clip(replayed._buffers.action[:, :, 0], envs._low, envs._high).astype(np.float64)
    ended = (replayed._buffers.terminated | replayed._buffers.truncated)[:, :, 0]
    mj_step, seconds = mujoco.mj_step, 0.0
    for p, slot in enumerate(envs._slots):
        bare = slot.env.unwrapped
        model, data, ctrl, skip = bare.model, bare.data, bare.data.ctrl, bare.frame_skip
        lasts = np.flatnonzero(ended[p]).tolist()
        starts = [0, *(last + 1 for last in lasts)]
        for i, start in enumerate(starts):
            episode = actions[p, start : starts[i + 1] if i < len(lasts) else None]
            clock = time.process_time()
            for action in episode:
                ctrl[:] = action
                mj_step(model, data, skip)
            seconds += time.process_time() - clock
            if i < len(lasts):
                put(bare, replayed.arrays["states"][p, lasts[i]])
    assert_same_end(replayed)
    return seconds


def put(env: Any, state: np.ndarray) -> None:
    """Starts an episode from a recorded state."""
    mujoco.mj_resetData(env.model, env.data)
    env.set_state(state[: env.model.nq], state[env.model.nq :])


def assert_same_end(replayed: CompiledCollector) -> None:
    """A raw loop has really done the rollout's steps."""
    for p, slot in enumerate(replayed._envs._slots):
        state = slot.env.unwrapped.state_vector()
        assert np.array_equal(state, replayed.arrays["states"][p, -1])


def collecting(
    case: Case, collector: HostCollector, name: str
) -> tuple[dict[str, float], list[Collected]]:
    """Seconds of one rollout and of the part that the stepper replaces; what was collected."""
    case.start(collector)
    spent, act = 0.0, collector._act

    def timed(*arguments: Any) -> None:
        nonlocal spent
        clock = time.process_time()
        act(*arguments)
        spent += time.process_time() - clock

    collector._act = timed
    clock = time.process_time()
    collected = case.collect(collector)
    seconds = time.process_time() - clock
    del collector._act
    return {f"{name}_acting": spent, f"{name}_collect": seconds}, collected


def one_round(
    case: Case, replayed: CompiledCollector, compiled: CompiledCollector, today: HostCollector
) -> dict[str, float]:
    """Seconds of everything, once forwards and once backwards: a steady drift cancels out."""
    collected: list[Collected] = []

    def collect(collector: HostCollector, name: str) -> dict[str, float]:
        spent, collected[:] = collecting(case, collector, name)
        return spent

    def update() -> dict[str, float]:
        clock = time.process_time()
        learn(case, collected, 0)
        return {"update": time.process_time() - clock}

    measures: list[Callable[[], dict[str, float]]] = [
        lambda: {"raw_python": raw_python(case, replayed)},
        lambda: {"raw_c": raw_c(case, replayed)},
        lambda: collect(compiled, "compiled"),
        lambda: collect(today, "today"),
        update,
    ]
    total: Counter[str] = Counter()
    for take in (*measures, *reversed(measures)):
        total.update(take())
    for name in ("compiled", "today"):
        total[f"{name}_training"] = total[f"{name}_collect"] + total["update"]
    return {name: seconds / 2 for name, seconds in total.items()}


def measure(case: Case, library: ctypes.CDLL, rounds: int) -> dict[str, Any]:
    replayed, found = validate(case, library)
    compiled = CompiledCollector(case, case.envs(), library, None)
    found |= validate_acting(case, compiled)
    today = HostCollector(case.program, case.job.spaces, case.envs(), case.keys)
    steps = len(case.keys) * case.job.config.rollout_steps
    one_round(case, replayed, compiled, today)  # compiles, and touches all memory
    taken = [one_round(case, replayed, compiled, today) for _ in range(rounds)]
    rates = {name: [steps / seconds[name] for seconds in taken] for name in LABELS}
    return {
        "validation": found,
        "rates": rates,
        "to_raw_c": {name: ratio(each, rates["raw_c"]) for name, each in rates.items()},
        "to_raw_python": {name: ratio(each, rates["raw_python"]) for name, each in rates.items()},
        "compiled_to_today": {
            part: ratio(rates[f"compiled_{part}"], rates[f"today_{part}"])
            for part in ("acting", "collect", "training")
        },
    }


def title(env: str, iterations: int) -> str:
    return f"{env}, {'trained' if iterations else 'untrained'}"


def tables(result: dict[str, Any]) -> str:
    """Markdown: ratios to the C loop's rate, then rates."""
    cases = result["cases"]
    lines = ["| times `mj_step` in a C loop | " + " | ".join(cases) + " |"]
    lines.append("|---|" + "---|" * len(cases))
    for name, label in LABELS.items():
        cells = []
        for case in cases.values():
            found = case["to_raw_c"][name]
            cells.append(f"{found['median']:.2f} ({found['low']:.2f} to {found['high']:.2f})")
        if name != "raw_c":
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
    lines += ["", "| compiled times today | " + " | ".join(cases) + " |"]
    lines.append("|---|" + "---|" * len(cases))
    parts = {"acting": "acting and stepping alone", "collect": "all of collecting",
             "training": "collecting and update"}  # fmt: skip
    for part, label in parts.items():
        found = [case["compiled_to_today"][part] for case in cases.values()]
        cells = [f"{f['median']:.2f} ({f['low']:.2f} to {f['high']:.2f})" for f in found]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    lines += ["", "| | " + " | ".join(cases) + " |", "|---|" + "---|" * len(cases)]
    rates = [f"{np.median(case['rates']['raw_c']):,.0f}" for case in cases.values()]
    lines.append("| `mj_step` in a C loop, env steps/s | " + " | ".join(rates) + " |")
    ended = [str(case["validation"]["episodes"]) for case in cases.values()]
    lines.append("| episodes ended in the rollout | " + " | ".join(ended) + " |")
    return "\n".join(lines)


def write_tables(result: dict[str, Any]) -> None:
    begin, end = "<!-- tables begin -->\n", "\n<!-- tables end -->"
    before, _, rest = README.read_text().partition(begin)
    after = rest.partition(end)[2]
    README.write_text(before + begin + tables(result) + end + after)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    configure_jax()
    library = build()
    compiler = subprocess.run(["g++", "--version"], capture_output=True, text=True, check=True)
    result: dict[str, Any] = {
        "machine": run_directory.machine(),
        "versions": run_directory.versions() | {"g++": compiler.stdout.splitlines()[0]},
        "git": run_directory.git_revision(),
        "flags": FLAGS,
        "members": MEMBERS,
        "rollout_steps": resolve({"env": "Hopper-v5", "arm": "ppo"}).rollout_steps,
        "trained_iterations": TRAINED,
        "rounds": rounds,
        "clock": "processor time of one process pinned to one core",
        "load_average": {"start": os.getloadavg()[0]},  # what else the machine had to do
        "cases": {},
    }
    for env, iterations in CASES:
        found = measure(make_case(env, iterations), library, rounds)
        result["cases"][title(env, iterations)] = found
        print(title(env, iterations), json.dumps(found["validation"]), flush=True)
        for name, values in found["to_raw_c"].items():
            print(f"  {name:18} {values['median']:.3f} {values['low']:.3f} {values['high']:.3f}")
    result["load_average"]["end"] = os.getloadavg()[0]
    run_directory.write_json(RESULT, result)
    write_tables(result)
    print(tables(result))


if __name__ == "__main__":
    main()
