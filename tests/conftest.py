"""JAX as the product configures it, before any test imports it; with CI set, a skip is a failure.

In CI a test that needs an accelerator (marker `gpu`) may be skipped, and one whose reason is in
`ALLOWED`.
"""

import gc
import os
import tempfile
from collections.abc import Generator
from contextlib import nullcontext
from itertools import count
from unittest.mock import patch

import pytest

from sauna.system.jax_setup import configure_jax

# Not this user's own key: that of one test session and of the processes that it starts.
os.environ.setdefault("SAUNA_KEY_FILE", os.path.join(tempfile.mkdtemp(), "key"))
# Hundreds of programs that compile in a few milliseconds each are kept on disk as well.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

configure_jax()

import jax  # noqa: E402

from shared_programs import forget, share_programs  # noqa: E402

share_programs()  # before a module imports the functions that make them

from threads import trained_here  # noqa: E402

gc.disable()  # while all modules are imported: nothing of that is garbage

MANY_MAPPINGS = 30_000  # Linux aborts a process that wants more than 65,530, as all slow tests do
_ended = count(1)  # tests
ALLOWED = ("one combination is enough",)  # parts of reasons; none is about a tool that is missing
Report = pytest.TestReport | pytest.CollectReport


def _fail_if_skipped(report: Report) -> None:
    if os.environ.get("CI") and report.skipped and not hasattr(report, "wasxfail"):
        path, line, reason = report.longrepr
        if any(part in reason for part in ALLOWED):
            return
        report.outcome = "failed"
        report.longrepr = f"{path}:{line}: with CI set nothing may be skipped. {reason}"


@pytest.fixture
def fresh_programs() -> Generator[None, None, None]:
    """For a test that replaces a function which programs are traced from."""
    forget()
    yield
    forget()


def pytest_collection_finish() -> None:
    gc.freeze()  # what is there now stays: no later collection looks at it
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Trains in threads, unless the test is about processes, and draws no learning curve, unless
    the test is about that; `tests/faults` chooses for itself."""
    own_choice = "faults" in item.path.parts
    real = own_choice or item.get_closest_marker("processes")
    drawn = own_choice or item.get_closest_marker("draws")
    undrawn = nullcontext() if drawn else patch("sauna.api.draw_curve", lambda run: None)
    with nullcontext() if real else trained_here(), undrawn:
        result = yield
    if next(_ended) % 50 == 0 and _mapped() > MANY_MAPPINGS:
        forget()
        jax.clear_caches()
        gc.collect()
    return result


def _mapped() -> int:
    """Pieces of memory that this process has mapped; each compiled program takes some (Linux)."""
    try:
        with open("/proc/self/maps", "rb") as maps:
            return maps.read().count(b"\n")
    except OSError:
        return 0


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Report, Report]:
    report = yield
    if item.get_closest_marker("gpu") is None:
        _fail_if_skipped(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, Report, Report]:
    report = yield
    _fail_if_skipped(report)
    return report
