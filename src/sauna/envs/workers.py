"""Host environments in worker processes: the same contract, for environments that are slow."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from sauna.envs.host.contract import HostEnvs, Snapshot, Step
from sauna.envs.host.gymnasium_envs import EnvironmentFailure
from sauna.envs.make import in_process_envs
from sauna.envs.spaces import read_spaces
from sauna.envs.wrapping import PLAIN, Wrapping, read_wrapping
from sauna.system.errors import SaunaError, one_line
from sauna.system.processes import Layout, Message, child_ends, decode, receive, send, start_worker
from sauna.system.tracebacks import cause_of, describe_failure

STARTING = 120.0  # seconds that a worker may take at least to import, make and compile
NOTICE = 0.2  # seconds after which the end of a worker is noticed while another one is awaited
ARRAYS = [name for name in Step._fields if name not in ("ended", "info")]


class ProcessEnvs(HostEnvs):
    """M environments split over worker processes; a step of all workers runs at the same time.

    Args:
      env, env_kwargs: what each worker makes.
      seeds: `(member seed, env index)` of each environment.
      processes: number of workers.
      timeout: seconds after which a silent worker counts as hung.
      backend, rescale, wrapping: of each worker; see `in_process_envs`.
    """

    def __init__(
        self,
        env: str,
        env_kwargs: dict[str, Any],
        seeds: Sequence[tuple[int, int]],
        processes: int,
        timeout: float,
        backend: str = "auto",
        rescale: bool = False,
        wrapping: Wrapping = PLAIN,
    ) -> None:
        self._timeout = timeout
        self._parts = np.array_split(np.arange(len(seeds)), processes)
        # BLAS and XLA threads of a worker would only compete with its siblings for cores.
        self._workers = [start_worker(__name__, {"OMP_NUM_THREADS": "1"}) for _ in self._parts]
        for worker, part in zip(self._workers, self._parts, strict=True):
            chosen = [list(seeds[i]) for i in part]
            try:
                worker.send(
                    {
                        "kind": "make",
                        "env": env,
                        "kwargs": env_kwargs,
                        "seeds": chosen,
                        "backend": backend,
                        "rescale": rescale,
                        "wrapping": wrapping._asdict(),
                    }
                )
            except BrokenPipeError:
                pass  # named when its answer is read
        self._polls = [select.poll() for _ in self._workers]
        for poll, worker in zip(self._polls, self._workers, strict=True):
            poll.register(worker.inbox.fileno(), select.POLLIN)
        # Of a step's action and of its answer, by worker, once one was sent whole.
        self._actions: dict[int, Layout] = {}
        self._steps: dict[int, Layout] = {}
        answers = [self._answer(number, max(timeout, STARTING)) for number in range(processes)]
        self.spaces = read_spaces(answers[0].header["spaces"])

    def reset(self) -> np.ndarray:
        for number in range(len(self._workers)):
            self._say(number, {"kind": "reset"})
        return np.concatenate(
            [self._answer(k).arrays["observation"] for k in range(len(self._workers))]
        )

    def step(self, action: np.ndarray, active: np.ndarray) -> Step:
        for number, part in enumerate(self._parts):
            rows = slice(part[0], part[-1] + 1)
            self._ask(number, {"action": action[rows], "active": active[rows]})
        answers = [self._answer(number) for number in range(len(self._workers))]
        for number in range(len(self._steps), len(answers)):
            self._steps[number] = Layout(answers[number].arrays)
        parts = {name: np.concatenate([a.arrays[name] for a in answers]) for name in ARRAYS}
        ends = ("terminated", "truncated", "life_lost")
        info = {
            int(part[local]): numbers
            for part, answer in zip(self._parts, answers, strict=True)
            for local, numbers in answer.header.get("info", ())
        }
        return Step(**parts, ended=any(bool(parts[n].any()) for n in ends), info=info)

    def snapshot(self, index: int) -> Snapshot:
        number, local = self._find(index)
        self._say(number, {"kind": "snapshot", "index": local})
        return self._answer(number).arrays

    def restore(self, index: int, snapshot: Snapshot) -> np.ndarray:
        number, local = self._find(index)
        self._say(number, {"kind": "restore", "index": local}, snapshot)
        return self._answer(number).arrays["observation"]

    def start_after(self, index: int, snapshot: Snapshot) -> np.ndarray:
        number, local = self._find(index)
        self._say(number, {"kind": "start_after", "index": local}, snapshot)
        return self._answer(number).arrays["observation"]

    def close(self) -> None:
        for worker in self._workers:
            worker.stop()

    def _ask(self, number: int, arrays: dict[str, np.ndarray]) -> None:
        """Sends a worker the actions of a step."""
        blob = self._actions[number].pack(arrays) if number in self._actions else None
        if blob is None:
            self._actions[number] = Layout(arrays)
            self._say(number, {"kind": "step"}, arrays)
            return
        try:
            self._workers[number].outbox.send_bytes(blob)
        except BrokenPipeError:
            self._answer(number)

    def _say(
        self, number: int, header: dict[str, Any], arrays: dict[str, np.ndarray] | None = None
    ) -> None:
        try:
            self._workers[number].send(header, arrays)
        except BrokenPipeError:
            self._answer(number)  # reads its last words, or names its end

    def _find(self, index: int) -> tuple[int, int]:
        number = next(k for k, part in enumerate(self._parts) if index in part)
        return number, int(index - self._parts[number][0])

    def _answer(self, number: int, timeout: float | None = None) -> Message:
        worker = self._workers[number]
        name = f"environment worker {number} (process {worker.process.pid})"
        timeout = timeout or self._timeout
        if not self._wait_for(number, timeout):
            worker.process.kill()
            raise EnvironmentFailure(f"{name} did not answer within {timeout:g} s")
        try:
            blob = worker.inbox.recv_bytes()
        except (EOFError, ConnectionResetError):
            code = worker.process.wait()
            raise EnvironmentFailure(f"{name} ended with exit code {code}") from None
        if blob.startswith(Layout.RAW):
            return Message({"kind": "answer"}, self._steps[number].unpack(blob))
        message = decode(blob)
        if message.header["kind"] == "failure":
            error = EnvironmentFailure(f"{name}: {message.header['message']}")
            raise error from cause_of(message.header)
        return message

    def _wait_for(self, number: int, timeout: float) -> bool:
        """Whether a worker answers in time; another one's end is noticed meanwhile."""
        end = time.monotonic() + timeout
        poll = self._polls[number].poll
        while not poll(1000.0 * min(NOTICE, max(end - time.monotonic(), 0.0))):
            for other, worker in enumerate(self._workers):
                if other != number and worker.process.poll() is not None:
                    self._answer(other)  # its last words, or its exit code
            if time.monotonic() >= end:
                return False
        return True


def _serve_step(envs: HostEnvs, arrays: dict[str, np.ndarray], layout: Layout | None) -> Any:
    """A step's answer, in full unless plain bytes say all of it: `(header, arrays, bytes)`."""
    step = envs.step(arrays["action"], arrays["active"])
    told = {name: getattr(step, name) for name in ARRAYS}
    if step.info or layout is None:
        header = {"kind": "answer", **({"info": [*step.info.items()]} if step.info else {})}
        return header, told, None
    return {"kind": "answer"}, told, layout.pack(told)


def _serve(envs: HostEnvs, message: Message) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """An answer's header and arrays."""
    header: dict[str, Any] = {"kind": "answer"}
    kind, arrays = message.header["kind"], message.arrays
    if kind == "reset":
        return header, {"observation": envs.reset()}
    if kind == "snapshot":
        return header, envs.snapshot(message.header["index"])
    go_on = envs.restore if kind == "restore" else envs.start_after
    return header, {"observation": go_on(message.header["index"], arrays)}


def main() -> None:
    """The worker: makes its environments, then answers until its inbox closes."""
    inbox, outbox = child_ends(sys.argv[1:])
    try:
        header = receive(inbox).header
        seeds = [(int(a), int(b)) for a, b in header["seeds"]]
        how = header["backend"], header["rescale"], read_wrapping(header["wrapping"])
        envs = in_process_envs(header["env"], header["kwargs"], seeds, *how)
        send(outbox, {"kind": "made", "spaces": list(envs.spaces)})
        asked, told = Layout({}), None  # of a step's actions, and of its answer
        while True:
            blob = inbox.recv_bytes()
            is_raw = blob.startswith(Layout.RAW)
            message = Message({"kind": "step"}, asked.unpack(blob)) if is_raw else decode(blob)
            if message.header["kind"] != "step":
                send(outbox, *_serve(envs, message))
                continue
            asked = asked if is_raw else Layout(message.arrays)
            answer, arrays, raw = _serve_step(envs, message.arrays, told)
            if raw is None:
                told = told or Layout(arrays)
                send(outbox, answer, arrays)
            else:
                outbox.send_bytes(raw)
    except (EOFError, BrokenPipeError):
        return
    except Exception as error:
        text = str(error) if isinstance(error, SaunaError) else one_line(error)
        send(outbox, {"kind": "failure", "message": text, **describe_failure(error, False)})


if __name__ == "__main__":
    main()
