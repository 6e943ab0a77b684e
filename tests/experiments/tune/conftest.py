"""What the tests of `sauna tune` share."""

from __future__ import annotations

from collections.abc import Iterator
from unittest.mock import patch

import pytest


@pytest.fixture(scope="module")
def no_page() -> Iterator[None]:
    """Draws nothing: a page costs more than these trainings, and has a test of its own."""
    with patch("sauna.experiments.tune.results.write_page"):
        yield
