"""`fracsim evaluate`: a plan in, the thesis's tables and figures out, and nothing measured twice."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh

from fracsim.cli.main import main
from fracsim.common.errors import ModelError
from fracsim.study.plan import read_plan

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


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    trimesh.creation.torus(0.5, 0.2, major_sections=20, minor_sections=10).export(folder / "torus.obj")
    (folder / "plan.toml").write_text(PLAN)
    arguments = ["evaluate", str(folder / "plan.toml"), "--out", str(folder / "out"), "--quiet"]
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
        assert (folder / f"out/{name}.png").stat().st_size > 5000
    names = ("5_3", "5_8", "5_11", "5_12", "5_13", "5_14", "models", "training")
    assert all((folder / f"out/evaluation_{name}.md").is_file() for name in names)


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
    assert rows["field (default)", "atoms"]["ari"] > rows["MLP 704x7", "atoms"]["ari"]
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


def test_the_plan_that_the_results_are_of_is_one():
    plan = read_plan(ROOT / "benchmarks" / "evaluation.toml")
    assert all(Path(mesh.file).is_file() for mesh in plan.meshes)
    assert len(plan.published) == 40
