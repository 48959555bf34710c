"""How well a simulator repeats itself: exact for those that always say the same, low for those that say anything."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
import trimesh

from fracsim.data.dataset import Dataset
from fracsim.data.impacts import draw_impacts
from fracsim.data.repeatability import moved, repeatability, repeatability_of
from fracsim.data.writing import make_dataset
from fracsim.geometry.sampling import SurfacePoints
from fracsim.simulators.base import Impacts, Response
from fracsim.simulators.registry import SimulatorOptions, make_simulator
from fracsim.solids.cut import cut_lattice
from fracsim.solids.solid import Solid
from fracsim.solids.surface import Surface, read_surface


@pytest.fixture(scope="module")
def surface():
    return read_surface(trimesh.creation.box((0.4, 0.2, 0.1)).subdivide().subdivide().subdivide())


def points_of(surface, impacts):
    points = SurfacePoints(surface.vertices, surface.faces)
    return points.at(impacts.faces[:, 0], impacts.barycentric[:, 0])


@dataclass(frozen=True, eq=False)
class Parted:
    """Cuts a body across x: always at the same place, at the contact, or at a place that nobody can foresee."""

    surface: Surface
    cells: Solid
    how: str
    asked: list = field(default_factory=list)
    fixed_cracks: ClassVar[bool] = False

    @classmethod
    def of(cls, surface, how, seed=0):
        return cls(surface, cut_lattice(surface, 400, np.random.default_rng(seed)), how)

    def thresholds(self, impacts: Impacts):
        return 2.0 / impacts.severities.max(axis=1)

    def fracture(self, impacts: Impacts) -> Response:
        self.asked.append(len(impacts))
        x = points_of(self.surface, impacts)[:, 0]
        at = {"fixed": 0.0 * x, "contact": x, "chaos": 0.4 * np.sin(1e6 * x)}[self.how]
        labels = (self.cells.centroids[:, 0] > at[:, None]) & (impacts.severities.max(axis=1) >= 2.0)[:, None]
        return Response(labels.astype(np.int64))


class Whole(Parted):
    """Never breaks, whatever it says of its thresholds."""

    def fracture(self, impacts: Impacts) -> Response:
        return Response(np.zeros((len(impacts), len(self.cells.volumes)), dtype=np.int64))


def test_a_simulator_that_always_says_the_same_repeats_itself_exactly(surface):
    figures = repeatability(Parted.of(surface, "fixed"), 0, Parted.of(surface, "fixed", 1))
    for name in ("ari_moved_1_percent", "volume_ari_moved_1_percent", "ari_moved_3_percent"):
        assert figures[name] == pytest.approx(1.0)
    # Cells straddle the cut, so another tiling does not have it quite there.
    assert 0.6 < figures["volume_ari_other_tiling"] < 1.0
    assert 0.6 < figures["ari_other_tiling"] < 1.0
    assert figures["impacts"] == 40
    assert "largest_share_correlation" not in figures  # it is always the same half


def test_a_cut_that_follows_the_contact_moves_with_it_in_either_tiling(surface):
    figures = repeatability(Parted.of(surface, "contact"), 0, Parted.of(surface, "contact", 1), count=80)
    assert 0.8 < figures["ari_moved_3_percent"] < figures["ari_moved_1_percent"] < 1.0
    assert figures["largest_share_correlation"] > 0.9


def test_a_simulator_that_nobody_can_foresee_does_not_repeat_itself(surface):
    figures = repeatability(Parted.of(surface, "chaos"), 0)
    assert figures["ari_moved_1_percent"] < 0.7
    assert "ari_other_tiling" not in figures


def test_what_never_breaks_has_no_figures(surface):
    assert repeatability(Whole.of(surface, "fixed"), 0) == {"impacts": 0}


def test_the_figures_do_not_depend_on_the_workers_and_few_impacts_are_asked(surface):
    options = SimulatorOptions(cells=400, modes=3)
    simulator = make_simulator(surface, options, 5)
    once = repeatability_of(simulator, options, 5)
    assert repeatability_of(simulator, options, 5, workers=2) == once
    assert repeatability_of(simulator, options, 6) != once
    counted = Parted.of(surface, "contact")
    repeatability(counted, 0)
    assert counted.asked == [30] * 4  # ten impacts and what they were moved to, in one call


@pytest.mark.parametrize("shift", [0.01, 0.03])
def test_an_impact_is_moved_and_turned_by_no_more_than_it_says(surface, shift):
    impacts, kind = draw_impacts(surface, 200, np.random.default_rng(0))
    single = Impacts(*(getattr(impacts, name)[kind == 0][:, :1] for name in vars(impacts)))
    others = moved(surface, single, shift, np.random.default_rng(1))
    distance = np.linalg.norm(points_of(surface, others) - points_of(surface, single), axis=1)
    assert distance.max() <= shift * 1.0001
    assert np.median(distance) == pytest.approx(shift)  # only near an edge does the surface bend away
    cosine = np.einsum("nki,nki->n", single.directions, others.directions)
    np.testing.assert_allclose(np.arccos(cosine), shift, rtol=1e-6)
    np.testing.assert_array_equal(others.severities, single.severities)


def test_a_dataset_says_how_well_its_simulator_repeats_itself(surface, tmp_path):
    options = SimulatorOptions(cells=400, modes=3)
    make_dataset(tmp_path / "box.h5", surface, 10, 4, options)
    with Dataset(tmp_path / "box.h5") as dataset:
        assert dataset.header["repeatability"] == repeatability_of(dataset.simulator, options, 4)
        assert {"ari_moved_1_percent", "volume_ari_other_tiling"} < set(dataset.header["repeatability"])
        assert dataset.severity_kind == dataset.header["severity_kind"] == "impulse"
    make_dataset(tmp_path / "own.h5", surface, 10, 4, simulator=Parted.of(surface, "contact"))
    with Dataset(tmp_path / "own.h5") as dataset:
        assert "ari_moved_3_percent" in dataset.header["repeatability"]
        assert "ari_other_tiling" not in dataset.header["repeatability"]
