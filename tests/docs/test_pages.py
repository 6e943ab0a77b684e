"""README and docs: short enough, small enough, with links that lead somewhere."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from summary_page import findings

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
DOCS = ROOT / "docs"


def reference() -> ModuleType:
    path = DOCS / "_build" / "reference.py"
    spec = importlib.util.spec_from_file_location("reference", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_readme_is_read_in_three_minutes() -> None:
    assert len(README.read_text().splitlines()) <= 150


def test_links_of_the_readme_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)#]+)", README.read_text())
    assert len(links) > 20
    assert not [link for link in links if "://" not in link and not (ROOT / link).exists()]


def test_the_docs_stay_small() -> None:
    assert sum(path.stat().st_size for path in DOCS.rglob("*") if path.is_file()) < 3e6


def test_each_of_our_cells_beside_other_libraries_has_a_recipe_and_a_test() -> None:
    page = (DOCS / "start" / "libraries.md").read_text()
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    ours = [(row[1], row[-1].strip("`")) for row in rows if len(row) == 9]
    assert len(ours) > 45
    for cell, test in ours:
        recipe = re.search(r"]\((\.\./[\w/-]+\.md)", cell)
        assert (cell, test) == ("no", "-") or recipe, cell
        assert test == "-" or (ROOT / "tests" / test).is_file(), test
        assert recipe is None or (DOCS / "start" / recipe[1]).is_file(), cell


def test_every_page_is_in_the_navigation() -> None:
    listed = set(re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert listed == {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}


def test_each_page_of_a_rule_family_has_one_picture_that_a_command_draws() -> None:
    script = (DOCS / "_build" / "rule_pictures.py").read_text()
    pages = sorted((DOCS / "rules").glob("*.md"))
    shown = [re.findall(r"images/rules/(\w+)\.svg", page.read_text()) for page in pages]
    assert len(pages) == 7 and all(len(names) == 1 for names in shown)
    assert {path.stem for path in (DOCS / "images" / "rules").iterdir()} == {n for (n,) in shown}
    assert all(f'"{name}": (' in script for (name,) in shown)


def test_the_findings_are_those_of_the_result_files() -> None:
    """If this fails, run `python results/make.py`."""
    assert findings("docs/results/", short=True) in README.read_text()


@pytest.mark.parametrize("page", sorted((DOCS / "reference").glob("*.md")), ids=lambda p: p.name)
def test_generated_parts_have_a_maker(page: Path) -> None:
    text = page.read_text()
    filled = reference().on_page_markdown(text)
    assert "<!-- generated" not in filled
    assert (len(filled) > len(text)) == ("<!-- generated" in text)


def test_every_setting_is_in_the_reference() -> None:
    from sauna.config.settings import FIELDS, flag

    table = reference().settings()
    assert all(f"`{flag(name)}`" in table for name in FIELDS)
