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
from typing import Any

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
# Needs a copy of CleanRL's script: `sauna bench HalfCheetah-v5 --seeds 1 --against cleanrl
# --script FILE --rounds 3 --json benchmarks/results/cheetah_1_cleanrl.json`.
BY_HAND = ["cheetah_1_cleanrl"]
SHORT = ("cheetah_6", "cheetah_1_cleanrl", "pong_1", "cartpole", "lunar_lander", "own_dict")
NAMES = {
    "sb3": "Stable-Baselines3",
    "cleanrl": "CleanRL's script",
    "rltools": "RLtools (C++)",
    "rl_games": "rl_games + EnvPool",
    "rejax": "rejax",
    "purejaxrl": "PureJaxRL's script",
}
FILTERED = {
    "ppo": {"arm": "ppo"},
    "sauna, threshold 0.8": {"arm": "sauna", "threshold": 0.8},
    "sauna-reference": {"arm": "sauna-reference", "budget": "env"},
}


def measure(names: Sequence[str]) -> None:
    """Measures what is named, or all; from the folder in which `own_envs.py` is found."""
    flags = {
        **MEASURED,
        **{name: [*own, *_BESIDE] for name, own in OTHERS.items()},
        **FAST,
        "scale": ["--scale"],
    }
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
        env = one["env"] + (", 1 ms a step" if "milliseconds" in own["env_kwargs"] else "")
        network = "-".join(map(str, own["hidden"]))
        stepping = one["split"]["environment"] + one["split"]["physics"]
        lines.append(
            f"| {env} | {own['envs']} x {own['rollout_steps']}, {own['epochs']}, {network} | "
            f"{rates[len(rates) // 2]:,.0f} | {_peer(one)} | "
            f"{stepping / sum(one['split'].values()):.0%} | {most_over_peer(name, one, peak):.1f} |"
        )
    return "\n".join(lines)


def most_over_peer(name: str, one: dict[str, Any], peak: dict[str, Any]) -> float:
    """The ratio over the peer of a trainer that only steps the environment and multiplies the
    update's matrices at this machine's peak."""
    gflops = max(network["peak_gflops"] for network in peak["networks"])
    products = peak["operations_of_an_env_step"][name] / (1e3 * gflops)
    least = one["split"]["environment"] + one["split"]["physics"] + products
    peer = sorted(one["rates"][one["peer"]["name"]])
    return 1e6 * one["processes"] / (peer[len(peer) // 2] * least)


def fast_table(found: dict[str, dict[str, Any]]) -> str:
    """Beside peers that are known as fast, with what they are measured without."""
    lines = [
        "| peer | PPO on | envs x steps, minibatches, epochs, network | env steps/s: ours, theirs | ratio | measured without |",  # noqa: E501
        "|---|---|---|---|---|---|",
    ]
    for one in found.values():
        peer, own = one["peer"], one["peer"]["settings"]
        ours = sorted(one["rates"].get("training") or one["rates"]["whole"])
        theirs = sorted(one["rates"][peer["name"]])
        version = peer["versions"].get(peer["name"].replace("_", "-"), "")
        without = ", ".join(map(_named, peer.get("measured_without", ()))) or "-"
        lines.append(
            f"| {NAMES[peer['name']]} {version}".rstrip() + f" | {one['env']} | "
            f"{own['envs']} x {own['rollout_steps']}, {own['minibatches']}, {own['epochs']}, "
            f"{'-'.join(map(str, own['hidden']))} | {_middle(ours)}, {_middle(theirs)} | "
            f"{_ratio(one, peer['name'])} | {without} |"
        )
    return "\n".join(lines)


def _named(field: str) -> str:
    return f"`{field}`"


def _middle(rates: Sequence[float]) -> str:
    return f"{rates[len(rates) // 2]:,.0f}"


def peak_table(peak: dict[str, Any]) -> str:
    """How close an update comes to the machine's peak."""
    lines = [
        "| network | operations of a sample, thousands | peak, GFLOP/s | the update, of the peak | its products alone, of the peak | a gradient step beyond its products, us |",  # noqa: E501
        "|---|---|---|---|---|---|",
    ]
    for one in peak["networks"]:
        beyond = (one["update_seconds"] - one["products_seconds"]) / one["gradient_steps"]
        lines.append(
            f"| {'-'.join(map(str, one['hidden']))} | {one['operations_of_a_sample'] / 1e3:.0f} | "
            f"{one['peak_gflops']:.0f} | {one['update_of_peak']:.2f} | "
            f"{one['products_of_peak']:.2f} | {1e6 * beyond:.0f} |"
        )
    cnn, gflops = peak["nature_cnn"], max(one["peak_gflops"] for one in peak["networks"])
    lines.append(
        f"| Nature CNN, Pong | {cnn['operations_of_a_sample'] / 1e3:,.0f} | {gflops:.0f} | "
        f"{cnn['update_of_peak']:.2f} | - | - |"
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
    for one in found.values():
        rates = sorted(one["rates"]["training"])
        what = f"{one['env']}, {', '.join(one['arm'])}, {one['members']} "
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
    """The README's table: what was trained, how fast, and beside what."""
    lines = [
        "| PPO on | seeds, processes | env steps/s | of the simulator alone | against |",
        "|---|---|---|---|---|",
    ]
    for one in found.values():
        rates = sorted(one["rates"]["training"])
        peer = "-"
        if "peer" in one:
            name = one["peer"]["name"]
            peer = f"{one['ratios'][name]['median']:.1f} x {NAMES[name]}"
        lines.append(
            f"| {one['env']} | {one['members']}, {one['processes']} | "
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
    for one in found.values():
        members = -(-one["members"] // one["processes"])
        head.append(f"{one['env']}, {members} member" + ("s" if members > 1 else ""))
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


def _row(values: dict[str, float]) -> str:
    return " | ".join(f"{value:.2f}" for value in values.values())


def insert(path: Path, name: str, text: str) -> None:
    """Puts `text` between the markers `NAME` of a Markdown file."""
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    whole = path.read_text()
    head, rest = whole.split(begin)
    path.write_text(f"{head}{begin}\n{text}\n{end}{rest.split(end)[1]}")


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
    if fast := stored(FAST):
        insert(page, "fast", f"{measured_on(fast)}\n\n{fast_table(fast)}")
    insert(page, "startup", startup_table(json.loads((RESULTS / "startup.json").read_text())))
    insert(page, "split", split_table(found))
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
