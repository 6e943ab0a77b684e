"""Checks and measures what only a GPU can show: `results/gpu.json`, part by part as they come.

    python benchmarks/gpu.py [--minutes 12]        with an NVIDIA GPU and JAX's CUDA
    python benchmarks/gpu.py --toy --out FILE      every part at toy sizes, on the CPU as well
    python benchmarks/gpu.py --wheels FOLDER       on a machine that reaches no package index

The most important parts come first. Each has a time limit of its own, and none begins that the
remaining time does not allow. A part that fails, or whose packages are missing, says so in the
result and stops nothing.

The wheels of `--wheels` are installed for these runs alone, without what they depend on, so JAX
stays the machine's. Where there is an index, `pip download --no-deps -d FOLDER PACKAGES` gets them.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).resolve().parent / "results" / "gpu.json"
LEAST = 20  # seconds below which no part is begun
TOY_PATIENCE = 15  # times the limit on a CPU, which compiles more slowly
WIDE = ["--hidden", "256,256"]
TAIL = 600  # characters of a failure's output that are kept
MISSING = " is not installed"  # what a command says whose packages are missing


class Part(NamedTuple):
    """One check or measurement.

    Attributes:
      name: its key in the result.
      command: without the interpreter; `{json}` stands for a file where figures are written.
      seconds: its own time limit.
      toy: what is added for a try at toy sizes.
    """

    name: str
    command: list[str]
    seconds: int
    toy: list[str]


def _bench(
    name: str, env: str, envs: int, *more: str, seconds: int = 90, members: int = 1, steps: int = 16
) -> Part:
    """Physics alone, collecting, updating and whole iterations of one environment."""
    shape = ["--envs", str(envs), "--rollout-steps", str(steps), "--minibatches", "8"]
    shape += ["--epochs", "4", "--seeds", str(members)]
    command = ["-m", "sauna", "bench", env, "--backend", "device", *shape, "--rounds", "1"]
    toy = ["--envs", "8", "--iterations", "2", "--seeds", str(min(members, 2))]
    toy += ["--rollout-steps", "8", "--minibatches", "2", "--hidden", "16"]
    return Part(name, [*command, "--iterations", "20", "--json", "{json}", *more], seconds, toy)


def _host_bench(name: str, device: str, env: str, *more: str) -> Part:
    """Environments on the host: whole trainings, and where the time goes."""
    command = ["-m", "sauna", "bench", env, "--seeds", "1", "--device", device, "--rounds", "1"]
    toy = ["--iterations", "2", "--rollout-steps", "8", "--minibatches", "2", "--epochs", "1"]
    toy += ["--device", "cpu"]
    return Part(name, [*command, "--iterations", "4", "--json", "{json}", *more], 120, toy)


def _samplers(name: str, only: str) -> Part:
    """The update with `top-advantage` at every kept share, beside PPO's."""
    command = ["benchmarks/selection.py", "--rounds", "3", "--wall", "--only", only]
    return Part(name, [*command, "--out", "{json}"], 90, ["--rounds", "1"])


CHEETAH = ("playground/CheetahRun", 2048, *WIDE)
PONG = ("ALE/Pong-v5", "--preset", "atari")
WIDE_CHEETAH = ("HalfCheetah-v5", "--hidden", "512,256,128")
PARTS = (
    Part("tests", ["-m", "pytest", "-q", "-m", "gpu", "tests/training/test_gpu.py"], 180, []),
    _bench("gymnax CartPole", "gymnax/CartPole-v1", 2048, seconds=60),
    _bench("CheetahRun", *CHEETAH, seconds=120),
    _samplers("Pong's CNN update, with samplers", "Nature CNN"),
    _samplers("update with samplers", "MLP"),
    _host_bench("Pong on the host, learned on the GPU", "gpu", *PONG),
    _bench("64 members", "gymnax/CartPole-v1", 64, members=64, steps=64, seconds=60),
    _bench("MinAtar Breakout", "gymnax/Breakout-MinAtar", 1024, steps=64, seconds=60),
    _bench(
        "Flagrun", "sauna/HumanoidFlagrunHarder-v0", 512, "--hidden", "512,256,128", seconds=180
    ),
    _bench("Brax Ant", "brax/ant", 2048, *WIDE, seconds=120),
    _bench("Brax Humanoid", "brax/humanoid", 2048, *WIDE, seconds=120),
    _bench("CheetahRun against Brax's PPO", *CHEETAH, "--against", "brax", seconds=240),
    _host_bench("Pong on the host, learned on the CPU", "cpu", *PONG),
    _host_bench("512-256-128 on the host, learned on the GPU", "gpu", *WIDE_CHEETAH),
    _host_bench("512-256-128 on the host, learned on the CPU", "cpu", *WIDE_CHEETAH),
)


def run(part: Part, toy: bool, limit: float) -> dict[str, Any]:
    """Runs one part in a process group of its own, which is killed at the time limit."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figures.json"
        words = [*part.command, *(part.toy if toy else [])]
        command = [sys.executable, *(word.replace("{json}", str(path)) for word in words)]
        paths = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
        clock = time.monotonic()
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": paths},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=limit)
            state = "ok" if process.returncode == 0 else f"exit code {process.returncode}"
            if process.returncode and MISSING in output:
                state = "left out: packages are missing"
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            state = f"stopped after {limit:.0f} s"
        figures = json.loads(path.read_text()) if path.is_file() else None
    found: dict[str, Any] = {"state": state, "seconds": round(time.monotonic() - clock, 1)}
    found["command"] = " ".join(["python", *words])
    if figures is not None:
        found["figures"] = figures
    if state != "ok" or figures is None:
        found["output"] = output[-TAIL:]
    return found


def install(wheels: Path, folder: str) -> None:
    """Installs wheels into a folder, where the parts find them."""
    files = [str(path) for path in sorted(wheels.glob("*.whl"))]
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    subprocess.run([*command, "--target", folder, *files], check=True)
    paths = [folder, *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)


def devices() -> str:
    """Names JAX's devices, asked in a process of its own so that no memory stays taken."""
    code = "import jax; print([d.device_kind for d in jax.devices()])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    return done.stdout.strip().splitlines()[-1] if done.returncode == 0 else done.stderr[-TAIL:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=12.0, help="in all (default 12)")
    parser.add_argument("--toy", action="store_true", help="every part at toy sizes")
    parser.add_argument("--only", default="", help="parts whose name contains this")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--wheels", type=Path, help="a folder of wheels to install first")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    with tempfile.TemporaryDirectory() as folder:
        if options.wheels:
            install(options.wheels, folder)
        measure(options, end)


def measure(options: argparse.Namespace, end: float) -> None:
    """Runs the parts, most important first, until the clock says `end`."""
    result: dict[str, Any] = {"command": f"python {' '.join(sys.argv)}", "devices": devices()}
    result["parts"] = {}
    print(result["devices"], flush=True)
    for part in PARTS:
        if options.only not in part.name:
            continue
        left = end - time.monotonic()
        if left < LEAST:
            result["parts"][part.name] = {"state": "not begun: no time left"}
        else:
            limit = part.seconds * (TOY_PATIENCE if options.toy else 1)
            print(f"{part.name} ...", flush=True)
            result["parts"][part.name] = run(part, options.toy, min(limit, left))
        options.out.write_text(json.dumps(result, indent=1) + "\n")
        print(f"{part.name}: {result['parts'][part.name]['state']}", flush=True)


if __name__ == "__main__":
    main()
