"""JAX as the product configures it, before any test imports it; with CI set, a skip is a failure.

In CI a test that needs an accelerator (marker `gpu`) may be skipped, and one whose reason is in
`ALLOWED`.
"""

import os
import tempfile
from collections.abc import Generator

import pytest

from sauna.system.jax_setup import configure_jax

# Not this user's own key: that of one test session and of the processes that it starts.
os.environ.setdefault("SAUNA_KEY_FILE", os.path.join(tempfile.mkdtemp(), "key"))

configure_jax()

ALLOWED = ("one combination is enough",)  # parts of reasons; none is about a tool that is missing
Report = pytest.TestReport | pytest.CollectReport


def _fail_if_skipped(report: Report) -> None:
    if os.environ.get("CI") and report.skipped and not hasattr(report, "wasxfail"):
        path, line, reason = report.longrepr
        if any(part in reason for part in ALLOWED):
            return
        report.outcome = "failed"
        report.longrepr = f"{path}:{line}: with CI set nothing may be skipped. {reason}"


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
