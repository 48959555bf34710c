"""Baking a mesh of one's own: it works, is repeatable, and refuses what it cannot bake, leaving no file."""

from __future__ import annotations

import dataclasses
import json

import matplotlib.image
import numpy as np
import pytest
import trimesh

import fracsim
from fracsim.cli.main import main
from fracsim.data.impacts import CONTACTS
from fracsim.data.samples import sample
from fracsim.fracture.arrays import AssetArrays
from fracsim.simulators.modal import ModalSimulator
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.surface import read_surface


def test_a_users_own_mesh_bakes_and_breaks(slab, slab_mesh):
    assert slab.size == pytest.approx(0.4)
    assert slab.mass == pytest.approx(0.4 * 0.2 * 0.1 * 2480)
    np.testing.assert_allclose(slab.center_of_mass, (1.0, -2.0, 0.5), atol=1e-9)
    np.testing.assert_allclose(slab.vertices, slab_mesh.vertices, atol=1e-12)
    fractures = [slab.fracture(impulse) for impulse in slab.sample_impulses(30, 0)]
    assert max(len(fracture.pieces) for fracture in fractures) >= 2
    assert min(len(fracture.pieces) for fracture in fractures) == 1
    piece = max(fractures, key=lambda f: len(f.pieces)).pieces[0]
    assert trimesh.Trimesh(piece.vertices, piece.faces).is_watertight


def test_its_metadata_says_how_long_each_stage_took_and_how_good_it_is(slab):
    seconds = slab.metadata["seconds"]
    assert seconds["total"] == pytest.approx(sum(v for k, v in seconds.items() if k != "total"))
    assert {"solid", "modes", "samples", "training", "convex", "clipping"} <= set(seconds)
    assert {"ari", "ari_nearest_impulse", "balanced_accuracy"} <= set(slab.metadata["test"])
    json.dumps(slab.metadata)


def test_a_mesh_of_eight_vertices_is_refined_until_it_can_hold_a_field(crate):
    assert len(crate.vertices) > 500
    assert crate.volume == pytest.approx(0.006, rel=1e-12)
    box = trimesh.creation.box((0.3, 0.2, 0.1))
    corners = [np.abs(crate.vertices - corner).sum(axis=1).min() for corner in box.vertices]
    assert max(corners) < 1e-12
    assert crate.metadata["test"]["ari_of_the_true_field"] > 0.95


def test_one_seed_gives_one_asset(slab, slab_mesh, quick):
    again = fracsim.bake(slab_mesh, material="glass", seed=3, options=quick)
    for name in AssetArrays.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(slab.arrays, name), getattr(again.arrays, name))
    for mine, other in zip(vars(slab.model).values(), vars(again.model).values(), strict=True):
        np.testing.assert_array_equal(mine, other)


@pytest.fixture(scope="module")
def samples(slab):
    surface = read_surface(trimesh.Trimesh(slab.vertices, slab.faces, process=False))
    return surface, sample(
        ModalSimulator.build(surface, SimulatorOptions(cells=800, modes=5), np.random.default_rng(0)), 4000, 0
    )


def test_samples_break_exactly_from_their_own_threshold_on(samples):
    _, drawn = samples
    np.testing.assert_array_equal(drawn.labels.any(axis=1), drawn.ratio >= 1)


def test_samples_are_uniform_over_the_area_and_a_share_has_several_contacts(samples):
    surface, drawn = samples
    single = (drawn.severities > 0).sum(axis=1) == 1
    assert 0.2 < 1 - single.mean() < 0.3
    area = surface.trimesh.area_faces / surface.trimesh.area
    octant = (surface.trimesh.triangles_center > 0) @ [4, 2, 1]
    expected = np.bincount(octant, area, minlength=8)
    found = np.bincount(octant[drawn.faces[single, 0]], minlength=8) / single.sum()
    np.testing.assert_allclose(found, expected, atol=4 * np.sqrt(0.125 / single.sum()))
    assert drawn.severities.shape[1] == CONTACTS
    np.testing.assert_allclose(np.linalg.norm(drawn.directions, axis=2), 1.0)


def test_splits_are_disjoint_and_of_the_stated_shares(samples):
    _, drawn = samples
    assert np.bincount(drawn.split).tolist() == [3060, 340, 600]


def test_a_simulator_may_be_named_beside_the_options(slab_mesh, quick, monkeypatch):
    monkeypatch.setattr("fracsim.data.samples.BLOCK", 100)  # samples, so that no more than needed are drawn
    few = dataclasses.replace(quick, samples=500, cells=50, model=dataclasses.replace(quick.model, response=True))
    asset = fracsim.bake(slab_mesh, simulator="structural", options=few)
    named = {asset.baked_from.simulator, asset.metadata["simulator"], asset.metadata["options"]["simulator"]}
    assert named == {"structural"}
    assert asset.metadata["simulator_options"]["cells"] == 50
    assert asset.severity_kind == "force"
    assert (asset.arrays.compliance > 0).all()
    json.dumps(asset.metadata)


# Refusals


def write(path, vertices, faces):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")


def box():
    mesh = trimesh.creation.box()
    return np.array(mesh.vertices), np.array(mesh.faces)


def two_boxes():
    vertices, faces = box()
    return np.vstack([vertices, vertices + 3]), np.vstack([faces, faces + 8])


def with_nan():
    vertices, faces = box()
    vertices[3, 1] = np.nan
    return vertices, faces


BAD = {
    "open": (lambda: (box()[0], box()[1][:-1]), "not watertight"),
    "two": (two_boxes, "2 components"),
    "nan": (with_nan, "not finite"),
    "empty": (lambda: (np.zeros((0, 3)), np.zeros((0, 3), int)), "empty mesh|cannot be read"),
    "flat": (lambda: (box()[0] * [1, 1, 0], box()[1]), "no volume|degenerate|not watertight"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mesh_that_cannot_be_baked_is_refused_by_name_and_writes_nothing(name, tmp_path, capsys):
    make, fault = BAD[name]
    mesh, out, figures = tmp_path / f"{name}.obj", tmp_path / "b.frac", tmp_path / "r.json"
    write(mesh, *make())
    with pytest.raises(fracsim.MeshError, match=f"{name}.obj.*({fault})"):
        fracsim.bake(mesh)
    assert main(["bake", str(mesh), "--out", str(out), "--json", str(figures)]) == 2
    assert f"{name}.obj" in capsys.readouterr().err
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [mesh.name]


def test_a_missing_mesh_a_missing_folder_and_a_wrong_material_end_with_code_2(tmp_path, capsys):
    mesh = tmp_path / "box.obj"
    write(mesh, *box())
    assert main(["bake", str(tmp_path / "none.obj")]) == 2
    assert "none.obj: no such file" in capsys.readouterr().err
    assert main(["bake", str(mesh), "--out", str(tmp_path / "no" / "b.frac")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert main(["bake", str(mesh), "--material", "jelly", "--out", str(tmp_path / "b.frac")]) == 2
    assert "jelly" in capsys.readouterr().err
    assert [entry.name for entry in tmp_path.iterdir()] == ["box.obj"]


def test_options_that_cannot_work_and_a_folder_for_a_file_are_refused_before_the_work(tmp_path, capsys):
    mesh = tmp_path / "box.obj"
    write(mesh, *box())
    for option, value in (("--steps", "0"), ("--cells", "0"), ("--modes", "-1"), ("--samples", "5")):
        assert main(["bake", str(mesh), option, value, "--out", str(tmp_path / "b.frac")]) == 2
        assert "at least" in capsys.readouterr().err
    assert main(["bake", str(mesh), "--out", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err


def test_an_interrupted_bake_leaves_no_file(tmp_path, monkeypatch, capsys):
    mesh = tmp_path / "box.obj"
    write(mesh, *box())

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("fracsim.simulators.modal.cut_lattice", interrupt)
    assert main(["bake", str(mesh), "--out", str(tmp_path / "b.frac"), "--quiet"]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert [entry.name for entry in tmp_path.iterdir()] == ["box.obj"]


def test_too_few_modes_to_part_anything_is_a_bake_error(slab_mesh, quick):
    with pytest.raises(fracsim.BakeError, match="no fracture mode parts it"):
        fracsim.bake(slab_mesh, options=dataclasses.replace(quick, modes=0))


# The rest of the command line


def test_the_fracture_command_writes_the_pieces_and_its_figures(slab, tmp_path, capsys):
    asset = tmp_path / "slab.frac"
    slab.save(asset)
    code = main(
        ["fracture", str(asset), "--seed", "4", "--out", str(tmp_path / "pieces"), "--json", str(tmp_path / "f.json")]
    )
    assert code == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    files = sorted((tmp_path / "pieces").iterdir())
    assert len(files) == len(figures["pieces"])
    total = sum(trimesh.load(path, process=False).volume for path in files)
    assert total == pytest.approx(slab.volume, rel=1e-6)
    assert "kg" in capsys.readouterr().out


def test_the_info_command_reads_any_asset_and_refuses_what_is_none(slab, tmp_path, capsys):
    assert main(["info", "bunny", "--json", str(tmp_path / "i.json")]) == 0
    assert json.loads((tmp_path / "i.json").read_text())["name"] == "bunny"
    (tmp_path / "junk.frac").write_bytes(b"junk" * 100)
    assert main(["info", str(tmp_path / "junk.frac")]) == 2
    assert "junk.frac" in capsys.readouterr().err
    assert main(["fracture", "bunny", "--magnitude", "3"]) == 2
    assert "together" in capsys.readouterr().err


def test_the_view_command_draws_how_an_asset_breaks(tmp_path, capsys):
    out, figures = tmp_path / "v.png", tmp_path / "v.json"
    assert main(["view", "chair", "--scale", "0.3", "--count", "2", "--out", str(out), "--json", str(figures)]) == 0
    impacts = json.loads(figures.read_text())["impacts"]
    assert 2 <= impacts[0]["pieces"] < impacts[1]["pieces"]
    pixels = matplotlib.image.imread(out)
    assert pixels.shape[0] > 600
    for column in np.array_split(pixels, 4, axis=1):
        assert (column[60:, :, :3].std(axis=2) > 0.05).mean() > 0.02  # something in colour in each
    assert main(["view", "chair", "--magnitude", "3", "--out", str(out)]) == 2
    assert "together" in capsys.readouterr().err
    assert main(["view", "chair", "--count", "0", "--out", str(out)]) == 2
    assert main(["view", "chair", "--out", str(tmp_path)]) == 2
