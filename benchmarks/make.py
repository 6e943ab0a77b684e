"""Makes the tables of speed and the figure of scale from `benchmarks/results/`.

python benchmarks/make.py                      tables and figure from the result files
python benchmarks/make.py --measure            measures first (two hours on an idle machine)
python benchmarks/make.py --measure NAME ...   measures these result files alone
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from sauna.config.choices import PEER_SCRIPTS
from sauna.experiments.bench.command import RECORDS
from sauna.experiments.bench.peer_settings import READ
from sauna.experiments.bench.rates import alternate, ratio, training_rate
from sauna.experiments.bench.scale import draw
from sauna.system import run_directory

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "results"))
from pictures import store  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results"
MEASURED = {
    "cheetah_6": ["HalfCheetah-v5", "--against", "sb3", "--rounds", "5"],
    "cheetah_6_in_1": ["HalfCheetah-v5", "--processes", "1", "--rounds", "5"],
    "hopper_6": ["Hopper-v5", "--rounds", "5", "--iterations", "25"],
    "cheetah_1": ["HalfCheetah-v5", "--seeds", "1", "--against", "sb3", "--rounds", "5"],
    "flagrun_1": shlex.split(
        "sauna/HumanoidFlagrunHarder-v0 --preset flagrun --seeds 1 --rounds 5 --iterations 4"
    ),
    "pong_1": [
        "ALE/Pong-v5",
        "--preset",
        "atari",
        "--seeds",
        "1",
        "--against",
        "sb3",
        "--iterations",
        "10",
    ],
    # A rule that takes half of the samples, beside Stable-Baselines3 with all of them.
    "pong_half": shlex.split(
        "ALE/Pong-v5 --preset atari --arm top-advantage --sampler-kwargs '{\"share\": 0.5}' "
        "--seeds 1 --against sb3 --rounds 5 --iterations 10"
    ),
    # One seed whose environments are stepped by two worker processes.
    "own_slow_workers": shlex.split(
        "own_envs:Reach --env-kwargs '{\"milliseconds\": 1}' --seeds 1 --envs 2 --env-processes 2 "
        "--minibatches 64 --against sb3 --rounds 5 --iterations 3"
    ),
}
LABELS = {
    "pong_half": ", half of the samples",
    "own_slow_workers": ", 1 ms a step, 2 environment workers",
}
# Environments written in Python, and wide networks: one seed per core. BipedalWalker's preset has
# four times as many samples in a rollout, with minibatches of 64, too; that would take an hour.
_WALKER = shlex.split(
    "BipedalWalker-v3 --preset auto --envs 16 --rollout-steps 1024 --minibatches 256"
)
OTHERS = {
    "cartpole": ["CartPole-v1", "--preset", "auto", "--iterations", "400"],
    "lunar_lander": ["LunarLander-v3", "--preset", "auto", "--iterations", "8"],
    "bipedal_walker": [*_WALKER, "--iterations", "6"],
    "own_dict": ["own_envs:Reach"],
    "own_slow": ["own_envs:Reach", "--env-kwargs", '{"milliseconds": 1}', "--iterations", "3"],
    "cheetah_256": ["HalfCheetah-v5", "--hidden", "256,256", "--iterations", "12"],
    "cheetah_512": ["HalfCheetah-v5", "--hidden", "512,256,128", "--iterations", "6"],
}
_BESIDE = ["--seeds", "2", "--against", "sb3", "--rounds", "5"]
# Peers that are known as fast: one seed, one thread. rl_games trains with the numbers of its own
# `mujoco/halfcheetah_envpool.yaml`.
RL_GAMES = shlex.split(
    "--envs 64 --rollout-steps 256 --minibatches 8 --epochs 5 --hidden 128,64,32 --activation elu "
    "--trunk shared --learning-rate 5e-4 --no-clip-value --max-grad-norm 1 --value-coef 4"
)
_GYMNAX = ["--preset", "minatar", "--seeds", "1", "--rounds", "5"]
_POLE = ["gymnax/CartPole-v1", *_GYMNAX, "--iterations", "100"]
_BREAKOUT = ["gymnax/Breakout-MinAtar", *_GYMNAX, "--iterations", "60"]
FAST = {
    "cheetah_rltools": ["HalfCheetah-v5", "--seeds", "1", "--rounds", "5", "--against", "rltools"],
    "cheetah_rl_games": [
        "HalfCheetah-v5",
        "--seeds",
        "1",
        "--rounds",
        "5",
        *RL_GAMES,
        "--against",
        "rl_games",
    ],
    "pole_rejax": [*_POLE, "--against", "rejax"],
    "breakout_rejax": [*_BREAKOUT, "--against", "rejax"],
    # These two need a copy of PureJaxRL's folder: `PUREJAXRL=FOLDER python benchmarks/make.py ...`.
    "pole_purejaxrl": [*_POLE, "--against", "purejaxrl"],
    "breakout_purejaxrl": [*_BREAKOUT, "--against", "purejaxrl"],
}
# Whose products are counted by `peak.py`: what bounds a ratio.
BOUNDED = (*OTHERS, *FAST, "pong_1", "pong_half", "own_slow_workers")
# Needs a copy of CleanRL's script: `sauna bench HalfCheetah-v5 --seeds 1 --against cleanrl
# --script FILE --rounds 3 --json benchmarks/results/cheetah_1_cleanrl.json`. With Gymnasium 1 its
# `TransformObservation` has to be given `env.observation_space`.
BY_HAND = ["cheetah_1_cleanrl"]
SHORT = ("cheetah_6", "cheetah_1_cleanrl", "pong_1", "cartpole", "lunar_lander", "own_dict")
SHORT_NAMES = {"own_dict": "a user's environment"}
NAMES = {
    "sb3": "Stable-Baselines3",
    "cleanrl": "CleanRL's script",
    "rltools": "RLtools (C++)",
    "rl_games": "rl_games + EnvPool",
    "rejax": "rejax",
    "purejaxrl": "PureJaxRL's script",
}
HELD_BY_SCRIPT = {"cleanrl": "its own numbers, which preset `mujoco` has too"}
# What is not equal besides the settings in the last column of the tables: a peer's code says more.
NOT_EQUAL = {
    "sb3": "It steps Gymnasium's environments in `DummyVecEnv`, Atari through its own wrappers.",
    "cleanrl": "A time limit is an end. One line of it is changed for Gymnasium 1.",
    "rltools": "Its tanh is an approximation, its Adam's epsilon 1e-7, an action is not clipped.",
    "rl_games": "It normalises values and not rewards, advantages over a rollout; it clips "
    "observations at 5; its Adam's epsilon is 1e-8; MuJoCo is EnvPool's.",
    "rejax": "gymnax is older; a time limit is an end; each element of a gradient is clipped; "
    "its Adam's epsilon is 1e-8.",
    "purejaxrl": "gymnax is older; a time limit is an end; it returns each step's episode.",
}
FILTERED = {
    "ppo": {"arm": "ppo"},
    "sauna, threshold 0.8": {"arm": "sauna", "threshold": 0.8},
    "sauna-reference": {"arm": "sauna-reference", "budget": "env"},
}


def flags_of_all() -> dict[str, list[str]]:
    """The flags of `sauna bench` by result file."""
    beside = {name: [*own, *_BESIDE] for name, own in OTHERS.items()}
    return {**MEASURED, **beside, **FAST}


def measure(names: Sequence[str]) -> None:
    """Measures what is named, or all; from the folder in which `own_envs.py` is found."""
    flags = {**flags_of_all(), "scale": ["--scale"]}
    for name in names or (*flags, "filtered"):
        if name == "filtered":
            measure_filtered()
            continue
        command = [sys.executable, "-m", "sauna", "bench", *flags[name]]
        if name.endswith("purejaxrl"):
            if "PUREJAXRL" not in os.environ:
                print(f"{name}: left out; PUREJAXRL names no copy of its folder")
                continue
            command += ["--script", str(Path(os.environ["PUREJAXRL"]) / "ppo.py")]
        file = str(RESULTS / f"{name}.json")
        subprocess.run([*command, "--json", file], check=True, cwd=ROOT / "benchmarks")
    count = [sys.executable, "peak.py", "--bounds"]  # operations of the rows that are new
    subprocess.run(count, check=True, cwd=ROOT / "benchmarks")


def measure_filtered() -> None:
    """Filtered arms against PPO, in turn, per env step."""
    common = {"env": "HalfCheetah-v5", "seeds": 6, "steps": 61_440}
    arms = {
        name: partial(training_rate, {**common, **settings}) for name, settings in FILTERED.items()
    }
    rates = alternate(arms, rounds=5, say=print)
    result = {
        **common,
        "machine": run_directory.machine(),
        "versions": run_directory.versions(),
        "rates": rates,
        "of_ppo": {name: ratio(found, rates["ppo"]) for name, found in rates.items()},
    }
    (RESULTS / "filtered.json").write_text(json.dumps(result, indent=1) + "\n")


def filtered_table(result: dict[str, Any]) -> str:
    lines = ["| arm | env steps/s, in sum | of PPO's |", "|---|---|---|"]
    for name, ratio_ in result["of_ppo"].items():
        rates = sorted(result["rates"][name])
        shown = f"{ratio_['median']:.2f} ({ratio_['low']:.2f} to {ratio_['high']:.2f})"
        lines.append(f"| {name} | {rates[len(rates) // 2]:,.0f} | {shown} |")
    return "\n".join(lines)


def stored(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    return {
        name: json.loads(path.read_text())
        for name in names
        if (path := RESULTS / f"{name}.json").exists()
    }


def others_table(found: dict[str, dict[str, Any]], peak: dict[str, Any]) -> str:
    """Beside another trainer with the same settings, and what bounds the ratio."""
    lines = [
        "| PPO on | envs x steps, epochs, network | env steps/s, in sum | of another trainer | the environment's share of our time | no trainer can exceed |",  # noqa: E501
        "|---|---|---|---|---|---|",
    ]
    for name, one in found.items():
        rates, own = sorted(one["rates"]["training"]), one["peer"]["settings"]
        env = _environment(one)
        network = "-".join(map(str, own["hidden"]))
        lines.append(
            f"| {env} | {own['envs']} x {own['rollout_steps']}, {own['epochs']}, {network} | "
            f"{rates[len(rates) // 2]:,.0f} | {_peer(one)} | "
            f"{environment_us(one) / sum(one['split'].values()):.0%} | "
            f"{most_over_peer(name, one, peak):.1f} |"
        )
    return "\n".join(lines)


def most_over_peer(name: str, one: dict[str, Any], peak: dict[str, Any]) -> float:
    """The ratio over the peer of a trainer that only steps the environment and multiplies the
    update's matrices at this machine's peak."""
    return peer_us(one) / (environment_us(one) + products_us(name, peak))


def products_us(name: str, peak: dict[str, Any]) -> float:
    """What the products of an env step's update take at the peak."""
    gflops = max(network["peak_gflops"] for network in peak["networks"])
    return float(peak["operations_of_an_env_step"][name] / (1e3 * gflops))


def environment_us(one: dict[str, Any]) -> float:
    """What an env step takes of the environment alone."""
    if "split" in one:
        return float(one["split"]["environment"] + one["split"]["physics"])
    return 1e6 / median(one["rates"]["physics"])


def peer_us(one: dict[str, Any]) -> float:
    """What an env step takes a process of the peer."""
    return 1e6 * one.get("processes", 1) / median(one["rates"][one["peer"]["name"]])


def beside_table(found: dict[str, dict[str, Any]], peak: dict[str, Any]) -> str:
    """Where the time goes, by training, and what a peer takes in all."""
    lines = [
        "| us per env step | environment, of it its own `step` or physics | normalisation | acting | bookkeeping | update | records | all | the peer, in all | products of the update at the peak |",  # noqa: E501
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, one in found.items():
        split = one["split"]
        records = sum(split[part] for part in RECORDS)
        each = [split[part] for part in ("normalisation", "inference", "bookkeeping", "update")]
        each += [records, sum(split.values()), peer_us(one), products_us(name, peak)]
        own = f"{split['physics']:.1f}" if split["physics"] else "-"
        shown = f"{environment_us(one):.1f}, {own} | " + " | ".join(f"{x:.1f}" for x in each)
        lines.append(f"| {_training(one)}, beside {NAMES[one['peer']['name']]} | {shown} |")
    return "\n".join(lines)


def device_beside_table(found: dict[str, dict[str, Any]], peak: dict[str, Any]) -> str:
    """The same of environments on the device, whose parts are timed each by itself."""
    lines = [
        "| us per env step | environment | collecting | update | all | the peer, in all | products of the update at the peak |",  # noqa: E501
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in found.items():
        each = [1e6 / median(one["rates"][part]) for part in ("physics", "collect", "update")]
        each += [1e6 / median(one["rates"]["whole"]), peer_us(one), products_us(name, peak)]
        shown = " | ".join(f"{x:.2f}" for x in each)
        lines.append(f"| {one['env']}, beside {NAMES[one['peer']['name']]} | {shown} |")
    return "\n".join(lines)


def _environment(one: dict[str, Any]) -> str:
    slow = "milliseconds" in one["peer"]["settings"].get("env_kwargs", "")
    return one["env"] + (", 1 ms a step" if slow else "")


def _training(one: dict[str, Any]) -> str:
    """What was trained, by its environment and network."""
    if one["env"].startswith("ALE/"):
        return f"{_environment(one)}, {', '.join(one['arm'])}"
    return f"{_environment(one)}, {'-'.join(map(str, one['peer']['settings']['hidden']))}"


def peers_table(found: dict[str, dict[str, Any]]) -> str:
    """Each peer once: its version, the settings that are held equal, and what is not equal."""
    lines = ["| peer | versions | held equal | not equal |", "|---|---|---|---|"]
    peers = {one["peer"]["name"]: one["peer"] for one in found.values() if "peer" in one}
    for name, peer in peers.items():
        versions = {n.replace("_", "-"): v for n, v in peer["versions"].items() if n != "python"}
        shown = ", ".join(f"{n} {v}" for n, v in versions.items())
        if name in PEER_SCRIPTS:
            shown += f", its `{PEER_SCRIPTS[name]}` {peer.get('script', 'of no noted revision')}"
        equal = ", ".join(map(_named, (n for n in READ[name] if n != "env")))
        equal = equal or HELD_BY_SCRIPT[name]
        lines.append(f"| {NAMES[name]} | {shown} | {equal} | {NOT_EQUAL[name]} |")
    return "\n".join(lines)


def commands_table(names: Iterable[str]) -> str:
    lines = ["| NAME | `sauna bench` with |", "|---|---|"]
    every = flags_of_all()
    return "\n".join(
        [*lines, *(f"| {n} | `{shlex.join(every[n])}` |" for n in names if n in every)]
    )


def fast_table(found: dict[str, dict[str, Any]], peak: dict[str, Any]) -> str:
    """Beside peers that are known as fast, with what they are measured without."""
    lines = [
        "| peer | PPO on | envs x steps, minibatches, epochs, network | env steps/s: ours, theirs | ratio | no trainer can exceed | measured without |",  # noqa: E501
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in found.items():
        peer, own = one["peer"], one["peer"]["settings"]
        ours = sorted(one["rates"].get("training") or one["rates"]["whole"])
        theirs = sorted(one["rates"][peer["name"]])
        version = peer["versions"].get(peer["name"].replace("_", "-"), "")
        without = ", ".join(map(_named, peer.get("measured_without", ()))) or "-"
        lines.append(
            f"| {NAMES[peer['name']]} {version}".rstrip() + f" | {one['env']} | "
            f"{own['envs']} x {own['rollout_steps']}, {own['minibatches']}, {own['epochs']}, "
            f"{'-'.join(map(str, own['hidden']))} | {_middle(ours)}, {_middle(theirs)} | "
            f"{_ratio(one, peer['name'])} | {most_over_peer(name, one, peak):.1f} | {without} |"
        )
    return "\n".join(lines)


def _dashed(widths: Sequence[int]) -> str:
    return "-".join(map(str, widths))


def _named(field: str) -> str:
    return f"`{field}`"


def _middle(rates: Sequence[float]) -> str:
    return f"{rates[len(rates) // 2]:,.0f}"


def peak_table(peak: dict[str, Any]) -> str:
    """How close an update comes to the machine's peak."""
    lines = [
        "| update | network | samples of a minibatch | operations of a sample, thousands | peak, GFLOP/s | the update, of the peak | its products alone, of the peak | a gradient step, us: all, beyond its products, its optimiser |",  # noqa: E501
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in peak["networks"]:
        network = one["hidden"]
        parts = [one[f"{part}_seconds"] for part in ("update", "products", "optimiser")]
        update, products, optimiser = (1e6 * part / one["gradient_steps"] for part in parts)
        lines.append(
            f"| {one['of']} | {network if isinstance(network, str) else _dashed(network)} | "
            f"{one['samples_of_a_minibatch']} | {one['operations_of_a_sample'] / 1e3:,.0f} | "
            f"{one['peak_gflops']:.0f} | {one['update_of_peak']:.2f} | "
            f"{one['products_of_peak']:.2f} | "
            f"{update:,.0f}, {update - products:,.0f}, {optimiser:,.0f} |"
        )
    return "\n".join(lines)


def startup_table(result: dict[str, Any]) -> str:
    """Seconds from the command, median and range."""
    lines = [
        "| one seed | cold: first env step, first row | warm: first env step, first row |",
        "|---|---|---|",
    ]
    for name, starts in result["starts"].items():
        cells = []
        for kind in ("cold", "warm"):
            moments = [sorted(values) for values in zip(*starts[kind], strict=True)]
            cells.append(
                ", ".join(f"{v[len(v) // 2]:.1f} s ({v[0]:.1f} to {v[-1]:.1f})" for v in moments)
            )
        lines.append(f"| {name} | {' | '.join(cells)} |")
    imports = sorted(result["import_seconds"])
    lines += ["", f"`import sauna` takes {imports[len(imports) // 2]:.2f} s."]
    return "\n".join(lines)


def rates_table(found: dict[str, dict[str, Any]]) -> str:
    lines = [
        "| | processor | env steps/s, in sum | of the simulator alone | of another trainer | first env step | memory of a process |",  # noqa: E501
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in found.items():
        rates = sorted(one["rates"]["training"])
        what = f"{one['env']}{LABELS.get(name, '')}, {', '.join(one['arm'])}, {one['members']} "
        what += "seed" if one["members"] == 1 else "seeds"
        what += f", {one['processes']} process" + ("es" if one["processes"] > 1 else "")
        lines.append(
            f"| {what} | {_processor(one)} | {rates[len(rates) // 2]:,.0f} | "
            f"{_ratio(one, 'physics')} | {_peer(one)} | {one['seconds_to_first_env_step']:.1f} s | "
            f"{one['peak_memory_mib']:.0f} MiB |"
        )
    return "\n".join(lines)


def _processor(one: dict[str, Any]) -> str:
    return str(one["machine"]["processor"]).replace("(R)", "").replace(" Processor", "")


def short_table(found: dict[str, dict[str, Any]]) -> str:
    """The README's table: what was trained, how fast, and beside what; all on one processor."""
    assert {_processor(one) for one in found.values()} == {"Intel Xeon"}, "as README says"
    lines = [
        "| PPO on | seeds, processes | env steps/s | of the simulator alone | against |",
        "|---|---|---|---|---|",
    ]
    for file, one in found.items():
        rates = sorted(one["rates"]["training"])
        peer = "-"
        if "peer" in one:
            name = one["peer"]["name"]
            peer = f"{one['ratios'][name]['median']:.1f} x {NAMES[name]}"
        lines.append(
            f"| {SHORT_NAMES.get(file, one['env'])} | {one['members']}, {one['processes']} | "
            f"{rates[len(rates) // 2]:,.0f} | {_simulator(one)} | {peer} |"
        )
    return "\n".join(lines)


def _simulator(one: dict[str, Any]) -> str:
    physics = one["ratios"].get("physics")
    return f"{physics['median']:.0%}" if physics else "-"


def _peer(one: dict[str, Any]) -> str:
    if "peer" not in one:
        return "-"
    return f"{_ratio(one, one['peer']['name'])} of {NAMES[one['peer']['name']]}"


def _ratio(one: dict[str, Any], name: str) -> str:
    ratio = one["ratios"].get(name)
    if ratio is None:
        return "-"
    return f"{ratio['median']:.2f} ({ratio['low']:.2f} to {ratio['high']:.2f})"


def measured_on(found: dict[str, dict[str, Any]]) -> str:
    machine = next(iter(found.values()))["machine"]
    return f"Measured on: {machine['processor']}, {machine['cores']} cores, {machine['system']}."


def split_table(found: dict[str, dict[str, Any]]) -> str:
    found = {name: one for name, one in found.items() if name not in BY_HAND}
    names = list(next(iter(found.values()))["split"])
    head = []
    for name, one in found.items():
        members = -(-one["members"] // one["processes"])
        head.append(
            f"{one['env']}{LABELS.get(name, '')}, {members} member" + ("s" if members > 1 else "")
        )
    lines = [f"| us per env step | {' | '.join(head)} |", "|---|" + "---|" * len(head)]
    for name in names:
        values = [f"{one['split'][name]:.2f}" for one in found.values()]
        lines.append(f"| {name} | {' | '.join(values)} |")
    totals = [f"{sum(one['split'].values()):.2f}" for one in found.values()]
    return "\n".join([*lines, f"| all | {' | '.join(totals)} |"])


def scale_table(result: dict[str, Any]) -> str:
    lines = ["| | value: 1000 env steps/s, in sum |", "|---|---|"]
    for axis, points in result["scale"].items():
        shown = ", ".join(f"{p['value']}: {p['rate'] / 1000:.1f}" for p in points)
        lines.append(f"| {axis} | {shown} |")
    return "\n".join(lines)


def saved_table(result: dict[str, Any]) -> str:
    """An update's time at each kept share, of that of PPO's."""
    cases = {name: one for name, one in result.items() if "ratio" in one}
    shares = list(next(iter(cases.values()))["ratio"])
    bounds = next(iter(cases.values()))["bound"]
    lines = [f"| kept share | {' | '.join(shares)} |", "|---|" + "---|" * len(shares)]
    for name, one in cases.items():
        lines.append(f"| {name} | {_row(one['ratio'])} |")
    lines.append(f"| bound: 1.15 k + 0.05 | {_row(bounds)} |")
    if pong := result.get("Pong, whole training"):
        faster, rounds = pong["faster_at_0.5"], pong["rounds"]
        lines += ["", f"Whole Pong training at a kept share of 0.5: {faster:.2f} times as fast"]
        lines[-1] += f" (CPU time, {rounds} rounds)."
    return "\n".join(lines)


def alternatives_table(result: dict[str, Any]) -> str:
    """Microseconds of an update's parts, by XLA and by Numba."""
    lines = ["| part | XLA, us | Numba, us | ratio |", "|---|---|---|---|"]
    for one in result["products"]:
        what = f"products of a layer {one['inputs']} x {one['outputs']}, {one['samples']:,} samples"
        lines.append(_both(what, one))
    for one in result["adam"]:
        lines.append(_both(f"clipping and Adam, {one['parameters']:,} parameters", one))
    return "\n".join(lines)


def _both(what: str, one: dict[str, Any]) -> str:
    xla, own = one["xla_us"], one["own_us"]
    return f"| {what} | {xla:,.1f} | {own:,.1f} | {xla / own:.2f} |"


def _row(values: dict[str, float]) -> str:
    return " | ".join(f"{value:.2f}" for value in values.values())


def insert(path: Path, name: str, text: str) -> None:
    """Puts `text` between the markers `NAME` of a Markdown file."""
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    whole = path.read_text()
    head, rest = whole.split(begin)
    path.write_text(f"{head}{begin}\n{text}\n{end}{rest.split(end)[1]}")


def _on_the_device() -> dict[str, dict[str, Any]]:
    return {name: one for name, one in stored(FAST).items() if "split" not in one}


def main() -> None:
    os.chdir(ROOT)
    if "--measure" in sys.argv:
        measure(sys.argv[sys.argv.index("--measure") + 1 :])
    found = stored([*MEASURED, *BY_HAND])
    insert(ROOT / "README.md", "speed", short_table(stored(SHORT)))
    page = ROOT / "docs" / "concepts" / "performance.md"
    insert(page, "rates", rates_table(found))
    others = stored(OTHERS)
    peak = json.loads((RESULTS / "peak.json").read_text())
    insert(page, "others", f"{measured_on(others)}\n\n{others_table(others, peak)}")
    insert(page, "peak", peak_table(peak))
    tried = json.loads((RESULTS / "alternatives.json").read_text())
    insert(page, "alternatives", alternatives_table(tried))
    if fast := stored(FAST):
        insert(page, "fast", f"{measured_on(fast)}\n\n{fast_table(fast, peak)}")
    insert(page, "startup", startup_table(json.loads((RESULTS / "startup.json").read_text())))
    insert(page, "split", split_table(found))
    beside = {name: one for name, one in stored(BOUNDED).items() if "split" in one}
    insert(page, "beside", beside_table(beside, peak))
    insert(page, "device", device_beside_table(_on_the_device(), peak))
    insert(page, "peers", peers_table(stored([*BY_HAND, *flags_of_all()])))
    insert(page, "commands", commands_table(stored(flags_of_all())))
    filtered = RESULTS / "filtered.json"
    if filtered.exists():
        insert(page, "filtered", filtered_table(json.loads(filtered.read_text())))
    insert(page, "saved", saved_table(json.loads((RESULTS / "selection.json").read_text())))
    scaled = RESULTS / "scale.json"
    if scaled.exists():
        result = json.loads(scaled.read_text())
        insert(page, "scale", scale_table(result))
        picture = ROOT / "docs" / "images" / "scale.png"
        draw(result["scale"], f"{result['env']}, PPO, whole training", picture)
        store(picture, picture)


if __name__ == "__main__":
    main()
