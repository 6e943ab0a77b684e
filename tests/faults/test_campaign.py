"""The campaign runs what the rows' tests run, and the page shows what it stored."""

from __future__ import annotations

import inspect
import shutil
from importlib import import_module
from pathlib import Path

import pytest

from faults import campaign, docs, mutants
from faults.result import Result


@pytest.mark.parametrize("row", campaign.ROWS)
def test_every_row_has_its_file_and_its_experiment(row: int) -> None:
    _, module, full, small = campaign.ROWS[row]
    assert module.startswith(f"test_{row:02d}_") and small <= full
    experiment = import_module(f"faults.{module}").experiment
    assert list(inspect.signature(experiment).parameters)[1:] == ["seed", "place"]
    assert inspect.signature(experiment, eval_str=True).return_annotation is Result


def test_the_page_shows_what_was_measured(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    shutil.copy(campaign.DOCS, page)
    docs.write(page, campaign.load())
    assert page.read_text() == campaign.DOCS.read_text(), "run campaign.py --docs"


def test_every_mistake_has_its_place() -> None:
    for mutant in mutants.MUTANTS:
        source = (campaign.ROOT / "src" / "sauna" / mutant.file).read_text()
        assert source.count(mutant.old) == 1, f"{mutant.file}: {mutant.name}"
