"""Studies on Ray: the bytes of a local run, whatever happens to nodes; nothing is left behind."""

from __future__ import annotations

import asyncio
import json
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from clusters import Place, needs_ray, on_ray, same, until
from helpers import environment
from sauna import cli
from sauna.experiments.study.execute import ray_files
from sauna.experiments.study.execute.ray_cluster import connected
from sauna.experiments.study.execute.ray_node import Hub
from sauna.experiments.study.tables import settings
from sauna.system.errors import SaunaError

STUDY = """
tasks = ["small_envs:Scripted"]
seeds = 4
steps = {steps}
rollout_steps = 64
minibatches = 4
epochs = 2
hidden = "8,8"
checkpoint_every = 10

[[arms]]
label = "sauna"
threshold = 0.9

[[arms]]
label = "sauna+random"
threshold = 0.9
"""

slow = pytest.mark.slow


@pytest.fixture
def study(tmp_path: Path) -> str:
    path = tmp_path / "mine.toml"
    path.write_text(STUDY.format(steps=2048))
    return str(path)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--on", "ray"], "on: ray needs `pip install sauna-rl[cluster]`"),
        (["--address", "auto"], "address: read with --on ray only"),
        (["--on", "moon"], "invalid choice: 'moon'"),
    ],
)
def test_what_is_missing_is_said_in_one_line(
    study, arguments, message, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit) as ended:
        cli.main(["study", study, "--trust", "--out", str(tmp_path / "runs"), *arguments])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not (tmp_path / "runs").exists()


@needs_ray
@pytest.mark.parametrize("address", ["here", "ray://:1", "127.0.0.1:1", "ray://127.0.0.1:1"])
def test_an_address_where_nothing_answers(study, address, tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(
            ["study", study, "--trust", "--out", str(tmp_path), "--on", "ray", "--address", address]
        )
    assert ended.value.code == 2
    assert "sauna: address:" in capsys.readouterr().err


def test_a_ray_that_does_not_start_in_time_is_said_in_one_line(monkeypatch) -> None:
    """Ray raises a bare exception if its parts need too long, as on a busy machine."""

    def init(*given: object, **named: object) -> None:
        raise Exception("The current node timed out\nduring startup")

    fake = SimpleNamespace(init=init, shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "5" * 64)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    text = "^cannot start Ray: .*timed out during startup; running again continues$"
    with pytest.raises(SaunaError, match=text), connected("", 1):
        pass


def test_a_report_names_every_machine() -> None:
    machines = [{"system": "one", "cores": 2}, {"system": "other", "cores": 64}]
    known = {"cells": [], "baseline": "ppo", "settings": {}, "versions": [], "git": None}
    shown = str(settings({**known, "machine": machines}))
    assert "'one'" in shown and "'other'" in shown


def test_what_runs_on_nodes_imports_neither_jax_nor_environments() -> None:
    code = (
        "import sys, sauna.experiments.study.execute.ray_node; "
        "sys.exit(any(name in sys.modules for name in ('jax', 'gymnasium', 'ray')))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_task_that_was_replaced_is_not_listened_to() -> None:
    """A node that was cut off may go on: its messages are dropped, and it has to stop."""

    async def talk() -> None:
        hub = Hub()
        first = asyncio.create_task(hub.begin("unit"))
        assert [said.begins for said in await hub.take(1.0)] == [True]
        await hub.answer("unit", {"run/config.json": b"{}"})
        assert await first == (1, {"run/config.json": b"{}"})
        assert not await hub.say("unit", 1, [{"phase": "trains"}], None)
        second = asyncio.create_task(hub.begin("unit"))
        assert [said.begins for said in await hub.take(1.0)] == [False, True]
        assert await hub.say("unit", 1, [{"phase": "goes on"}], None)
        assert await hub.take(0.01) == []
        await hub.stop_one("other")
        assert not await hub.say("unit", 2, [], None)
        await hub.stop_one("unit")
        assert await hub.say("unit", 2, [], None)
        await hub.stop()
        await hub.answer("unit", None)
        assert await second == (2, None)
        assert await hub.say("unit", 2, [], None)

    asyncio.run(talk())


# ------------------------------------------------------------------ files in two places


def put(place: Path, files: dict[str, str]) -> None:
    ray_files.write(place, {name: text.encode() for name, text in files.items()})


def all_of(place: Path) -> dict[str, bytes]:
    return ray_files.read(place, ray_files.names(place))


def test_files_arrive_as_they_are(tmp_path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    put(
        here,
        {
            "run/config.json": "{}",
            "run/metrics.jsonl": "1\n",
            "run/.lock": "7",
            "run/checkpoints/00000010/state.safetensors": "x" * 9,
            "run/checkpoints/.writing-00000020/state.safetensors": "y",
        },
    )
    ray_files.write(there, all_of(here))
    tracker = ray_files.Tracker(there)  # knows what it was given
    put(there, {"run/metrics.jsonl": "1\n2\n", "stderr.txt": "warning"})
    put(
        there,
        {
            "run/checkpoints/00000020/state.safetensors": "z",
            "run/checkpoints/00000020/manifest.json": "{}",
        },
    )
    first = tracker.changes()
    assert sorted(first.files) == [
        "run/checkpoints/00000020/manifest.json",
        "run/checkpoints/00000020/state.safetensors",
    ]
    ray_files.apply(here, first)
    assert all_of(here) == all_of(there)

    with (there / "run/metrics.jsonl").open("a") as log:
        log.write("3\n")
    shutil.rmtree(there / "run/checkpoints/00000010")
    put(there, {"run/summary.json": "{}"})
    second = tracker.changes()
    assert ("run/metrics.jsonl", 4, b"3\n") in second.logs
    ray_files.apply(here, second)
    assert all_of(here) == all_of(there)
    assert tracker.changes().files == {}


def test_a_log_that_was_cut_back_is_replaced_as_a_whole(tmp_path) -> None:
    """A resumed run cuts its logs back to the checkpoint, and goes on with other times."""
    here, there = tmp_path / "here", tmp_path / "there"
    put(here, {"run/timing.jsonl": "1\n2\n3\n"})
    ray_files.write(there, all_of(here))
    tracker = ray_files.Tracker(there)
    put(there, {"run/timing.jsonl": "1\n5\n6\n7\n"})
    ray_files.apply(here, tracker.changes())
    assert all_of(here) == all_of(there)


def test_a_checkpoint_never_counts_on_more_than_has_arrived(tmp_path, monkeypatch) -> None:
    """Interrupted any_member while arriving, the newest checkpoint has its logs and both files."""
    here, there = tmp_path / "here", tmp_path / "there"
    tracker = ray_files.Tracker(there)
    put(there, {"run/metrics.jsonl": "1\n2\n", "run/summary.json": "{}", "run/config.json": "{}"})
    put(
        there,
        {f"run/checkpoints/00000002/{n}": "4" for n in ("state.safetensors", "manifest.json")},
    )
    changes = tracker.changes()
    left = [0]

    def failing(path: Path, data: bytes) -> None:
        if left[0] == 0:
            raise OSError("no space left")
        left[0] -= 1
        path.write_bytes(data)

    monkeypatch.setattr(ray_files.safe_write, "write_durably", failing)
    for writes in range(5):
        shutil.rmtree(here, ignore_errors=True)
        left[0] = writes
        with pytest.raises(OSError):
            ray_files.apply(here, changes)
        if ray_files.checkpoints(here):
            assert (here / "run/metrics.jsonl").read_text() == "1\n2\n"
            assert len(list((here / "run/checkpoints/00000002").iterdir())) == 2
        assert not (here / "run/summary.json").exists()


# ------------------------------------------------------------------ on Ray

STEPS = 38_400  # 600 iterations of each seed
LOOPBACK = {"0100007F", "0000000000000000FFFF00000100007F", "0" * 24 + "01000000"}


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the study comes to on this machine."""
    path = tmp_path_factory.mktemp("local")
    (path / "mine.toml").write_text(STUDY.format(steps=STEPS))
    (path / "local").mkdir()
    subprocess.run(
        [sys.executable, "-m", "sauna", "study", "../mine.toml", "--trust", "--processes=2"],
        cwd=path / "local",
        env=environment(),
        check=True,
        stdout=subprocess.PIPE,
    )
    return path / "local/runs"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    with on_ray(tmp_path, monkeypatch) as place:
        yield place


def start(place: Place, *arguments: str, folder: str, **changed: str) -> subprocess.Popen[str]:
    return place.start("study", "../mine.toml", "--trust", *arguments, folder=folder, **changed)


@slow
@needs_ray
def test_a_lost_node_changes_nothing(place: Place, local: Path) -> None:
    """Two nodes, one of them killed half-way, another one joins: the bytes of a local run."""
    from ray.cluster_utils import Cluster

    (place.path / "mine.toml").write_text(STUDY.format(steps=STEPS))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        lost = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        remote = ("--processes=2", "--on=ray", f"--address={cluster.address}")
        (place.path / "wrong").write_text("6" * 64)
        wrong = str(place.path / "wrong")
        refused = start(place, *remote, folder="refused", RAY_AUTH_TOKEN_PATH=wrong)
        started = start(place, *remote, folder="cluster")
        units = place.path / "cluster/runs/units"

        def half_way() -> bool:
            assert started.poll() is None, started.communicate()
            saved = units.glob("*sauna*/run/checkpoints/*/manifest.json")
            whole = (path for path in saved if path.parent.name.isdigit())  # not one being written
            begun = {path.parts[-5] for path in whole if int(path.parent.name) >= 20}
            return len(begun) == 2

        until(half_way)
        cluster.remove_node(lost, allow_graceful=False)
        cluster.add_node(num_cpus=1)
        said = place.finish(started)
        assert "cannot connect" in place.finish(refused, 2)
        until(lambda: not any("sauna" in line for line in place.processes().values()), 30)
    finally:
        cluster.shutdown()
    assert said.count("its node or process was lost; continues from iteration") == 1
    assert "continues from iteration 0" not in said
    same(place.path / "cluster/runs", local)
    until(lambda: not place.processes(), 60)
    # Ray kills the lost node's processes, so that the folder of its one unit may be left.
    assert len(list((place.path / "nodes").glob("sauna-*"))) <= 1


@slow
@needs_ray
@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_here_and_continued_on_this_machine(
    place: Place, local, number, code, monkeypatch
) -> None:
    """On a Ray of our own: it listens on the loopback interface, and its token is for us only."""
    monkeypatch.delenv("RAY_AUTH_TOKEN_PATH")
    (place.path / "mine.toml").write_text(STUDY.format(steps=STEPS))
    started = start(place, "--processes=2", "--on=ray", folder="ray")
    runs = place.path / "ray/runs"
    until(lambda: list(runs.glob("units/*/run/checkpoints/00000010")))
    (token,) = (place.path / "nodes").glob("sauna-*/token")
    assert token.stat().st_mode & 0o777 == 0o600 and len(token.read_text()) == 64
    assert place.listening() and place.listening() <= LOOPBACK
    started.send_signal(number)
    said = place.finish(started, code)
    assert "continue with: sauna study ../mine.toml --trust --on ray" in said
    until(lambda: not place.processes(), 60)
    assert not list((place.path / "nodes").iterdir())
    saved = [json.loads(p.read_text()) for p in runs.glob("units/*/run/summary.json")]
    assert saved and not any(summary["complete"] for summary in saved)
    place.finish(start(place, "--processes=2", folder="ray"))
    same(runs, local)


@slow
@needs_ray
def test_a_failing_seed_is_reported_and_the_others_complete(place: Place) -> None:
    text = STUDY.format(steps=1024).replace("Scripted", "Unlucky").replace("seeds = 4", "seeds = 2")
    (place.path / "mine.toml").write_text(text)
    said = place.finish(start(place, "--processes=2", "--on=ray", folder="ray"))
    assert "FAILED: small_envs:Unlucky, sauna, seed 1: " in said
    results = json.loads((place.path / "ray/runs/mine/results.json").read_text())
    for cell in results["cells"]:
        assert [m["status"] for m in cell["members"]] == ["complete", "failed"]
        assert "out of luck" in cell["members"][1]["error"]


@slow
@needs_ray
def test_through_rays_client(place: Place, local: Path) -> None:
    """`ray://HOST:PORT`: the study is no part of the cluster; the bytes are the same."""
    (place.path / "mine.toml").write_text(STUDY.format(steps=STEPS))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ray = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--port=0"]
    server = subprocess.Popen(
        [
            *ray,
            "--node-ip-address=127.0.0.1",
            f"--ray-client-server-port={port}",
            "--num-cpus=2",
            "--include-dashboard=false",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        address = f"--address=ray://127.0.0.1:{port}"

        def answers() -> bool:
            with socket.socket() as asked:
                return asked.connect_ex(("127.0.0.1", port)) == 0

        until(answers)
        place.finish(start(place, "--processes=2", "--on=ray", address, folder="client"))
        assert server.poll() is None, "the cluster is not ours to end"
    finally:
        server.terminate()
        server.wait(60)
    same(place.path / "client/runs", local)
    until(lambda: not place.processes(), 60)
