"""What the pages say is what was measured."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(("name", "blocks"), [("README", 1), ("simulators", 7), ("results", 13), ("runtime", 6)])
def test_a_page_holds_the_tables_that_the_benchmarks_wrote(name, blocks):
    spec = importlib.util.spec_from_file_location("tables", ROOT / "benchmarks" / "tables.py")
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    page = next(page for page in tables.PAGES if page.stem == name).read_text(encoding="utf-8")
    assert len(tables.BLOCK.findall(page)) == blocks
    assert tables.filled(page) == page


def test_every_picture_and_file_that_the_pages_point_to_is_there():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
