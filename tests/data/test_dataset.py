"""Samples: drawn without favour, answered by the simulator, the same whoever makes them, and safe in their file."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, replace

import h5py
import numpy as np
import pytest
import trimesh
from fracture_samples import SMALL, bar_bell, same
from matplotlib.colors import rgb_to_hsv
from matplotlib.image import imread
from scipy.stats import chisquare, kstest

import fracsim
from fracsim.cli.main import main
from fracsim.common.errors import BakeError, DatasetError
from fracsim.data.dataset import Dataset
from fracsim.data.impacts import CONTACTS, KINDS, draw_impacts
from fracsim.data.samples import BLOCK, sample, sample_block
from fracsim.data.workers import run_blocks
from fracsim.data.writing import make_dataset, regenerate
from fracsim.fracture.rule import separated
from fracsim.geometry.sampling import CONE, SurfacePoints
from fracsim.simulators import SIMULATORS
from fracsim.simulators.base import Impacts, Response
from fracsim.simulators.registry import SimulatorOptions, make_simulator
from fracsim.solids.cut import cut_lattice
from fracsim.solids.surface import read_surface, refine
from fracsim.solids.walls import facing_vertices


@pytest.fixture(scope="module")
def surface():
    return read_surface(bar_bell())


@pytest.fixture(scope="module")
def simulator(surface):
    return make_simulator(surface, SMALL, 0)


@pytest.fixture(scope="module")
def made(surface, tmp_path_factory):
    path = tmp_path_factory.mktemp("dataset") / "d.h5"
    make_dataset(path, surface, 1000, 3, SMALL)
    return path


@pytest.fixture
def copy(made, tmp_path):
    path = tmp_path / "d.h5"
    path.write_bytes(made.read_bytes())
    return path


# Drawing


def test_single_impacts_are_uniform_over_the_area_and_within_the_cone(surface):
    impacts, kind = draw_impacts(surface, 40000, np.random.default_rng(0))
    single = kind == 0
    points = SurfacePoints(surface.vertices, surface.faces)
    hits = np.bincount(impacts.faces[single, 0], minlength=len(surface.faces))
    assert chisquare(hits, points.share * single.sum()).pvalue > 1e-3
    cosine = -np.einsum("ni,ni->n", impacts.directions[single, 0], points.normals[impacts.faces[single, 0]])
    # Uniform over a spherical cap: the cosine is uniform.
    assert kstest(cosine, "uniform", (np.cos(CONE), 1 - np.cos(CONE))).pvalue > 1e-3


def test_a_quarter_act_at_2_to_6_places_in_every_way_there_is(surface):
    impacts, kind = draw_impacts(surface, 8000, np.random.default_rng(1))
    contacts = (impacts.severities > 0).sum(axis=1)
    assert (contacts[kind == 0] == 1).all()
    assert ((contacts[kind > 0] >= 2) & (contacts[kind > 0] <= CONTACTS)).all()
    assert 0.23 < (kind > 0).mean() < 0.27
    assert (np.bincount(kind, minlength=len(KINDS))[1:] > 8000 * 0.05).all()
    np.testing.assert_allclose(impacts.severities.sum(axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(impacts.directions, axis=2), 1.0)


def test_a_grip_squeezes_and_a_landing_pushes_one_way(surface):
    impacts, kind = draw_impacts(surface, 4000, np.random.default_rng(2))
    push = impacts.directions * impacts.severities[:, :, None]
    net = np.linalg.norm(push.sum(axis=1), axis=1)
    assert (net[kind == KINDS.index("grip")] < np.sin(np.deg2rad(10)) + 1e-9).all()
    for one_way in ("landing", "ring"):
        assert (net[kind == KINDS.index(one_way)] > np.cos(np.deg2rad(20))).all()
    points = SurfacePoints(surface.vertices, surface.faces)
    rows = kind == KINDS.index("grip")
    where = points.at(impacts.faces[rows, :2].ravel(), impacts.barycentric[rows, :2].reshape(-1, 3)).reshape(-1, 2, 3)
    inward = -points.normals[impacts.faces[rows, 0]]
    arm = where[:, 1] - where[:, 0]
    beside = np.linalg.norm(arm - np.einsum("ni,ni->n", arm, inward)[:, None] * inward, axis=1)
    assert np.quantile(beside, 0.9) < 0.1
    facing = np.einsum("ni,ni->n", points.normals[impacts.faces[rows, 0]], points.normals[impacts.faces[rows, 1]])
    assert (facing < -0.5).mean() > 0.95


def contact_points(surface, impacts, rows):
    points = SurfacePoints(surface.vertices, surface.faces)
    where = points.at(impacts.faces[rows].ravel(), impacts.barycentric[rows].reshape(-1, 3))
    return where.reshape(-1, CONTACTS, 3), impacts.severities[rows] > 0


def test_a_landing_is_on_the_lowest_points_and_a_ring_is_round(surface):
    impacts, kind = draw_impacts(surface, 6000, np.random.default_rng(3))
    where, there = contact_points(surface, impacts, kind == KINDS.index("landing"))
    push = (impacts.directions * impacts.severities[:, :, None]).sum(axis=1)[kind == KINDS.index("landing")]
    push /= np.linalg.norm(push, axis=1)[:, None]
    height = np.einsum("nki,ni->nk", where, push) - (surface.vertices @ push.T).min(axis=0)[:, None]
    assert np.quantile(height[there], 0.9) < 0.15
    where, there = contact_points(surface, impacts, kind == KINDS.index("ring"))
    count = there.sum(axis=1, keepdims=True)
    middle = (where * there[:, :, None]).sum(axis=1) / count
    reach = np.linalg.norm(where - middle[:, None], axis=2)
    mean = (reach * there).sum(axis=1) / count[:, 0]
    assert 0.03 < np.median(mean) < 0.2
    spread = np.sqrt((((reach - mean[:, None]) ** 2) * there).sum(axis=1) / count[:, 0])
    assert np.median(spread / mean) < 0.35


@pytest.mark.parametrize("shape", ["plate", "bell"])
def test_every_contact_pushes(surface, shape):
    body = surface if shape == "bell" else refine(read_surface(trimesh.creation.box((1.0, 1.0, 0.05))))
    impacts, _ = draw_impacts(body, 4000, np.random.default_rng(4))
    points = SurfacePoints(body.vertices, body.faces)
    outward = np.einsum("nki,nki->nk", impacts.directions, points.normals[impacts.faces])
    assert (outward[impacts.severities > 0] < 0).all()


def test_severity_is_log_uniform_about_the_threshold_and_nothing_is_rejected(simulator):
    drawn = sample(simulator, 4000, 0)
    assert len(drawn) == 4000
    assert kstest(np.log(drawn.ratio), "uniform", (np.log(0.3), np.log(5 / 0.3))).pvalue > 1e-3
    np.testing.assert_array_equal(drawn.labels.any(axis=1), drawn.ratio >= 1)
    parted = separated(drawn.labels, simulator.interfaces.pairs)
    assert (drawn.broken | ~parted).all()  # nothing comes apart where nothing broke
    assert np.bincount(drawn.split).tolist() == [3060, 340, 600]
    assert (drawn.fold[drawn.split == 2] == -1).all()
    assert np.bincount(drawn.fold[drawn.split != 2]).tolist() == [680] * 5


def test_a_longer_draw_begins_with_the_shorter_one(simulator):
    same(sample(simulator, 500, 7), sample(simulator, 900, 7).take(slice(500)))


# The same bits whoever makes them


def test_workers_do_not_change_a_bit(simulator):
    alone, together = (list(run_blocks(sample_block, simulator, 5, [0, 1, 2], workers)) for workers in (1, 2))
    for one, other in zip(alone, together, strict=True):
        same(one, other)


def test_wrong_workers_and_backends_are_refused(simulator, surface, tmp_path):
    for wrong in ({"workers": 0}, {"backend": "slurm"}, {"seed": 1.5}, {"seed": -1}):
        with pytest.raises(DatasetError):
            make_dataset(tmp_path / "d.h5", surface, **{"total": 10, "options": SMALL, **wrong})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(DatasetError, match="workers must be at least 1"):
        sample(simulator, 10, 0, workers=0)
    with pytest.raises(DatasetError, match="unknown backend 'slurm'"):
        sample(simulator, 10, 0, backend="slurm")


# The file


def test_a_file_says_what_it_is_and_answers_again(made, surface):
    with Dataset(made) as dataset:
        drawn = dataset.samples()
        assert len(drawn) == len(dataset) == 1000
        same(drawn, sample(dataset.simulator, 1000, 3))
        same(drawn, sample(make_simulator(surface, SMALL, 3), 1000, 3))
        np.testing.assert_array_equal(dataset.surface.vertices, surface.vertices)
        np.testing.assert_array_equal(dataset.links, facing_vertices(surface))
        assert dataset.header["simulator"] == {
            "name": "modal",
            "cells": 500,
            "modes": 4,
            "min_piece_volume_fraction": 1e-3,
        }
        whole = drawn.take(~drawn.labels.any(axis=1))
        np.testing.assert_allclose(dataset.fields(whole.labels[:3]), dataset.header["cap"], rtol=1e-3)
        broken = dataset.fields(drawn.take(drawn.labels.any(axis=1)).labels[:3])
        assert broken.shape[1] == len(surface.vertices) + len(surface.trimesh.edges_unique)
        assert (broken.min(axis=1) < 0.05).all()


def test_appending_gives_what_making_at_once_gives(copy, surface, tmp_path):
    make_dataset(copy, surface, 1300, 3, SMALL)
    make_dataset(tmp_path / "once.h5", surface, 1300, 3, SMALL, workers=2)
    with Dataset(copy) as grown, Dataset(tmp_path / "once.h5") as once:
        same(grown.samples(), once.samples())


def test_a_dataset_is_made_again_from_its_header_alone(made, tmp_path):
    regenerate(made, tmp_path / "again.h5")
    with Dataset(made) as old, Dataset(tmp_path / "again.h5") as new:
        same(old.samples(), new.samples())
        assert old.header == new.header
    with pytest.raises(DatasetError, match="exists already"):
        regenerate(made, tmp_path / "again.h5")


def counted(monkeypatch):
    """Which blocks are made."""
    made = []

    def job(simulator, seed, block):
        made.append(block)
        return sample_block(simulator, seed, block)

    monkeypatch.setattr("fracsim.data.writing.sample_block", job)
    return made


def test_what_is_there_is_not_made_again(copy, surface, monkeypatch):
    made = counted(monkeypatch)
    make_dataset(copy, surface, 1000, 3, SMALL)
    assert made == []
    make_dataset(copy, surface, 1300, 3, SMALL)
    assert made == [2, 3]
    damage(copy, "ratio", 1)
    make_dataset(copy, surface, 1300, 3, SMALL)
    assert made == [2, 3, 1]


def test_asking_for_less_takes_nothing_away_even_from_a_damaged_file(copy, made, surface):
    make_dataset(copy, surface, 500, 3, SMALL)
    damage(copy, "ratio", 0)
    make_dataset(copy, surface, 500, 3, SMALL)
    with Dataset(made) as old, Dataset(copy) as new:
        same(old.samples(), new.samples())


def test_two_processes_do_not_make_one_file(tmp_path, surface):
    path = tmp_path / "d.h5"
    writer = start_writer(path, 0.5)
    assert writer.stdout.readline()
    with pytest.raises(DatasetError, match="another process is writing it"):
        make_dataset(path, surface, 4000, 3, SMALL)
    writer.kill()
    writer.wait()
    make_dataset(path, surface, 1200, 3, SMALL)


def test_a_file_drawn_by_other_rules_is_read_but_not_gone_on_with(copy, surface, tmp_path):
    with h5py.File(copy, "r+") as file:
        header = json.loads(file.attrs["header"])
        header["sampling"]["severity"] = [1.0, 2.0]
        file.attrs["header"] = json.dumps(header)
    with Dataset(copy) as dataset:
        assert len(dataset.samples()) == 1000
    with pytest.raises(DatasetError, match="by the rules of fracsim"):
        make_dataset(copy, surface, 1400, 3, SMALL)
    with pytest.raises(DatasetError, match="by the rules of fracsim"):
        regenerate(copy, tmp_path / "again.h5")


def test_damage_outside_the_samples_is_named_and_owned_up_to(copy, surface):
    with h5py.File(copy, "r") as file:
        info = file["interfaces/distances"].id.get_chunk_info(0)
    content = bytearray(copy.read_bytes())
    content[info.byte_offset + info.size // 2] ^= 255
    copy.write_bytes(content)
    with Dataset(copy) as dataset:
        assert dataset.damage() == [(-1, "/interfaces/distances")]
        assert len(dataset.samples()) == 1000
        with pytest.raises(DatasetError, match=r"d\.h5: damaged"):
            dataset.fields(dataset.samples().labels[:1])
    with pytest.raises(DatasetError, match="/interfaces/distances is damaged, which cannot be mended"):
        make_dataset(copy, surface, 1400, 3, SMALL)


def test_flipped_bytes_never_raise_anything_but_a_dataset_error(copy):
    content = copy.read_bytes()
    rng = np.random.default_rng(0)
    for where in rng.integers(0, len(content), 60):
        spoilt = bytearray(content)
        spoilt[where] ^= 255
        copy.write_bytes(spoilt)
        with contextlib.suppress(DatasetError), Dataset(copy) as dataset:
            dataset.damage()
            dataset.fields(dataset.samples(skip_damaged=True).labels[:1])
            assert dataset.simulator is not None


def test_another_mesh_other_options_or_another_seed_are_refused(copy, surface):
    before = copy.read_bytes()
    with pytest.raises(DatasetError, match="was made from seed 3"):
        make_dataset(copy, surface, 1000, 4, SMALL)
    with pytest.raises(DatasetError, match="modes 4"):
        make_dataset(copy, surface, 1000, 3, replace(SMALL, modes=5))
    with pytest.raises(DatasetError, match="another surface"):
        make_dataset(copy, read_surface(trimesh.creation.icosphere(2)), 1000, 3, SMALL)
    assert copy.read_bytes() == before


def damage(path, name, block):
    """Flip bytes in the middle of a chunk."""
    with h5py.File(path, "r") as file:
        data = file["samples"][name]
        info = data.id.get_chunk_info_by_coord((block * BLOCK, *[0] * (data.ndim - 1)))
    content = bytearray(path.read_bytes())
    middle = info.byte_offset + info.size // 2
    content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
    path.write_bytes(content)


def test_a_damaged_chunk_is_named_the_rest_is_read_and_making_again_mends_it(copy, made, surface):
    damage(copy, "labels", 1)
    with Dataset(made) as whole, Dataset(copy) as dataset:
        intact = whole.samples()
        assert dataset.damage() == [(1, "/samples/labels, rows 400 to 799")]
        with pytest.raises(DatasetError, match=r"d\.h5: the chunk of /samples/labels, rows 400 to 799, is damaged"):
            dataset.samples()
        rest = np.r_[0:400, 800:1000]
        same(dataset.samples(skip_damaged=True), intact.take(rest))
    make_dataset(copy, surface, 1000, 3, SMALL)
    with Dataset(copy) as mended:
        same(mended.samples(), intact)


@pytest.mark.parametrize("fault", ["missing", "empty", "text", "half", "other"])
def test_what_is_no_dataset_is_refused_by_name(made, tmp_path, fault):
    path = tmp_path / "bad.h5"
    if fault == "empty":
        path.write_bytes(b"")
    elif fault == "text":
        path.write_text("not a dataset\n" * 100)
    elif fault == "half":
        content = made.read_bytes()
        path.write_bytes(content[: len(content) // 2])
    elif fault == "other":
        with h5py.File(path, "w") as file:
            file["x"] = 1
    with pytest.raises(DatasetError, match=r"bad\.h5: "), Dataset(path) as dataset:
        dataset.samples()


WRITER = """
import sys, pickle, time
import numpy as np
import fracsim.data.writing as storage
from fracsim.simulators.registry import SimulatorOptions
from fracture_samples import SMALL, bar_bell
from fracsim.solids.surface import read_surface
append = storage.append_block
def slowly(path, file, block, samples):
    append(path, file, block, samples)
    print(block, flush=True)
    time.sleep(float(sys.argv[2]))
storage.append_block = slowly
storage.make_dataset(sys.argv[1], read_surface(bar_bell()), 4000, 3, SMALL)
"""


def start_writer(path, pause):
    environment = dict(os.environ, PYTHONPATH=os.path.dirname(os.path.dirname(__file__)))
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), str(pause)], stdout=subprocess.PIPE, text=True, env=environment
    )


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_an_interrupted_file_is_readable_and_is_taken_up_where_it_was_left(tmp_path, surface, how):
    path = tmp_path / "d.h5"
    writer = start_writer(path, 0.3)
    for line in writer.stdout:
        if int(line) == 2:
            break
    with Dataset(path) as growing:  # while it is being written
        assert len(growing) >= 3 * BLOCK
        same(growing.samples().take(slice(1000)), sample(growing.simulator, 1000, 3))
    writer.send_signal(how)
    writer.wait()
    with Dataset(path) as left:
        kept = len(left)
        assert 3 * BLOCK <= kept < 4000
    make_dataset(path, surface, 4000, 3, SMALL)
    with Dataset(path) as whole:
        same(whole.samples(), sample(whole.simulator, 4000, 3))
    assert [entry.name for entry in tmp_path.iterdir()] == ["d.h5"]


# Simulators of the user's own


class Halves:
    """Any impact of severity 2 or more parts the body down the middle."""

    fixed_cracks = True

    def __init__(self, simulator):
        from fracsim.solids.polygons import coarsen
        from fracsim.solids.solid import relabel

        self.surface = simulator.surface
        side = (simulator.fine_cells.centroids[:, 0] > 0).astype(np.int64)
        self.cells, self.fine_to_cell = simulator.fine_cells, side
        self.cells = coarsen(relabel(simulator.fine_cells, side), self.surface)

    def thresholds(self, impacts: Impacts):
        return 2.0 / impacts.severities.sum(axis=1)

    def fracture(self, impacts: Impacts) -> Response:
        parted = impacts.severities.sum(axis=1) >= 2.0 * (1 - 1e-12)
        return Response(np.stack([np.zeros(len(parted), np.int64), parted.astype(np.int64)], axis=1))


def test_a_simulator_of_ones_own_stands_behind_the_same_file(simulator, tmp_path):
    path = tmp_path / "own.h5"
    own = Halves(simulator)
    make_dataset(path, own.surface, 500, 0, simulator=own)
    with Dataset(path) as dataset:
        assert dataset.simulator is None
        assert dataset.header["simulator"] == {"name": "own", "class": "Halves"}
        drawn = dataset.samples()
        np.testing.assert_array_equal(drawn.labels[:, 1] == 1, drawn.ratio >= 1)
        assert drawn.broken.shape == (500, 0)
        assert dataset.fields(drawn.labels[:2]).shape[0] == 2
    with pytest.raises(DatasetError, match="pass that simulator"):
        make_dataset(path, own.surface, 600, 0)
    make_dataset(path, own.surface, 600, 0, simulator=own)
    with pytest.raises(DatasetError, match="is not registered, so it cannot be made again"):
        regenerate(path, tmp_path / "again.h5")


@dataclass(frozen=True)
class SlabOptions(SimulatorOptions):
    along: tuple[float, ...] = (1.0, 0.0, 0.0)


class Slabs:
    """Any impact of severity 1 or more cuts the body across a direction into slabs, whose bounds chance has drawn."""

    options_type = SlabOptions
    fixed_cracks = False
    repeatable = True
    driven_by_impact_field = False

    def __init__(self, surface, cells, along, bounds):
        self.surface, self.cells, self.along, self.bounds = surface, cells, np.array(along), bounds

    @classmethod
    def build(cls, surface, options, rng, progress=None):
        return cls(surface, cut_lattice(surface, options.cells, rng), options.along, np.sort(rng.uniform(-0.2, 0.2, 2)))

    def thresholds(self, impacts):
        return 1.0 / impacts.severities.sum(axis=1)

    def fracture(self, impacts):
        slab = np.searchsorted(self.bounds, self.cells.centroids @ self.along)
        broken = impacts.severities.sum(axis=1) >= 1 - 1e-12
        return Response(np.where(broken[:, None], slab, 0))

    def state(self):
        return {"deep/bounds": self.bounds}, {"along": self.along.tolist()}

    @classmethod
    def restore(cls, surface, cells, interfaces, arrays, numbers):
        return cls(surface, cells, numbers["along"], arrays["deep/bounds"])


@pytest.fixture
def slabs(monkeypatch):
    monkeypatch.setattr(Slabs, "repeatable", True)
    fracsim.register_simulator("slabs", Slabs)
    yield
    SIMULATORS.pop("slabs", None)


def test_a_registered_simulator_of_ones_own_is_kept_gone_on_with_and_made_again(slabs, surface, tmp_path):
    path = tmp_path / "slabs.h5"
    options = SlabOptions("slabs", cells=300, along=(0.6, 0.8, 0.0))
    make_dataset(path, surface, 500, 2, options)
    expected = sample(make_simulator(surface, options, 2), 700, 2)
    with Dataset(path) as dataset:
        assert isinstance(dataset.simulator, Slabs)
        assert dataset.header["simulator"]["along"] == [0.6, 0.8, 0.0]
        drawn = dataset.samples()
        same(drawn, expected.take(slice(500)))
        assert len(np.unique(drawn.labels)) == 3
    make_dataset(path, surface, 700, 2, options)
    with Dataset(path) as dataset:
        same(dataset.samples(), expected)
    regenerate(path, tmp_path / "again.h5")
    with Dataset(tmp_path / "again.h5") as again, Dataset(path) as dataset:
        same(again.samples(), expected)
        assert again.header == dataset.header
    with pytest.raises(DatasetError, match=r"was made from along \[0.6"):
        make_dataset(path, surface, 700, 2, SlabOptions("slabs", cells=300))


def test_a_simulator_that_does_not_repeat_itself_is_not_made_again(slabs, surface, tmp_path, monkeypatch):
    make_dataset(tmp_path / "d.h5", surface, 100, 0, SlabOptions("slabs", cells=300))
    monkeypatch.setattr(Slabs, "repeatable", False)
    with pytest.raises(DatasetError, match="the slabs simulator needs is kept in the file but cannot be worked out"):
        regenerate(tmp_path / "d.h5", tmp_path / "again.h5")


def test_without_its_registration_a_file_is_read_but_not_made_again(slabs, surface, tmp_path):
    make_dataset(tmp_path / "d.h5", surface, 100, 0, SlabOptions("slabs", cells=300))
    SIMULATORS.pop("slabs")
    with Dataset(tmp_path / "d.h5") as dataset:
        assert dataset.simulator is None
        assert len(dataset.samples()) == 100
    with pytest.raises(DatasetError, match=r"its simulator \(slabs\) is not registered"):
        regenerate(tmp_path / "d.h5", tmp_path / "again.h5")


def test_a_fault_in_a_simulators_own_code_is_not_called_damage(slabs, surface, tmp_path, monkeypatch):
    make_dataset(tmp_path / "d.h5", surface, 100, 0, SlabOptions("slabs", cells=300))

    def slip(cls, surface, cells, interfaces, arrays, numbers):
        raise ValueError("a slip")

    monkeypatch.setattr(Slabs, "restore", classmethod(slip))
    with Dataset(tmp_path / "d.h5") as dataset, pytest.raises(ValueError, match="a slip"):
        _ = dataset.simulator
    monkeypatch.setattr(Slabs, "restore", classmethod(lambda cls, s, c, i, arrays, numbers: arrays["width"]))
    with Dataset(tmp_path / "d.h5") as dataset, pytest.raises(DatasetError, match="needs 'width', which the file"):
        _ = dataset.simulator


WRONG = {
    "floats": lambda n, p: Response(np.zeros((n, p))),
    "too few rows": lambda n, p: Response(np.zeros((1, p), np.int64)),
    "too few parts": lambda n, p: Response(np.zeros((n, 1), np.int64)),
    "negative": lambda n, p: Response(np.full((n, p), -1)),
    "too large": lambda n, p: Response(np.full((n, p), p)),
    "broken of floats": lambda n, p: Response(np.zeros((n, p), np.int64), np.zeros((n, 1))),
}


@pytest.mark.parametrize("fault", [*WRONG, "thresholds"])
def test_wrong_answers_of_ones_own_simulator_are_refused_before_there_is_a_file(simulator, tmp_path, fault):
    own = Halves(simulator)
    if fault == "thresholds":
        own.thresholds = lambda impacts: np.full(len(impacts), np.nan)
    else:
        own.fracture = lambda impacts: WRONG[fault](len(impacts), 2)
    with pytest.raises(DatasetError, match=r"Halves: (labels|broken|thresholds) must"):
        make_dataset(tmp_path / "own.h5", own.surface, 500, 0, simulator=own)
    assert list(tmp_path.iterdir()) == []


def test_elastic_stress_is_kept_and_gone_on_from_but_not_made_again(surface, tmp_path, monkeypatch):
    pytest.importorskip("wildmeshing")
    monkeypatch.setattr("fracsim.simulators.elastic_fem.EDGE", 0.15)  # coarse tetrahedra
    path = tmp_path / "elastic.h5"
    options = replace(SMALL, name="elastic")
    make_dataset(path, surface, 500, 0, options)
    with Dataset(path) as dataset:
        first = dataset.samples()
        same(first, sample(dataset.simulator, 500, 0))
        np.testing.assert_array_equal(first.labels.any(axis=1), first.ratio >= 1)
    make_dataset(path, surface, 700, 0, options)
    with Dataset(path) as dataset:
        same(dataset.samples().take(slice(500)), first)
    with pytest.raises(DatasetError, match="cannot be worked out again"):
        regenerate(path, tmp_path / "again.h5")


# The command line


def test_the_command_line_makes_appends_describes_and_draws(tmp_path, capsys):
    mesh, out = tmp_path / "bell.obj", tmp_path / "d.h5"
    bar_bell().export(mesh)
    make = ["dataset", "make", str(mesh), "--out", str(out), "--cells", "500", "--modes", "4", "--quiet"]
    assert main([*make, "--samples", "300", "--json", str(tmp_path / "r.json")]) == 0
    figures = json.loads((tmp_path / "r.json").read_text())
    assert figures["counts"]["samples"] == 300
    assert {"solid", "modes", "samples", "total"} <= set(figures["seconds"])
    assert figures["peak_memory_mb"] > 0
    assert main([*make, "--append", "200"]) == 0
    assert main(["dataset", "info", str(out), "--json", str(tmp_path / "i.json")]) == 0
    assert json.loads((tmp_path / "i.json").read_text())["counts"]["samples"] == 500
    # Pieces are blue first, fields go from violet at a crack to yellow far from it.
    hue, saturation, _ = rgb_to_hsv(imread(tmp_path / "d_samples.png")[..., :3]).transpose(2, 0, 1)
    drawn = hue[saturation > 0.3]
    assert drawn.size > 0.05 * hue.size
    for low, high in ((0.5, 0.62), (0.68, 0.85), (0.12, 0.2)):
        assert ((drawn > low) & (drawn < high)).mean() > 0.02
    assert main(["dataset", "make", "--like", str(out), "--out", str(tmp_path / "again.h5"), "--quiet"]) == 0
    with Dataset(out) as one, Dataset(tmp_path / "again.h5") as other:
        same(one.samples(), other.samples())
    capsys.readouterr()
    assert main(["dataset", "make", "--out", str(out)]) == 2
    assert "give a mesh, or --like" in capsys.readouterr().err
    assert main(["dataset", "info", str(mesh)]) == 2
    assert "bell.obj: not an HDF5 file" in capsys.readouterr().err
    assert main([*make, "--samples", "0"]) == 2
    assert main([*make, "--samples", "10", "--append", "10"]) == 2
    assert main(["dataset", "make", "--like", str(out), "--out", str(tmp_path / "x.h5"), "--modes", "3"]) == 2
    assert "--modes cannot be given with --like" in capsys.readouterr().err
    before = out.read_bytes()
    for option in ("--out", "--json"):
        assert main(["dataset", "info", str(out), option, str(out)]) == 2
        assert "would be overwritten" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert main([*make, "--simulator", "magic", "--out", str(tmp_path / "new.h5")]) == 2
    assert "unknown simulator 'magic'" in capsys.readouterr().err


def test_options_of_a_simulator_are_checked():
    with pytest.raises(BakeError, match="cells must be a whole number and at least 50"):
        SimulatorOptions(cells=3)
    with pytest.raises(BakeError, match="unknown simulator"):
        SimulatorOptions(name="guess")


def test_links_join_the_two_sides_of_a_wall_and_nothing_across_a_gap():
    plates = [trimesh.creation.box((1.0, 1.0, 0.03)) for _ in range(2)]
    plates[1].apply_translation((0, 0, 0.06))
    bridge = trimesh.creation.box((0.2, 1.0, 0.09))
    bridge.apply_translation((0.4, 0, 0.03))
    body = refine(read_surface(trimesh.boolean.union([*plates, bridge], engine="manifold")))
    links = facing_vertices(body)
    ends = body.vertices[links]
    free = (ends[:, :, 0] < 0.2).all(axis=1)
    rim = 0.04
    inside = free & (np.abs(ends[:, :, 1]) < 0.5 - rim).all(axis=1) & (ends[:, :, 0] > -0.5 + rim).all(axis=1)
    height = np.abs(ends[:, 0, 2] - ends[:, 1, 2])
    assert inside.sum() > 100
    np.testing.assert_allclose(height[inside], 0.03 / body.scale, atol=1e-9)  # never 0.06 or 0.09
