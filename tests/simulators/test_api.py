"""The public simulator: SI units in and out, the contact law between, and the same answers as an asset's."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import trimesh

import fracsim
from fracsim import simulators
from fracsim.common.contact import ContactLaw, effective_mass
from fracsim.simulators.base import Impacts, Response
from fracsim.simulators.registry import SimulatorOptions
from fracsim.solids.cut import cut_lattice
from fracsim.solids.solid import Solid, relabel
from fracsim.solids.surface import Surface

SIZE = (0.4, 0.1, 0.1)
STRENGTH = 0.02  # severity at which Snap breaks
YIELD = 30.0  # its compliance


@dataclass(frozen=True, eq=False)
class Snap:
    """Breaks a bar across its middle where the forces on it sum to STRENGTH, whatever their directions."""

    options_type: ClassVar[type[SimulatorOptions]] = SimulatorOptions
    fixed_cracks: ClassVar[bool] = True
    repeatable: ClassVar[bool] = True
    driven_by_impact_field: ClassVar[bool] = False
    severity_kind: ClassVar[str] = "force"

    surface: Surface
    cells: Solid
    strength: float = STRENGTH

    @classmethod
    def build(cls, surface, options, rng, progress=None):
        solid = cut_lattice(surface, options.cells, rng)
        return cls(surface, relabel(solid, (solid.centroids[:, 0] > 0).astype(np.int64)))

    @property
    def compliance(self):
        return np.full(len(self.surface.vertices), YIELD)

    def thresholds(self, impacts: Impacts):
        return self.strength / impacts.severities.sum(axis=1)

    def fracture(self, impacts: Impacts) -> Response:
        broken = impacts.severities.sum(axis=1) >= self.strength
        return Response(np.outer(broken, [0, 1]).astype(np.int64), broken[:, None])

    def state(self):
        return {}, {}

    @classmethod
    def restore(cls, surface, cells, interfaces, arrays, numbers):
        return cls(surface, cells)


@pytest.fixture
def bar(monkeypatch):
    monkeypatch.setitem(simulators.SIMULATORS, "snap", Snap)
    mesh = trimesh.creation.box(SIZE)
    mesh.apply_translation((1.0, 2.0, 3.0))
    return fracsim.Simulator(mesh, "snap", material="glass", cells=200)


def hit(magnitude, x=0.0, duration=None):
    return fracsim.Impulse((1.0 + x, 2.0, 3.2), (0.0, 0.0, -1.0), magnitude, duration)


def test_the_force_of_an_impulse_is_that_of_the_contact_law(bar):
    material = bar.material
    law = ContactLaw.of(
        0.4, material.youngs_modulus, material.poisson_ratio, compliance=YIELD / material.youngs_modulus / 0.4
    )
    inertia = material.density * np.prod(SIZE) / 12 * np.diag([0.02, 0.17, 0.17])
    for x in (0.0, 0.15):
        arm = np.array([[x, 0.0, 0.05]])
        mass = effective_mass(bar.mass, inertia, arm, np.array([[0.0, 0.0, -1.0]]))[0]
        force = float(law.peak_force(2.0**2 / (2 * mass)))
        impacts = bar.impacts(hit(2.0, x))
        assert impacts.severities[0, 0] == pytest.approx(force / (material.tensile_strength * 0.4**2), rel=1e-6)
    lasting = bar.impacts(hit(2.0, duration=0.5))
    expected = np.pi / 2 * 2.0 / 0.5 / (material.tensile_strength * 0.4**2)
    assert lasting.severities[0, 0] == pytest.approx(expected)


@pytest.mark.parametrize(
    "impulses",
    [
        [hit(2.0)],
        [hit(2.0, duration=1e-3)],
        [hit(1.0, -0.1), hit(7.0, 0.15)],
        [hit(0.01), hit(3.0, 0.1, duration=2e-3), hit(0.5, -0.1)],
    ],
    ids=["hard", "lasting", "two", "mixed"],
)
def test_the_critical_factor_is_the_one_at_which_it_first_comes_apart(bar, impulses):
    factor = bar.critical_factor(impulses)
    for times, pieces in ((0.999, 1), (1.001, 2)):
        fracture = bar.fracture([impulse.times(factor * times) for impulse in impulses])
        assert len(fracture.masses) == pieces
        assert fracture.broken == (pieces == 2)
        assert fracture.critical_factor == pytest.approx(1 / times, rel=1e-3)


def test_nothing_and_what_cannot_break_have_no_finite_factor(bar):
    nothing = bar.fracture(hit(0.0))
    assert nothing.critical_factor == np.inf
    assert nothing.masses.tolist() == pytest.approx([bar.mass])
    bar.simulator = Snap(bar.surface, bar.simulator.cells, np.inf)
    assert bar.critical_factor(hit(1.0)) == np.inf


def test_pieces_are_watertight_and_have_the_bodys_mass_and_the_cracks_area(bar, tmp_path):
    fracture = bar.fracture(hit(1e3))
    assert bar.mass == pytest.approx(0.004 * bar.material.density)
    np.testing.assert_allclose(bar.center_of_mass, (1.0, 2.0, 3.0), atol=1e-9)
    assert fracture.volumes_of.sum() == pytest.approx(0.004)
    assert fracture.masses.sum() == pytest.approx(bar.mass)
    np.testing.assert_allclose(fracture.shares, 0.5, atol=0.05)
    assert fracture.broken_area == pytest.approx(0.01, rel=0.1)  # the lattice's faces lie about the middle
    assert fracture.labels.shape == (len(bar.vertices),)
    np.testing.assert_allclose(bar.vertices.mean(axis=0), (1.0, 2.0, 3.0), atol=0.01)
    left, right = (fracture.labels[sign * (bar.vertices[:, 0] - 1.0) > 0.1] for sign in (-1, 1))
    assert np.unique(left).size == np.unique(right).size == 1
    assert left[0] != right[0]
    again = pickle.loads(pickle.dumps(fracture))
    for piece, mass in zip(again.pieces, fracture.masses, strict=True):
        solid = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
        assert solid.is_watertight
        assert solid.volume * bar.material.density == pytest.approx(mass) == piece.mass
        np.testing.assert_allclose(piece.center_of_mass, solid.center_mass, atol=1e-9)
        assert solid.area_faces[~piece.outer].sum() >= 0.0099
    for ending in (".glb", ".obj", ".ply", ".stl"):
        fracture.save(tmp_path / f"pieces{ending}")
        loaded = trimesh.load(tmp_path / f"pieces{ending}", force="mesh")
        assert loaded.volume == pytest.approx(0.004, rel=1e-4)
    with pytest.raises(fracsim.FracsimError, match=r"unknown ending '.txt'; use one of .glb"):
        fracture.save(tmp_path / "pieces.txt")
    assert len(list(tmp_path.iterdir())) == 4


def test_sampled_impulses_lie_about_what_breaks_it(bar):
    drawn = bar.sample_impulses(60, 0)
    factors = np.array([bar.critical_factor(impulse) for impulse in drawn])
    assert 0.3 < (factors <= 1).mean() < 0.8
    # Factors on the force, which grows with the impulse to a power between 1 and 6/5, are 0.3 to 5.
    assert 5.0**-1.001 < factors.min() < 0.4
    assert factors.max() < 1 / 0.29
    again = bar.sample_impulses(60, 0)
    assert [i.magnitude for i in again] == [i.magnitude for i in drawn]
    with pytest.raises(fracsim.BakeError, match="at least 1"):
        bar.sample_impulses(0, 0)


def test_it_answers_as_the_asset_baked_from_it_does(slab, slab_mesh):
    simulator = fracsim.Simulator(slab_mesh, "modal", material="glass", seed=3, cells=800, modes=3)
    impulses = slab.sample_impulses(20, 0)
    for impulse in [*impulses, impulses[:3], impulses[0].times(9.0)]:
        mine, other = simulator.fracture(impulse), slab.fracture(impulse, predictor="simulator")
        assert fracsim.metrics.ari(mine.labels, other.labels) == 1.0
        assert mine.severity == pytest.approx(other.severity)
        assert mine.broken_area == pytest.approx(other.crack_area)


def test_an_asset_makes_the_simulator_again_that_it_was_baked_from(slab, tmp_path):
    slab.save(tmp_path / "slab.frac")
    again = fracsim.load(tmp_path / "slab.frac").simulator()
    np.testing.assert_array_equal(again.simulator.impact_field.astype(np.float32), slab.arrays.impact_field)
    np.testing.assert_array_equal(again.vertices, slab.vertices)
    small = slab.scaled(0.5).with_material("ice").simulator()
    assert (small.size, small.material.name) == (slab.size / 2, "ice")
    impulse = slab.sample_impulses(1, 0)[0]
    assert again.fracture(impulse).severity == pytest.approx(slab.fracture(impulse).severity)
    old = replace(slab, metadata={key: value for key, value in slab.metadata.items() if key != "simulator_options"})
    np.testing.assert_array_equal(old.simulator().simulator.impact_field, again.simulator.impact_field)
    for metadata, fault in (({"simulator": "Mine"}, "not registered here"), ({"simulator": "modal"}, "bake it again")):
        with pytest.raises(fracsim.BakeError, match=fault):
            replace(slab, metadata=metadata).simulator()


def test_it_refuses_what_it_cannot_make(tmp_path):
    box = trimesh.creation.box()
    with pytest.raises(fracsim.MeshError, match="no such file"):
        fracsim.Simulator(tmp_path / "none.obj", "modal")
    with pytest.raises(fracsim.BakeError, match="unknown simulator 'guess'"):
        fracsim.Simulator(box, "guess")
    with pytest.raises(fracsim.BakeError, match="no option 'cuts'"):
        fracsim.Simulator(box, "modal", cuts=3)
    with pytest.raises(fracsim.MaterialError, match="jelly"):
        fracsim.Simulator(box, "modal", material="jelly")
