"""The report of an evaluation: the committed tables are what the code makes of the committed numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fracsim.study.plan import read_plan
from fracsim.study.report import write_report

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
RESULTS = BENCHMARKS / "results"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The report of the committed numbers, without pictures of single impulses."""
    folder = tmp_path_factory.mktemp("report")
    results = json.loads((RESULTS / "accuracy.json").read_text(encoding="utf-8"))
    command = results.pop("command")
    paths = write_report(read_plan(BENCHMARKS / "evaluation.toml"), results, folder, folder / "none", command)
    return {path.name: path for path in paths}


def test_the_committed_tables_follow_from_the_committed_numbers(written):
    names = {path.name for path in RESULTS.glob("evaluation_*.md")} | {"accuracy.json"}
    assert names == {name for name in written if not name.endswith(".png")}
    for name in names:
        assert written[name].read_text(encoding="utf-8") == (RESULTS / name).read_text(encoding="utf-8"), name


def test_every_table_has_one_cell_for_each_column(written):
    for name, path in written.items():
        if name.endswith(".md"):
            header, rule, *rows = path.read_text(encoding="utf-8").splitlines()
            assert rows
            assert {line.count(" |") for line in (header, *rows)} == {rule.count("|---")}, name


def test_published_rows_stand_beside_ours(written):
    table = written["evaluation_5_10.md"].read_text(encoding="utf-8")
    assert "| MLP 704x7, the thesis | watershed | 0.0071 | 1.46 | 23.7 | 0.043 | 0.080 | 0.855 |" in table
    assert "| field (default) | atoms |" in table
