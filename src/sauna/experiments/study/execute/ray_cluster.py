"""Running the units of a study on a Ray cluster: a task per unit, its files streamed back here.

Ray starts a task again when its node or process is lost; the task then continues from the files
that had arrived, so that one checkpoint interval is lost at most. Which unit runs when, and what
becomes of one that fails, is as on one machine: see `executor.py`. `ray_node.py` runs on the nodes.
"""

from __future__ import annotations

import importlib.util
import os
import secrets
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

from sauna import __version__
from sauna.config.trust import seal
from sauna.experiments.study.execute import ray_files
from sauna.experiments.study.execute.executor import Executor
from sauna.experiments.study.execute.ray_node import Hub, Said, run_unit, version
from sauna.experiments.study.units import Unit
from sauna.system import run_directory
from sauna.system.errors import BadInput, SaunaError, one_line
from sauna.system.safe_write import own_folder

RETRIES = 5  # by Ray, of a task whose node or process was lost; then it counts as failed
TOKENS = (
    "(its token belongs into the file RAY_AUTH_TOKEN_PATH or ~/.ray/auth_token; "
    "of a cluster without one, set RAY_AUTH_MODE=disabled)"
)
TOKEN_PATH = "RAY_AUTH_TOKEN_PATH"
QUIET = {"log_to_driver": False, "logging_level": "ERROR"}


def check(address: str) -> None:
    """Refuses what cannot work before anything is started.

    Raises:
      BadInput: Ray is missing, or nothing answers at the address.
    """
    if importlib.util.find_spec("ray") is None:
        raise BadInput("on: ray needs `pip install sauna-rl[cluster]`")
    if address in ("", "auto"):
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise BadInput(f"address: {address!r} is neither HOST:PORT, ray://HOST:PORT nor auto")
    try:  # Ray itself would try for minutes
        socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()
    except (OSError, OverflowError) as error:
        raise BadInput(f"address: nothing answers at {address}: {error}") from error


@contextmanager
def connected(address: str, jobs: int) -> Iterator[int]:
    """Connects to the Ray at `address`, or starts one on this machine alone; ends it at the end.

    Both are by token unless `RAY_AUTH_MODE` says otherwise. Ours is a new one, in a file that only
    this user can read; that of a cluster is looked for by Ray in `RAY_AUTH_TOKEN`, in the file
    `RAY_AUTH_TOKEN_PATH`, and in `~/.ray/auth_token`.

    Yields:
      how many units can run at a time: `jobs`, or, where that is 0, one per core.

    Raises:
      BadInput: the cluster cannot be used.
      SaunaError: Ray does not start here.
    """
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    with tempfile.TemporaryDirectory(prefix="sauna-") as private:
        try:
            if address:
                _connect(address)
            else:
                _start_here(Path(private), jobs)
            yield jobs or _cores()
        finally:
            import ray

            ray.shutdown()
            if os.environ.get(TOKEN_PATH) == str(Path(private) / "token"):
                del os.environ[TOKEN_PATH]  # the next one here writes its own file


@cache
def _token() -> str:
    """The token of every Ray that this process starts: Ray reads it once per process."""
    return secrets.token_hex(32)


def _start_here(private: Path, jobs: int) -> None:
    """A Ray of our own that listens on the loopback interface only, without a dashboard."""
    if not os.environ.keys() & {"RAY_AUTH_TOKEN", TOKEN_PATH}:
        (private / "token").touch(mode=0o600)
        (private / "token").write_text(_token())
        os.environ[TOKEN_PATH] = str(private / "token")
    # On Linux, Ray replaces a loopback address by one that other machines reach, unless it is set
    # that this is no cluster. The variable has this name everywhere; Ray reads it when imported.
    os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    import ray

    try:
        ray.init("local", num_cpus=jobs or None, include_dashboard=False, **QUIET)
    except Exception as error:  # of its own kinds, and a bare one if its parts need over 30 s
        text = f"cannot start Ray: {one_line(error)}; running again continues"
        raise SaunaError(text) from error


def _connect(address: str) -> None:
    """Connects to a cluster whose nodes can all run our tasks.

    Raises:
      BadInput: it cannot be reached, refuses us, or a node lacks this version of the package.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy as On

    try:
        ray.init(address, **QUIET)
        asked = [
            ray.remote(version)
            .options(num_cpus=0, scheduling_strategy=On(node["NodeID"], soft=False))
            .remote()
            for node in ray.nodes()
            if node["Alive"] and node["Resources"].get("CPU")
        ]
        for place, found in ray.get(asked, timeout=120):
            if found != __version__:
                raise BadInput(f"address: {place} has sauna-rl {found}, not {__version__}")
    except (ConnectionError, ray.exceptions.AuthenticationError) as error:
        text = f"cannot connect to {address}: {one_line(error)} {TOKENS}"
        raise BadInput(f"address: {text}") from error
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise BadInput(f"address: cannot use {address}: {one_line(error)}") from error


def _cores() -> int:
    import ray

    return max(1, int(ray.cluster_resources().get("CPU", 1)))


class RayExecutor(Executor):
    """Runs units as Ray tasks of one core each; needs a connection, see `connected`."""

    def _open(self) -> None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy as On

        self._ray = ray
        # Where the study is (or, of a Ray client, its server): not on a node that may be lost.
        here = On(ray.get_runtime_context().get_node_id(), soft=False)
        self._hub = ray.remote(Hub).options(num_cpus=0, scheduling_strategy=here).remote()
        self._task = ray.remote(run_unit).options(
            num_cpus=1, max_retries=RETRIES, scheduling_strategy="SPREAD"
        )
        self._tasks: dict[Any, str] = {}  # by what Ray knows them by
        self._began: set[str] = set()
        self._locks: dict[str, IO[str]] = {}
        self._git = run_directory.git_revision()
        self._stopped = False
        self._stopped_units: set[str] = set()

    def _start(self, unit: Unit) -> None:
        run = unit.run(self._folder)
        own_folder(run)
        try:
            self._locks[unit.name] = run_directory.lock(run)
        except (
            run_directory.InUse
        ):  # by a local unit of a study that was killed: about to save and end
            self._waiting.append(self._running.pop(unit.name))
            return
        overrides = unit.overrides(self._folder)
        task = self._task.options(num_gpus=1) if overrides.get("device") == "gpu" else self._task
        # The run is this user's: a node has another key, which says nothing here.
        recorded = {"out": overrides["out"], "git": self._git, "seal": seal(overrides)}
        self._tasks[task.remote(self._hub, unit.name, overrides, recorded)] = unit.name

    def _pump(self) -> None:
        if not self._tasks:
            time.sleep(0.2)
            return
        ray = self._ray
        try:
            # Asked first: everything that an ended task said has been said by then.
            ended, _ = ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=0)
            for said in ray.get(self._hub.take.remote(0.2)):
                self._hear(said)
        except ray.exceptions.RayError as error:
            raise SaunaError(
                f"lost the Ray cluster: {one_line(error)}; running again continues"
            ) from error
        for ref in ended:
            name = self._tasks.pop(ref)
            self._began.discard(name)
            self._locks.pop(name).close()
            self._end(name, self._outcome(ref))

    def _outcome(self, ref: Any) -> str:
        try:
            return str(self._ray.get(ref))
        except self._ray.exceptions.RayError as error:
            return one_line(error)

    def _hear(self, said: Said) -> None:
        unit = self._running.get(said.name)
        if unit is None:  # it was cancelled, or given up, and did not know yet
            return
        if said.begins:
            self._begin(unit)
        if said.changes is not None:
            ray_files.apply(self._folder / unit.name, said.changes)
        for message in said.messages:
            self._view.progress(unit, message)

    def _begin(self, unit: Unit) -> None:
        """Sends a task what it begins with: the files of the unit that there are."""
        place = self._folder / unit.name
        files = None
        if not self._stopping() and not self._enough(unit):
            files = ray_files.read(place, ray_files.names(place))
            if unit.name in self._began:
                iteration = int((ray_files.checkpoints(place) or ["0"])[-1])
                text = f"its node or process was lost; continues from iteration {iteration}"
                self._view.progress(unit, {"said": text})
        self._began.add(unit.name)
        self._hub.answer.remote(unit.name, files)

    def _stop_all(self) -> None:
        if not self._stopped:
            self._stopped = True
            self._hub.stop.remote()
            for ref, name in self._tasks.items():
                if name not in self._began:  # Ray has no core for it yet
                    self._ray.cancel(ref)

    def _stop_one(self, name: str) -> None:
        if name not in self._stopped_units:
            self._stopped_units.add(name)
            self._hub.stop_one.remote(name)

    def _close(self) -> None:
        for lock in self._locks.values():
            lock.close()
        self._ray.kill(self._hub)
