"""``fracsim bench``: it runs, says what it found, and the pages hold what was found."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

from fracsim.bench import BENCHMARKS as NAMES, idle
from fracsim.bench.stability.matrix import all_cells
from fracsim.bench.stability.run import run
from fracsim.cli.main import main

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


@pytest.mark.parametrize("name", NAMES)
def test_the_committed_tables_are_what_the_committed_figures_say(name, tmp_path):
    figures = json.loads((RESULTS / f"runtime_{name}.json").read_text(encoding="utf-8"))
    module = importlib.import_module(f"fracsim.bench.{name}")
    assert module.table(figures) == (RESULTS / f"runtime_{name}.md").read_text(encoding="utf-8").strip()
    assert figures["command"] == f"fracsim bench {name}"
    module.draw(figures, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 5000


def test_a_benchmark_writes_figures_table_and_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(idle, "SCENES", {"one, in flight": idle.SCENES["one, in flight"]})
    out = tmp_path / "out"
    assert main(["bench", "idle", "--quick", "--quiet", "--out", str(out), "--json", str(tmp_path / "b.json")]) == 0
    figures = json.loads((tmp_path / "b.json").read_text())
    assert figures["scenes"]["one, in flight"]["bare_us"] > 0
    assert {path.name for path in out.iterdir()} == {f"runtime_idle.{kind}" for kind in ("json", "md", "png")}
    assert "one, in flight" in capsys.readouterr().out


def test_an_unknown_benchmark_is_refused_by_name(capsys):
    assert main(["bench", "speed"]) == 2
    assert "latency" in capsys.readouterr().err


@pytest.mark.parametrize("seed", [161576974, 594949506, 92794863, 2140277470])
def test_pieces_that_stand_in_what_is_slow_or_spins_too_fast_gain_no_energy(seed):
    [cell] = [cell for cell in all_cells(False, 0) if cell.seed == seed]
    row = run(cell)
    assert row["broke"]
    assert row["failures"] == []
