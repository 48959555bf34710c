"""The shipped assets: what breaks off them is solid, exact, and where the labels say."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fracsim
from fracsim import meshes
from fracsim.common.files import header_of
from fracsim.fracture.file import FORMAT, sign
from fracsim.metrics import ari
from fracsim.simulators.diffusion import GAUGE

SAMPLES = 50


@pytest.fixture(scope="module")
def fractures(shipped):
    return [shipped.fracture(impulse) for impulse in shipped.sample_impulses(SAMPLES, 7)]


def test_sampled_impulses_break_it_and_spare_it(fractures):
    # From 0.3 to 5 times what breaks it, log-uniform: log(5) / log(5 / 0.3) = 0.57 of them, 0.07 being one sigma of 50.
    assert 0.57 - 3 * 0.07 < np.mean([fracture.broken for fracture in fractures]) < 0.57 + 3 * 0.07


def test_pieces_are_watertight_and_their_volumes_sum_to_the_whole(shipped, fractures):
    whole = trimesh.Trimesh(shipped.vertices, shipped.faces, process=False).volume
    for fracture in fractures:
        meshes = [trimesh.Trimesh(piece.vertices, piece.faces) for piece in fracture.pieces]
        assert all(mesh.is_watertight and mesh.is_winding_consistent for mesh in meshes)
        exact = [trimesh.Trimesh(p.vertices, p.faces, process=False).volume for p in fracture.pieces]
        assert sum(exact) == pytest.approx(whole, rel=1e-9)
        np.testing.assert_allclose([piece.volume for piece in fracture.pieces], exact, rtol=1e-9)


def test_mass_properties_are_those_of_the_solids_and_add_up(shipped, fractures):
    for fracture in fractures[:15]:
        for piece in fracture.pieces:
            mesh = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
            mesh.density = shipped.material.density
            assert piece.mass == pytest.approx(mesh.mass, rel=1e-9)
            np.testing.assert_allclose(piece.center_of_mass, mesh.center_mass, atol=1e-9 * shipped.size)
            scale = np.abs(mesh.moment_inertia).max()
            np.testing.assert_allclose(piece.inertia, mesh.moment_inertia, atol=1e-7 * scale)
            assert (np.linalg.eigvalsh(piece.inertia) > 0).all()
        mass = np.array([piece.mass for piece in fracture.pieces])
        centers = np.array([piece.center_of_mass for piece in fracture.pieces])
        assert mass.sum() == pytest.approx(shipped.mass, rel=1e-12)
        np.testing.assert_allclose(mass @ centers / mass.sum(), shipped.center_of_mass, atol=1e-12)


def test_the_outside_of_the_pieces_is_the_input_surface(shipped, fractures):
    area = trimesh.Trimesh(shipped.vertices, shipped.faces, process=False).area
    surface = trimesh.Trimesh(shipped.vertices, shipped.faces, process=False)
    for fracture in [fracture for fracture in fractures if fracture.broken][:6]:
        outer = [(piece.vertices, piece.faces[piece.outer]) for piece in fracture.pieces]
        total = sum(trimesh.Trimesh(v, f, process=False).area for v, f in outer)
        assert total == pytest.approx(area, rel=1e-9)
        middles = np.concatenate([v[f].mean(axis=1)[:40] for v, f in outer])
        _, distance, _ = trimesh.proximity.closest_point(surface, middles)
        assert distance.max() < 1e-9 * shipped.size


def test_vertices_lie_on_the_piece_that_their_label_names(shipped, fractures):
    for fracture in [fracture for fracture in fractures if fracture.broken][:3]:
        rows = np.random.default_rng(0).choice(len(shipped.vertices), 150, replace=False)
        distance = np.array(
            [
                trimesh.proximity.closest_point(
                    trimesh.Trimesh(piece.vertices, piece.faces, process=False), shipped.vertices[rows]
                )[1]
                for piece in fracture.pieces
            ]
        )
        on_named = distance[fracture.labels[rows], np.arange(len(rows))] < 1e-9 * shipped.size
        assert on_named.mean() >= 0.995
        # And it is no empty claim: hardly any vertex touches another piece as well.
        assert ((distance < 1e-9 * shipped.size).sum(axis=0) == 1).mean() > 0.95


def test_labels_number_the_pieces(fractures):
    for fracture in fractures:
        assert fracture.labels.min() >= 0
        assert set(np.unique(fracture.labels)) <= set(range(len(fracture.pieces)))


def test_changing_the_field_changes_the_pieces(shipped):
    broken = next(f for i in shipped.sample_impulses(50, 1) if len((f := shipped.fracture(i)).pieces) > 2)
    again = shipped.fracture_from_field(broken.udf)
    np.testing.assert_array_equal(again.labels, broken.labels)
    whole = shipped.fracture_from_field(np.full(len(shipped.vertices), shipped.cap * shipped.size))
    assert len(whole.pieces) == 1
    filled = broken.udf.copy()
    filled[np.isin(broken.labels, (0, 1))] = shipped.cap * shipped.size
    assert len(shipped.fracture_from_field(filled).pieces) < len(broken.pieces)


def test_the_learned_field_beats_the_nearest_training_impulse_on_held_out_impulses(shipped):
    figures = shipped.metadata["test"]
    assert figures["breaking"] > 500
    assert figures["ari"] > figures["ari_nearest_impulse"]
    assert figures["ari_of_the_true_field"] > 0.99


def test_the_field_agrees_with_the_simulator_on_impulses_drawn_anew(shipped):
    pairs = [
        (shipped.fracture(impulse, "simulator"), shipped.fracture(impulse, "field"))
        for impulse in shipped.sample_impulses(120, 99)
    ]
    score = np.mean([ari(truth.labels, guess.labels) for truth, guess in pairs if truth.broken])
    assert score == pytest.approx(shipped.metadata["test"]["ari"], abs=0.08)
    agree = np.mean([truth.broken == guess.broken for truth, guess in pairs])
    assert agree > 0.9


def test_convex_parts_of_different_pieces_do_not_overlap(shipped):
    import manifold3d

    fracture = next(f for i in shipped.sample_impulses(50, 2) if 2 < len((f := shipped.fracture(i)).pieces) < 9)
    solids = [
        (k, manifold3d.Manifold.hull_points(points))
        for k, piece in enumerate(fracture.pieces)
        for points, _ in piece.hulls
    ]
    gap = min(a.min_gap(b, 0.01 * shipped.size) for i, a in solids for j, b in solids if i < j)
    assert gap > 1.4e-3 * shipped.size
    kept = sum(solid.volume() for _, solid in solids) / shipped.volume
    assert 0.9 < kept < 1.25


def test_an_impulse_below_the_breaking_impulse_breaks_nothing_and_costs_no_query(shipped, monkeypatch):
    vertex = int(np.argmax(shipped.breaking_impulse))
    normal = trimesh.Trimesh(shipped.vertices, shipped.faces, process=False).vertex_normals[vertex]
    weak = fracsim.Impulse(shipped.vertices[vertex], -normal, 1e-3 * shipped.breaking_impulse.min())
    assert not shipped.may_break(weak)
    monkeypatch.setattr(type(shipped.model), "scores", lambda *_: pytest.fail("the model was asked"))
    fracture = shipped.fracture(weak)
    assert not fracture.broken
    assert (fracture.udf == shipped.cap * shipped.size).all()
    assert len(fracture.pieces) == 1
    assert fracture.pieces[0].mass == pytest.approx(shipped.mass)


def test_the_gate_never_holds_back_an_impulse_that_the_simulator_breaks(shipped):
    impacts = shipped.sample_impulses(400, 5)
    for impulses in [[impact] for impact in impacts[:200]] + [impacts[k : k + 3] for k in range(200, 398, 3)]:
        weak = [fracsim.Impulse(impact.point, impact.direction, 0.5 * impact.magnitude) for impact in impulses]
        for together in (impulses, weak):
            if shipped.fracture(together, "simulator").broken:
                assert shipped.may_break(together)


def test_copies_of_another_size_share_what_was_worked_out_once(shipped):
    shipped.fracture(shipped.sample_impulses(1, 0)[0])
    assert shipped.scaled(0.3).with_material("ice").arrays is shipped.arrays


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scale=st.floats(0.01, 100.0), seed=st.integers(0, 1000))
def test_size_and_material_change_units_only(shipped, scale, seed):
    other = shipped.scaled(scale).with_material("glass")
    assert other.mass == pytest.approx(shipped.volume * scale**3 * other.material.density)
    impulse = shipped.sample_impulses(1, seed)[0]
    severity = impulse.magnitude / (shipped.mass * GAUGE * shipped.material.critical_velocity)
    moved = other.impulse_of(severity, impulse.point * scale, impulse.direction)
    assert moved.magnitude == pytest.approx(severity * other.mass * GAUGE * other.material.critical_velocity)
    np.testing.assert_array_equal(shipped.fracture(impulse).labels, other.fracture(moved).labels)


def test_the_order_of_simultaneous_impulses_does_not_matter(shipped):
    impacts = shipped.sample_impulses(4, 3)
    forward, backward = shipped.fracture(impacts), shipped.fracture(impacts[::-1])
    np.testing.assert_array_equal(forward.labels, backward.labels)


def test_an_impulse_beyond_the_trained_severity_is_clamped_and_says_so(shipped):
    impulse = shipped.sample_impulses(1, 0)[0]
    huge = fracsim.Impulse(impulse.point, impulse.direction, impulse.magnitude * 1e6)
    fracture = shipped.fracture(huge)
    assert fracture.clamped
    assert fracture.severity > float(shipped.model.severity[0])
    assert fracture.broken


def test_a_larger_min_piece_volume_fraction_merges_small_pieces_mass_included(shipped):
    import dataclasses

    coarse = dataclasses.replace(shipped, min_piece_volume_fraction=0.1)
    for impulse in shipped.sample_impulses(20, 4):
        pieces = coarse.fracture(impulse).pieces
        assert min(piece.volume for piece in pieces) >= 0.1 * shipped.volume
        assert sum(piece.mass for piece in pieces) == pytest.approx(shipped.mass)


# The file


def test_saving_and_loading_changes_nothing(shipped, tmp_path):
    path = tmp_path / "again.frac"
    shipped.save(path)
    again = fracsim.load(path)
    assert again.metadata == shipped.metadata
    assert again.material == shipped.material
    impulse = shipped.sample_impulses(1, 6)[0]
    np.testing.assert_array_equal(again.fracture(impulse).udf, shipped.fracture(impulse).udf)
    assert [entry.name for entry in tmp_path.iterdir()] == ["again.frac"]


@pytest.mark.parametrize("length", [0, 4, 100, 5000, -1])
def test_a_truncated_asset_is_refused_by_name(shipped, tmp_path, length):
    path = tmp_path / "half.frac"
    shipped.save(path)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(fracsim.AssetError, match=r"half\.frac"):
        fracsim.load(path)


@pytest.mark.parametrize(
    ("name", "change", "fault"),
    [
        ("asset.pairs", lambda x: x + 1000, "pairs points outside"),
        ("asset.distances", lambda x: x[:, :-1].copy(), "distances do not fit"),
        ("asset.hull_sizes", lambda x: x[:-1].copy(), "convex parts"),
        ("asset.impact_field", lambda x: x * np.float32(np.nan), "not finite"),
        ("model.coordinates", lambda x: x[:-1].copy(), "vertices do not agree"),
        ("model.skip", lambda x: None, "missing or malformed"),
    ],
)
def test_an_asset_that_contradicts_itself_is_refused(tmp_path, name, change, fault):
    from safetensors.numpy import load_file, save_file

    path = tmp_path / "bent.frac"
    asset = fracsim.load("chair")
    asset.save(path)
    header = json.loads(path.read_bytes()[8 : 8 + int.from_bytes(path.read_bytes()[:8], "little")])["__metadata__"]
    tensors = load_file(path)
    changed = change(tensors.pop(name))
    if changed is not None:
        tensors[name] = changed
    save_file(tensors, path, metadata=header)
    with pytest.raises(fracsim.AssetError, match=r"bent\.frac: damaged"):
        fracsim.load(path)
    path.write_bytes(sign(path.read_bytes()))  # as if somebody's writer had made it so
    with pytest.raises(fracsim.AssetError, match=rf"bent\.frac: .*{fault}"):
        fracsim.load(path)


def test_other_faults_of_asset_files_name_the_file_and_the_way_out(tmp_path):
    with pytest.raises(fracsim.AssetError, match=r"nowhere\.frac: no such file"):
        fracsim.load(tmp_path / "nowhere.frac")
    with pytest.raises(fracsim.AssetError, match="those that ship are bunny, chair, vase"):
        fracsim.load("teapot")
    from safetensors.numpy import save_file

    save_file({"x": np.zeros(3)}, tmp_path / "other.frac")
    with pytest.raises(fracsim.AssetError, match=r"other\.frac: not a fracsim asset.*bake"):
        fracsim.load(tmp_path / "other.frac")


def test_a_direction_of_any_length_is_normalised():
    for length in (1e-200, 1.0, 1e200):
        np.testing.assert_array_equal(fracsim.Impulse((0, 0, 0), (0, -length, 0), 1.0).direction, (0, -1, 0))


def test_bad_questions_are_typed_errors(shipped):
    impulse = shipped.sample_impulses(1, 0)[0]
    with pytest.raises(fracsim.FracsimError, match="unknown predictor 'tarot'"):
        shipped.fracture(impulse, predictor="tarot")
    with pytest.raises(fracsim.FieldError, match="shape"):
        shipped.fracture_from_field(np.zeros(3))
    with pytest.raises(fracsim.FieldError, match="not finite"):
        shipped.fracture_from_field(np.full(len(shipped.vertices), np.nan))
    with pytest.raises(fracsim.MaterialError, match="glass"):
        shipped.with_material("jelly")
    with pytest.raises(fracsim.AssetError, match="scale"):
        shipped.scaled(-1.0)
    for wrong in ([(0, 0, 0), (0, 0, 0), 1.0], [(0, 0), (0, 0, 1), 1.0], [(0, 0, 0), (0, 0, 1), np.nan]):
        with pytest.raises(fracsim.ImpulseError):
            fracsim.Impulse(*wrong)


@pytest.mark.parametrize("name", ["bunny", "chair", "vase"])
def test_a_flipped_bit_is_refused_wherever_it_is(name, tmp_path):
    path = tmp_path / "flipped.frac"
    fracsim.load(name).save(path)
    data = path.read_bytes()
    header = 8 + int.from_bytes(data[:8], "little")
    rng = np.random.default_rng(0)
    places = [*rng.integers(0, len(data), 50).tolist(), *rng.integers(0, header, 30).tolist()]
    checksum = data.index(b"checksum")
    for place in [*places, *range(checksum, checksum + 24)]:
        bent = bytearray(data)
        bent[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bent)
        with pytest.raises(fracsim.AssetError, match=r"flipped\.frac: .*bake"):
            fracsim.load(path)


def test_the_checksum_is_checked_in_five_milliseconds():
    data = (Path(meshes.__file__).parent / "bunny.frac").read_bytes()
    took = []
    for _ in range(7):
        begin = time.perf_counter()
        assert sign(data) == data
        took.append(time.perf_counter() - begin)
    assert min(took) < 5e-3


def test_an_asset_of_an_earlier_format_is_refused_with_the_way_out(tmp_path):
    from safetensors.numpy import load_file, save_file

    path = tmp_path / "old.frac"
    fracsim.load("chair").save(path)
    header = header_of(path.read_bytes(), "fracsim")
    for number in (1, FORMAT - 1, FORMAT + 1, None):
        save_file(load_file(path), path, metadata={"fracsim": json.dumps({**header, "format": number})})
        with pytest.raises(
            fracsim.AssetError, match=rf"old\.frac: format {number}, this version reads {FORMAT}; bake it again with"
        ):
            fracsim.load(path)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("scale", "large"),
        ("cap", None),
        ("offset", [0, 0]),
        ("material", {"name": "ceramic"}),
        ("material", {**fracsim.Material("x", 1, 1, 1, 1, 1).to_dict(), "restitution": 5}),
        (
            "baked_from",
            {"simulator": "modal", "min_severity": "low", "typical_severity": 1.0, "driven_by_impact_field": True},
        ),
        ("metadata", []),
    ],
)
def test_a_malformed_header_is_refused_by_its_entry(tmp_path, entry, value):
    from safetensors.numpy import load_file, save

    path = tmp_path / "odd.frac"
    fracsim.load("chair").save(path)
    header = {**header_of(path.read_bytes(), "fracsim"), entry: value}
    path.write_bytes(sign(save(load_file(path), metadata={"fracsim": json.dumps(header, sort_keys=True)})))
    with pytest.raises(fracsim.AssetError, match=rf"odd\.frac: the entry {entry} of the asset is missing or malformed"):
        fracsim.load(path)


def test_the_old_name_of_a_predictor_still_works(shipped):
    impulse = shipped.sample_impulses(1, 3)[0]
    old, new = shipped.fracture(impulse, "modes"), shipped.fracture(impulse, "simulator")
    assert old.predictor == new.predictor == "simulator"
    np.testing.assert_array_equal(old.labels, new.labels)


def test_a_weak_impulse_asks_the_model_where_that_is_wanted(shipped, monkeypatch):
    weak = fracsim.Impulse(shipped.vertices[0], (0, 0, 1), 1e-3 * shipped.bearable_impulse)
    monkeypatch.setattr(type(shipped.model), "scores", lambda self, *_: np.ones(len(self.slope)))
    assert not shipped.fracture(weak).broken
    assert shipped.fracture(weak, skip_weak=False).broken


# --- pieces that break in turn


def test_a_piece_breaks_into_its_own_atoms(shipped):
    fractures = [shipped.fracture(one) for one in shipped.sample_impulses(60, 4)]
    fracture = max(fractures, key=lambda one: max(len(piece.atoms) for piece in one.pieces) if one.broken else 0)
    piece = max(fracture.pieces, key=lambda one: len(one.atoms))
    breakable = shipped.breakable_piece(piece)
    assert breakable.mass == piece.mass
    assert not breakable.unbroken().broken
    hard = [fracsim.Impulse(one.point, one.direction, 4 * one.magnitude) for one in shipped.sample_impulses(20, 8)]
    seen = 0
    for impact in hard:
        again = breakable.fracture(impact)
        labels = again.labels
        own = np.isin(shipped.arrays.vertex_atom, piece.atoms)
        assert (labels[~own] == -1).all()
        assert (labels[own] >= 0).all()
        assert sum(part.mass for part in again.pieces) == pytest.approx(piece.mass, rel=1e-9)
        assert set(np.concatenate([part.atoms for part in again.pieces])) == set(piece.atoms)
        assert again.crack_area >= 0.0
        if again.broken:
            seen += 1
            assert breakable.may_break(impact)
            assert again.crack_area > 0.0
            smaller = shipped.breakable_piece(piece).breakable_piece(again.pieces[0])
            assert smaller.mass == again.pieces[0].mass
    assert seen


def test_a_piece_of_everything_answers_as_the_asset_does(shipped):
    whole = shipped.breakable_piece(shipped.unbroken().pieces[0])
    for impact in shipped.sample_impulses(20, 6):
        # At a vertex, where both see the same place.
        near = shipped.vertices[np.linalg.norm(shipped.vertices - impact.point, axis=1).argmin()]
        impulse = fracsim.Impulse(near, impact.direction, impact.magnitude)
        np.testing.assert_array_equal(whole.fracture(impulse).labels, shipped.fracture(impulse).labels)


def test_the_field_everywhere_is_worked_out_when_asked_for(shipped):
    fracture = next(f for f in map(shipped.fracture, shipped.sample_impulses(60, 4)) if f.broken)
    assert not {"udf", "labels"} & set(vars(fracture.at_vertices))
    assert not any({"hulls", "surface"} & set(vars(piece.shape)) for piece in fracture.pieces)
    assert fracture.udf.shape == fracture.labels.shape == (shipped.vertex_count,)


@pytest.mark.parametrize("scores", [np.nan, np.inf, -1.0, "short"])
def test_scores_that_make_no_sense_are_a_field_error(shipped, monkeypatch, scores):
    count = len(shipped.arrays.pairs)
    answer = np.ones(count - 1) if scores == "short" else np.full(count, scores)
    monkeypatch.setattr(type(shipped.model), "scores", lambda *_: answer)
    hard = max(shipped.sample_impulses(20, 1), key=lambda one: one.magnitude)
    with pytest.raises(fracsim.FieldError, match=shipped.name):
        shipped.fracture(hard)


def test_a_field_that_is_no_numbers_is_refused(shipped):
    with pytest.raises(fracsim.FieldError, match="numbers"):
        shipped.fracture_from_field(["a"] * shipped.vertex_count)
