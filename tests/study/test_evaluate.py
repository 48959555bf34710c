"""`fracsim evaluate`: a plan in, the thesis's tables and figures out, and nothing measured twice."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from fracsim.cli.main import main
from fracsim.common.errors import ModelError
from fracsim.segmentation import METHODS
from fracsim.solids.surface import Surface
from fracsim.study.evaluate import evaluate
from fracsim.study.plan import read_plan
from fracsim.study.report_figures import accuracy_chart, break_curves, correlation_chart, picture_grid
from fracsim.study.work_folder import read_pictured, read_result, result_path, write_result

ROOT = Path(__file__).parents[2]
PLAN = """
seed = 1
simulator = { cells = 600, modes = 4 }

[[meshes]]
name = "torus"
file = "torus.obj"
samples = 800
tested = 12
slow = 2
timed = 1

[[models]]
name = "true field"
kind = "simulator"

[[models]]
name = "simulator, precomputed"
kind = "precomputed"

[[models]]
name = "nearest impulse"
kind = "nearest"

[[models]]
name = "field (default)"
kind = "field"
options = { eigenfunctions = 16 }
training = { steps = 150, batch = 128, rate = 3e-3 }

[[models]]
name = "MLP 704x7"
kind = "mlp"
options = { width = 16, layers = 2 }
training = { steps = 5, batch = 64 }

[[published]]
mesh = "torus"
model = "MLP 704x7"
segmentation = "watershed"
segment_ms = 23.66
predict_ms = 1.46
ari = 0.855
accepted = 0.85
"""


TWO_SIDES = """
import fracsim


def two_sides(graph, udf, height):
    return (graph.vertices[:, 2] > height).astype(int)


fracsim.register_segmentation("two sides", two_sides, 0.0)
"""


@pytest.fixture(scope="module")
def module_of_a_user(tmp_path_factory):
    """The name of a module that registers a segmentation: the vertices above a height, and those below."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "two_sides.py").write_text(TWO_SIDES)
    sys.path.append(str(folder))
    yield "two_sides"
    sys.path.remove(str(folder))
    del sys.modules["two_sides"], METHODS["two sides"]


@pytest.fixture(scope="module")
def planned(tmp_path_factory, module_of_a_user):
    folder = tmp_path_factory.mktemp("plan")
    trimesh.creation.torus(0.5, 0.2, major_sections=20, minor_sections=10).export(folder / "torus.obj")
    (folder / "plan.toml").write_text(PLAN)
    arguments = [
        "--import",
        module_of_a_user,
        "evaluate",
        str(folder / "plan.toml"),
        "--out",
        str(folder / "out"),
        "--quiet",
    ]
    assert main([*arguments, "--json", str(folder / "figures.json")]) == 0
    return folder, arguments


def test_it_writes_tables_a_chart_and_figures_with_every_row_in_them(planned):
    folder, _ = planned
    found = json.loads((folder / "figures.json").read_text())
    assert found == {k: v for k, v in json.loads((folder / "out/accuracy.json").read_text()).items() if k != "command"}
    assert found["missing"] == []
    rows = {(row["model"], row["segmentation"]): row for row in found["rows"]}
    for segmentation in ("watershed", "region_growing", "hierarchical", "kmeans", "felzenszwalb", "atoms"):
        for model in ("true field", "nearest impulse", "field (default)", "MLP 704x7"):
            many = segmentation == "atoms" and model != "MLP 704x7"
            assert rows[model, segmentation]["impulses"] == (12 if many else 2)
    table = (folder / "out/evaluation_5_10.md").read_text()
    assert "MLP 704x7, the thesis" in table
    assert all(f"| {model} |" in table for model in ("true field", "field (default)", "MLP 704x7"))
    for name in ("accuracy", "evaluation_5_5", "evaluation_breaks", "evaluation_grid_torus_field"):
        assert (folder / f"out/{name}.png").read_bytes().startswith(b"\x89PNG")
    names = ("5_3", "5_8", "5_11", "5_12", "5_13", "5_14", "models", "training")
    assert all((folder / f"out/evaluation_{name}.md").is_file() for name in names)


def test_a_registered_segmentation_has_rows_tables_and_pictures(planned):
    folder, _ = planned
    found = json.loads((folder / "figures.json").read_text())
    rows = [row for row in found["rows"] if row["segmentation"] == "two sides"]
    assert {row["model"] for row in rows} == {row["model"] for row in found["rows"]}
    assert {row["parameter"] for row in rows} == {0.0}
    assert len({row["ari"] for row in rows}) == 1  # it does not look at the field
    assert "reference_ms" not in rows[0]
    assert "| field (default) | two sides |" in (folder / "out/evaluation_5_10.md").read_text()
    plan = read_plan(folder / "plan.toml")
    pictured = read_pictured(result_path(plan, plan.meshes[0], plan.models[0], folder / "out" / "work"))
    assert np.unique(pictured["two sides"]).tolist() == [0, 1]


def test_a_segmentation_registered_later_is_measured_too(planned):
    folder, _ = planned
    plan = read_plan(folder / "plan.toml")
    truth = next(model for model in plan.models if model.kind == "simulator")
    path = result_path(plan, plan.meshes[0], truth, folder / "out" / "work")
    whole = path.read_bytes()
    result = read_result(path)
    result["rows"] = [row for row in result["rows"] if row["segmentation"] != "two sides"]
    write_result(path, result)
    rows = evaluate(plan, folder / "out" / "work")["rows"]
    assert [row["model"] for row in rows if row["segmentation"] == "two sides"].count("true field") == 1
    path.write_bytes(whole)


def test_the_chart_of_time_and_error_has_a_point_for_every_row(planned):
    found = json.loads((planned[0] / "figures.json").read_text())
    measured = [row for row in found["rows"] if row["kind"] != "simulator"]
    published = [{**row, "model": "MLP 704x7, the thesis"} for row in found["plan"]["published"]]
    figure = accuracy_chart(found["rows"], published)
    axes = figure.axes[0]
    assert axes.get_ylabel() == "1 − ARI, test split"
    points = [line.get_xydata()[0] for line in axes.lines if len(line.get_xdata()) == 1]
    assert len(points) == len(measured) + len(published)
    perceptron = next(row for row in measured if row["segmentation"] == "atoms" and row["kind"] == "mlp")
    spent = perceptron["predict_ms"]["median"] + perceptron["segment_ms"]["median"]
    assert np.isclose(points, (spent, 1 - perceptron["ari"])).all(axis=1).any()
    assert np.isclose(points, (23.66 + 1.46, 1 - 0.855)).all(axis=1).any()
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels >= {row["model"] for row in measured} | {"torus"}


def test_the_chart_of_breaks_follows_the_rows(planned):
    rows = json.loads((planned[0] / "figures.json").read_text())["rows"]
    axes = break_curves(rows).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("severity / threshold", "share predicted to break")
    row = next(row for row in rows if row["model"] == "nearest impulse" and row["segmentation"] == "atoms")
    curve = np.array([np.nan if share is None else share for share in row["breaks"]["curve"]])
    lines = [line.get_ydata() for line in axes.lines if len(line.get_ydata()) == len(curve)]
    assert any(np.array_equal(line, curve, equal_nan=True) for line in lines)


def test_the_chart_of_errors_has_a_point_for_every_impulse(planned):
    rows = json.loads((planned[0] / "figures.json").read_text())["rows"]
    figure = correlation_chart(rows, ("field (default)", "nearest impulse"))
    assert [axes.get_title().split("\n")[0] for axes in figure.axes] == ["nearest impulse", "field (default)"]
    for axes, name in zip(figure.axes, ("nearest impulse", "field (default)"), strict=True):
        row = next(row for row in rows if row["model"] == name and row["segmentation"] == "watershed")
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), row["amae_and_bc"])


def test_a_sheet_of_pictures_gives_every_piece_a_colour():
    mesh = trimesh.creation.icosphere(2, radius=0.5)
    surface = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), 1.0, np.zeros(3), "ball")
    upper = (surface.vertices[:, 2] > 0).astype(np.int64)
    udf = np.abs(surface.vertices[:, 2])
    pictured = {"true": udf[None], "predicted": udf[None], "labels": upper[None], "one piece": 0 * upper[None]}
    figure = picture_grid(surface, pictured, ["one piece"], "ball")
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "true field",
        "predicted field",
        "true pieces",
        "one piece",
    ]
    hues = []
    for axes in figure.axes:
        colour = axes.collections[0].get_facecolor()[:, :3]
        hues.append(len(np.unique(np.round(colour / colour.max(axis=1, keepdims=True), 6), axis=0)))
    assert hues[0] == hues[1] > 2
    assert hues[2:] == [2, 1]


def test_rows_are_as_good_as_they_must_be(planned):
    found = json.loads((planned[0] / "figures.json").read_text())
    rows = {(row["model"], row["segmentation"]): row for row in found["rows"]}
    assert rows["true field", "atoms"]["ari"] > 0.95
    assert rows["true field", "atoms"]["amae"] == 0
    exact = rows["simulator, precomputed", "none (labels predicted)"]
    assert exact["ari"] == 1.0
    assert exact["accepted"] == 1.0
    assert exact["breaks"]["balanced_accuracy"] == 1.0
    below, above = exact["breaks"]["curve"][0], exact["breaks"]["curve"][-1]
    assert (below, above) == (0.0, 1.0)
    learned = rows["field (default)", "atoms"]
    assert learned["ari"] > 0.85
    assert learned["ari"] > rows["nearest impulse", "atoms"]["ari"] + 0.05
    assert learned["breaks"]["balanced_accuracy"] > 0.9
    assert rows["MLP 704x7", "atoms"]["ari"] < 0.6  # after five steps it has learned nothing
    assert rows["MLP 704x7", "watershed"]["validation"]["amae"] > 0


def test_going_on_measures_nothing_twice_and_a_changed_model_anew(planned, monkeypatch):
    folder, arguments = planned
    before = (folder / "out/accuracy.json").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr("fracsim.study.mesh_bench.MeshBench.measure", lambda *_: pytest.fail("measured again"))
        assert main(arguments) == 0
    assert (folder / "out/accuracy.json").read_bytes() == before
    asked = []

    def measure(self, model):
        asked.append(model.name)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("fracsim.study.mesh_bench.MeshBench.measure", measure)
        (folder / "plan.toml").write_text(PLAN.replace("width = 16", "width = 8"))
        assert main(arguments) == 130
    (folder / "plan.toml").write_text(PLAN)
    assert asked == ["MLP 704x7"]


def test_bad_plans_are_refused_by_name(tmp_path, capsys):
    path = tmp_path / "plan.toml"
    for text, fault in (
        ("seed = [", "not a plan"),
        ("seed = 1", "'meshes'"),
        (PLAN.replace('kind = "mlp"', 'kind = "oracle"'), "unknown kind 'oracle'"),
        (PLAN.replace("slow = 2", "swift = 4"), "swift"),
        (PLAN.replace('name = "true field"', 'name = "MLP 704x7"'), "a name of its own"),
        (PLAN.replace('kind = "simulator"', 'kind = "simulator"\nmeshes = ["cube"]'), "no mesh 'cube'"),
    ):
        path.write_text(text)
        assert main(["evaluate", str(path), "--out", str(tmp_path / "out")]) == 2
        message = capsys.readouterr().err
        assert fault in message
        assert "plan.toml" in message
    with pytest.raises(ModelError, match="no such file"):
        read_plan(tmp_path / "none.toml")


def test_the_plan_of_the_committed_results_can_be_read():
    plan = read_plan(ROOT / "benchmarks" / "evaluation.toml")
    assert all(Path(mesh.file).is_file() for mesh in plan.meshes)
    assert len(plan.published) == 40
