"""Studies of these tests are drawn by the module's own fixtures, whose files a test looks at."""

import pytest


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page has all its pictures; the same ones as files take most of a small study's time."""
    monkeypatch.setattr("sauna.experiments.study.report.write_figures", lambda *given: {})
