"""Do six short runs still end with the same bytes? Trains them and compares with `six_runs.json`.

    python tests/six_runs.py           compare; exit 1 where a digest differs
    python tests/six_runs.py --write   write the digests of this code on this kind of processor

The runs cover PPO, every SAUNA arm, A2C, the device backend and Atari. A digest covers the newest
checkpoint's arrays (parameters, optimizer, normalizer, environments, counters) by name and bytes.
Bits depend on the processor and on the versions of JAX and MuJoCo, so the file names both. Of a
processor that it does not know, write those of an earlier revision first. Atari's were written anew
twice: when a CNN began to act by XLA's convolution, and when compiled functions of our own replaced
that on a CPU.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

from safetensors.numpy import load_file

HERE = Path(__file__).resolve().parent
STORED = HERE / "six_runs.json"
SMALL = "--rollout-steps 256 --minibatches 8 --epochs 3 --seeds 2 --processes 1 --steps 2048"
RUNS = {
    "ppo": f"Hopper-v5 --arm ppo {SMALL}",
    "sauna": f"Hopper-v5 --arm vex-head,sauna --threshold 0.8 {SMALL}",
    "sauna-paper": f"Hopper-v5 --arm sauna-paper {SMALL} --envs 2 --steps 4096",
    "sauna-reference": f"Hopper-v5 --arm sauna-reference {SMALL} --envs 2 --steps 4096",
    "a2c": "InvertedPendulum-v5 --algorithm a2c --arm ppo --seeds 2 --processes 1 --steps 2048",
    "device": f"gymnax/CartPole-v1 --preset mujoco --arm sauna --envs 4 {SMALL} --steps 8192",
    "atari": "ALE/Pong-v5 --preset atari --arm sauna --seeds 1 --processes 1 --steps 2048",
}


def digest(run: Path) -> str:
    """SHA-256 over the arrays of a run's newest checkpoint, by name, type, shape and bytes."""
    newest = max((run / "checkpoints").iterdir(), key=lambda path: int(path.name))
    total = hashlib.sha256()
    for name, array in sorted(load_file(newest / "state.safetensors").items()):
        total.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return total.hexdigest()


def train_all() -> dict[str, str]:
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, arguments in RUNS.items():
            run = Path(folder) / name
            command = [sys.executable, "-m", "sauna", "train", *arguments.split(), "--out", run]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            found[name] = digest(run)
            print(f"{name:16} {found[name][:16]}", flush=True)
    return found


def processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))


def main() -> None:
    here, stored = processor(), json.loads(STORED.read_text())
    if "--write" not in sys.argv and here not in stored:
        sys.exit(f"no digests of {here} in {STORED.name}; write those of an earlier revision")
    digests = train_all()
    if "--write" in sys.argv:
        versions = {name: version(name) for name in ("jax", "mujoco", "numpy", "gymnasium")}
        stored[here] = {"versions": versions, "digests": digests}
        STORED.write_text(json.dumps(stored, indent=1) + "\n")
        return
    known = stored[here]["digests"]
    same = [name for name in known if digests[name] == known[name]]
    print(f"{len(same)} of {len(known)} the same as stored, on {here}")
    if missing := sorted(set(RUNS) - set(known)):
        print(f"not stored for this processor: {', '.join(missing)}")
    sys.exit(len(same) < len(known))


if __name__ == "__main__":
    main()
