"""What the scaled-down rows share: one process to fork from, one run to compare with."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from faults.chain import Stage


@pytest.fixture(scope="session", params=["host", pytest.param("device", marks=pytest.mark.slow)])
def stage(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Stage]:
    with Stage(tmp_path_factory.mktemp("stage"), request.param, iterations=60) as made:
        yield made
