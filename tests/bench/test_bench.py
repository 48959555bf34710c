"""``fracsim bench``: it measures, and its tables and pictures say what the figures say."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import matplotlib.image
import numpy as np
import pybullet as p
import pytest
from matplotlib.figure import Figure

import fracsim
from fracsim.bench import BENCHMARKS, benchmark, idle, latency, picture, run, soak, timestep
from fracsim.bench.stability import report
from fracsim.bench.stability.cells import Cell
from fracsim.bench.stability.matrix import all_cells
from fracsim.bench.stability.mechanics import mechanics_of
from fracsim.bench.stability.player import Player
from fracsim.bench.stability.run import judge
from fracsim.bench.stability.run import run as play
from fracsim.cli.main import main

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


def committed(name):
    return json.loads((RESULTS / f"runtime_{name}.json").read_text(encoding="utf-8"))


def cells_of(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def row_of(table, *first):
    """The row of a table that begins with these cells, by the headings of its columns."""
    lines = table.splitlines()
    [at] = [k for k, line in enumerate(lines) if cells_of(line)[: len(first)] == list(first)]
    head = max(k for k in range(at) if lines[k].startswith("|---")) - 1
    return dict(zip(cells_of(lines[head]), cells_of(lines[at]), strict=True))


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved, as Matplotlib holds them."""
    figures = []
    save = Figure.savefig

    def keep(self, *arguments, **keywords):
        figures.append(self)
        return save(self, *arguments, **keywords)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


# What is committed


@pytest.mark.parametrize("name", BENCHMARKS)
def test_the_committed_table_is_made_by_this_code_from_the_committed_figures(name):
    figures = committed(name)
    assert benchmark(name).table(figures) == (RESULTS / f"runtime_{name}.md").read_text(encoding="utf-8").strip()
    assert figures["command"] == f"fracsim bench {name}"


@pytest.mark.parametrize(
    ("name", "panels"),
    [
        ("latency", [("pieces", "ms from contact to bodies"), ("pieces", "events")]),
        ("idle", [("µs a step, median", "")]),
        ("decomposition", [("ms a break, median", "symmetric difference, of the piece's volume")]),
        (
            "timestep",
            [
                ("critical height with steps of 1/960 s, m", "with steps of 1/120 s, m"),
                ("s of computing for a simulated second", "error / size, 0.1 s after contact"),
            ],
        ),
        (
            "stability",
            [("speed, m/s", "time step, s"), ("speed, m/s", "time step, s"), ("density ratio", "size, m"), ("", "")],
        ),
        (
            "soak",
            [("", "MB more than at the start"), ("", "MB more than at the start")] + 2 * [("episodes", "ms a step")],
        ),
    ],
)
def test_a_picture_has_its_panels_its_labels_and_ink_in_each(name, panels, drawn, tmp_path):
    benchmark(name).draw(committed(name), tmp_path / "picture.png")
    [figure] = drawn
    axes = [axis for axis in figure.axes if axis.get_label() != "<colorbar>"]
    assert [(axis.get_xlabel(), axis.get_ylabel()) for axis in axes] == panels
    pixels = matplotlib.image.imread(tmp_path / "picture.png")[:, :, :3]
    height, width = pixels.shape[:2]
    for axis in axes:
        box = axis.get_position()
        rows = slice(int(height * (1 - box.y1)) + 3, int(height * (1 - box.y0)) - 3)
        inside = pixels[rows, int(width * box.x0) + 3 : int(width * box.x1) - 3]
        assert (inside.std(axis=2) > 0.05).mean() > 1e-4  # something in colour


# Tables and pictures of known figures


def test_the_table_of_latency_has_medians_and_extremes_of_the_events(drawn, tmp_path):
    rows = [[4.0, 0.1, 0.2, 2, 10], [8.0, 0.1, 0.4, 3, 30], [6.0, 0.3, 0.3, 7, 20]]
    processes = [
        {"rows": rows, "stages": {"bodies": [1.0, 3.0, 2.0]}, "extra_memory_mb": 3.2},
        {"rows": [[9.0, 0.1, 0.1, 2, 4]], "stages": {}, "extra_memory_mb": 0.0},
    ]
    summary = latency.summary_of(processes)
    assert summary["stages_ms"] == {"bodies": 2.0}
    assert summary["histogram"] == {"2-2": 1, "3-4": 1, "5-8": 1} | dict.fromkeys(
        ("9-16", "17-32", "33-64", "65-128"), 0
    )
    thesis = {"prediction_ms": 100.0, "segmentation_ms": 20.0, "median_ms": 120.0, "p99_ms": 150.0, "times_ours": 20.0}
    figures = {"meshes": {"bunny": summary | {"vertices": 12}}, "thesis": thesis}
    table = latency.table(figures)
    row = row_of(table, "bunny")
    assert row["median, ms"] == "**6.0**"
    assert row["p99, ms"] == "**8.0**"
    assert row["pieces, median / most"] == "3 / 7"
    assert row["convex parts"] == "20"
    assert row["first of a process, ms"] == "6.5 (most 9.0)"
    assert row["the engine's own step"] == "0.10"
    assert "**20 times** ours" in table
    assert "bunny: 2-2 in 1, 3-4 in 1, 5-8 in 1." in table
    latency.draw(figures, tmp_path / "p.png")
    left, right = drawn[0].axes
    np.testing.assert_array_equal(left.lines[0].get_xydata(), [[2, 4.0], [3, 8.0], [7, 6.0]])
    assert sum(bar.get_height() for bar in right.patches) == 3


def test_the_table_of_idle_judges_each_limit_by_its_own_measure(drawn, tmp_path):
    scene = {
        "bare_us": 10.0,
        "watched_us": 16.0,
        "extra_us_median": 6.0,
        "extra_us_p99": 30.0,
        "ratio_of_pairs": 1.04,
        "ratios_of_pairs": [1.03, 1.05],
        "ratio_of_medians": 1.1,
        "ratio_of_totals": 1.2,
        "calls_a_step": {"stepSimulation": 1.0, "getContactPoints": 0.5},
        "limit": 5.0,
        "holds": False,
    }
    figures = {"scenes": {"first": scene, "second": scene | {"limit": 1.05, "holds": True}}}
    table = idle.table(figures)
    assert row_of(table, "first")["limit"] == "5 µs: missed"
    assert row_of(table, "second")["limit"] == "1.05: held"
    assert row_of(table, "first")["engine calls a step"] == "0.50"
    idle.draw(figures, tmp_path / "p.png")
    assert [bar.get_width() for bar in drawn[0].axes[0].patches] == [10.0, 10.0, 6.0, 6.0]


def test_critical_heights_are_compared_by_their_ratios(tmp_path):
    heights = np.array([[0.2, 0.1], [0.4, 0.4], [0.01, 0.01], [0.1, 0.2]])
    compared = timestep.compared(heights)
    assert compared["beyond"] == 1
    assert compared["ratio_median"] == 1.0
    assert compared["ratio_mean"] == pytest.approx(1.0)
    assert compared["ratio_range"] == [0.5, 2.0]
    assert compared["within_10_percent"] == pytest.approx(1 / 3)
    assert compared["mean_height"] == pytest.approx([0.2, 0.2])
    row = {"strength": 2.0, "heights": heights.tolist(), "ari": [1.0] * 4, **compared, "ari_0.9": 0.75}
    speed = {"error_median": 0.125, "error_worst": 0.5, "seconds_a_simulated_second": 0.25}
    flights = {str(rate): speed for rate in timestep.FLIGHTS}
    meshes = timestep.MESHES
    figures = {
        "rates": timestep.RATES,
        "range": timestep.RANGE,
        "meshes": dict.fromkeys(meshes, row),
        "flights": dict.fromkeys(meshes, flights),
    }
    table = timestep.table(figures)
    assert row_of(table, "vase")["smallest to largest"] == "0.50 to 2.00"
    assert row_of(table, "vase")["within 10 %"] == "33%"
    assert row_of(table, "1/240")["vase: error / size (worst); s a simulated second"] == "0.125 (0.50); 0.25"


def test_the_table_of_the_soak_says_what_grew_and_whether_that_holds():
    mode = {
        "episodes": 40,
        "breaks": 12,
        "pieces": 90,
        "memory_mb": 250.0,
        "memory_growth": {"breakable": 0.081, "twin": 0.02},
        "step_ms": {"breakable": 0.25, "twin": 0.125},
        "step_time_drift": {"breakable": 0.01, "twin": 0.0},
        "files_more": 1,
        "left_behind": {"breakable": {"bodies": 2, "next_shape": 7}},
        "holds": {"memory": False, "step_time": True},
    }
    row = row_of(soak.table({"modes": {"resetSimulation": mode}}), "resetSimulation")
    assert row["growth (twin's)"] == "8.1% (2.0%): missed"
    assert row["drift (twin's)"] == "1.0% (0.0%): held"
    assert (row["files more"], row["bodies left"], row["next shape's id"]) == ("1", "2", "7")


def stability_row(failures=(), engine=(), broke=True, **axes):
    cell = Cell("matrix", 1 / 240, 5.0, 1.0, 0.3, 1, "bunny", "ball", 4.0, 0, 17)
    live = {
        "residuals": {"momentum": 3e-5, "energy": 0.25},
        "broken": {},
        "notes": ["restored"],
        "pieces": 9,
        "spinning": 0.5,
        "turn": 0.125,
        "overlap": 0.0,
    }
    row = {"cell": asdict(cell) | axes, "live": live, "broke": broke, "seconds": 2.0}
    return row | {"failures": list(failures), "engine": list(engine)}


def test_the_table_of_the_stress_matrix_counts_failures_by_family_and_lists_them(drawn, tmp_path):
    rows = [stability_row(["energy"]), stability_row([], ["momentum"]), stability_row(broke=False, family="held")]
    figures = {"rows": rows, "cells": 3, "left": 2, "broke": 2, "failed": 1, "seed": 5, "seconds": 6.0}
    table = report.table(figures)
    assert table.startswith("3 cells (seed 5) in 6 s; 2 broke (67%), 1 failed; the slowest took 2 s. 2 cells were not")
    lines = table.splitlines()
    assert "| matrix | 2 | 2 | 9 | 1 | 1 | 3.0e-05 | 2.5e-01 | 2.00 |" in lines
    assert "| held | 1 | 0 | 0 | 0 | 0 | 3.0e-05 | 2.5e-01 | 2.00 |" in lines
    assert "| matrix | 1 / 0 | 0 / 1 |" in lines  # energy, momentum
    failure = row_of(table, "matrix 0")
    assert failure["what"] == "energy"
    assert failure["value"] == "0.25 (50% rotation)"
    assert (failure["time step"], failure["seed"]) == ("1/240", "17")
    assert lines[-1] == "Notes of the scenes: restored (3)."
    report.draw(figures, tmp_path / "p.png")
    families = drawn[0].axes[3]
    assert [label.get_text() for label in families.get_yticklabels()] == ["held (1)", "matrix (2)"]
    assert drawn[0].axes[2].texts[0].get_text() == "1/2"


# Running


def test_a_benchmark_writes_figures_table_and_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(idle, "SCENES", {"one, in flight": idle.SCENES["one, in flight"]})
    monkeypatch.setattr(idle, "QUICK_STEPS", 60)
    out = tmp_path / "out"
    assert main(["bench", "idle", "--quick", "--quiet", "--out", str(out), "--json", str(tmp_path / "b.json")]) == 0
    figures = json.loads((tmp_path / "b.json").read_text())
    scene = figures["scenes"]["one, in flight"]
    assert 0 < scene["bare_us"] < scene["watched_us"]
    assert scene["calls_a_step"]["stepSimulation"] == 1.0
    assert figures["machine"]["fracsim"] == fracsim.__version__
    assert figures["machine"]["pybullet"] != "unknown"
    assert {path.name for path in out.iterdir()} == {f"runtime_idle.{kind}" for kind in ("json", "md", "png")}
    assert json.loads((out / "runtime_idle.json").read_text()) == figures
    assert "one, in flight" in capsys.readouterr().out


def test_an_unknown_benchmark_is_refused_by_name(capsys):
    assert main(["bench", "speed"]) == 2
    assert "latency" in capsys.readouterr().err


def test_a_missing_matplotlib_is_named_before_the_measurement(tmp_path, monkeypatch):
    def missing(*_):
        raise fracsim.MissingExtraError("matplotlib", "plot")

    monkeypatch.setattr(picture, "new_figure", missing)
    monkeypatch.setattr(idle, "measure", lambda *_: pytest.fail("measured before the fault was named"))
    with pytest.raises(fracsim.MissingExtraError, match="matplotlib"):
        run("idle", True, 0, tmp_path / "out", lambda _: None)
    assert not (tmp_path / "out").exists()


def test_the_engines_own_step_is_a_part_of_the_step_that_breaks():
    asset = fracsim.load("bunny")
    found = latency.events(asset.scaled(0.3 / asset.size), 12, 0)
    rows = np.array(found["rows"])
    assert len(rows) >= 3
    assert (rows[:, 1] > 0).all()
    assert (rows[:, 2] > 0).all()
    assert (rows[:, 1] + rows[:, 2] < rows[:, 0]).all()
    assert {"impulse", "fracture", "bodies"} <= set(found["stages"])


# The stress matrix


@pytest.mark.parametrize("seed", [161576974, 594949506, 92794863, 2140277470])
def test_pieces_that_stand_in_what_is_slow_or_spins_too_fast_gain_no_energy(seed):
    [cell] = [cell for cell in all_cells(False, 0) if cell.seed == seed]
    row = play(cell)
    assert row["broke"]
    assert row["failures"] == []


def test_a_cell_fails_only_by_what_its_twin_does_not_do():
    def side(broken=(), **residuals):
        return {"broken": dict.fromkeys(broken, ""), "residuals": residuals}

    live = side(["nan", "lost"], mass=1e-12, momentum=1e-3, energy=0.5, speed=None)
    assert judge(live, side(["lost"], momentum=1e-3, energy=0.001)) == (["nan", "energy"], ["lost", "momentum"])
    assert judge(side(mass=float("nan")), side(mass=0.0)) == (["mass"], [])


def hang_up(cell, tell):
    """What a crash of the engine does to its process."""
    tell("twin")
    tell("breaking")
    raise SystemExit(3)


def test_a_process_that_dies_fails_its_cell_and_the_next_one_is_played():
    cell = all_cells(True, 0)[0]
    player = Player(hang_up, judge)
    try:
        rows = [player.play(cell) for _ in range(2)]
    finally:
        player.close()
    for row in rows:
        assert row["failures"] == ["crash"]
        assert "exit 3" in row["live"]["broken"]["crash"]


def test_mechanics_are_those_of_a_spinning_ball():
    client = p.connect(p.DIRECT)
    try:
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.5, physicsClientId=client)
        ball = p.createMultiBody(2.0, shape, -1, (1, 0, 0), physicsClientId=client)
        p.resetBaseVelocity(ball, (0, 3, 0), (0, 0, 4), physicsClientId=client)
        now = mechanics_of(client, [ball])
    finally:
        p.disconnect(client)
    inertia = 0.4 * 2.0 * 0.5**2
    assert now.finite
    assert now.rotation_energy == pytest.approx(0.5 * inertia * 4**2)
    assert now.kinetic_energy(np.zeros(3)) == pytest.approx(0.5 * 2.0 * 9 + 0.5 * inertia * 16)
    assert now.kinetic_energy(np.array([0, 3, 0])) == pytest.approx(0.5 * inertia * 16)
    np.testing.assert_allclose(now.angular_momentum(np.zeros(3), np.zeros(3)), [0, 0, 2.0 * 3 + inertia * 4])
