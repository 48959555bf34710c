"""A simulator of the user's own goes through the commands by its name; what does not fit is refused."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import trimesh

import fracsim
from fracsim import simulators
from fracsim.baking import BakeOptions
from fracsim.cli.main import main
from fracsim.common.material import Material, as_material
from fracsim.data.dataset import Dataset
from fracsim.fracture.rule import components, separated
from fracsim.simulators import register_simulator, simulator_class
from fracsim.simulators.base import Impacts, Response, interfaces_between
from fracsim.simulators.capabilities import default_samples, severity_kind_of
from fracsim.simulators.registry import SimulatorOptions, make_simulator, options_for, options_for_body
from fracsim.solids.cut import cut_lattice
from fracsim.solids.solid import Solid, relabel
from fracsim.solids.surface import Surface, read_surface
from fracsim.study.plan import read_plan


@dataclass(frozen=True)
class SlicerOptions(SimulatorOptions):
    slices: int = 6


@dataclass(frozen=True, eq=False)
class Slicer:
    """Cuts a body into slices across x, and breaks it between two of them: the nearer to the impact, the sooner."""

    options_type: ClassVar[type[SimulatorOptions]] = SlicerOptions
    fixed_cracks: ClassVar[bool] = True
    repeatable: ClassVar[bool] = True
    driven_by_impact_field: ClassVar[bool] = False

    surface: Surface
    cells: Solid
    strength: float

    @classmethod
    def build(cls, surface, options, rng, progress=None):
        solid = cut_lattice(surface, options.cells, rng)
        edges = np.quantile(solid.centroids[:, 0], np.linspace(0, 1, options.slices + 1)[1:-1])
        return cls(surface, relabel(solid, np.searchsorted(edges, solid.centroids[:, 0])), float(rng.uniform(1, 2)))

    def loads(self, impacts: Impacts):
        corner = self.surface.vertices[self.surface.faces[impacts.faces]]
        x = np.einsum("nkc,nkci->nki", impacts.barycentric, corner)[..., 0]
        pairs = interfaces_between(self.cells).pairs
        middle = self.cells.centroids[pairs, 0].mean(axis=1)
        near = np.exp(-np.abs(x[..., None] - middle))
        return (impacts.severities[..., None] * near).sum(axis=1) / self.strength, pairs

    def thresholds(self, impacts: Impacts):
        return 1.0 / self.loads(impacts)[0].max(axis=1)

    def fracture(self, impacts: Impacts) -> Response:
        loads, pairs = self.loads(impacts)
        broken = loads >= 1.0
        return Response(components(~broken, pairs, len(self.cells.volumes)), broken)

    def state(self):
        return {}, {"strength": self.strength}

    @classmethod
    def restore(cls, surface, cells, interfaces, arrays, numbers):
        return cls(surface, cells, numbers["strength"])


@pytest.fixture
def slicer():
    """The slicer under its name, for one test."""
    fracsim.register_simulator("slicer", Slicer)
    yield "slicer"
    del simulators.SIMULATORS["slicer"]


@pytest.fixture
def mesh(tmp_path):
    path = tmp_path / "bar.obj"
    trimesh.creation.box((0.4, 0.1, 0.1)).subdivide().subdivide().export(path)
    return path


def test_a_users_simulator_makes_a_dataset_that_can_be_appended_to(slicer, mesh, tmp_path, capsys):
    out = tmp_path / "bar.h5"
    sizes = ["--cells", "200", "--samples", "400", "--seed", "3", "--quiet"]
    assert main(["dataset", "make", str(mesh), "--out", str(out), "--simulator", slicer, *sizes]) == 0
    with Dataset(out) as dataset:
        assert dataset.header["simulator"]["name"] == slicer
        assert dataset.header["simulator"]["slices"] == 6
        simulator, samples = dataset.simulator, dataset.samples()
    assert isinstance(simulator, Slicer)
    np.testing.assert_array_equal(simulator.fracture(samples.impacts).labels, samples.labels)
    np.testing.assert_array_equal(samples.labels.any(axis=1), samples.ratio >= 1)

    longer = ["--cells", "200", "--append", "400", "--seed", "3", "--quiet"]
    assert main(["dataset", "make", str(mesh), "--out", str(out), "--simulator", slicer, *longer]) == 0
    whole = tmp_path / "whole.h5"
    sizes[3] = "800"
    assert main(["dataset", "make", str(mesh), "--out", str(whole), "--simulator", slicer, *sizes]) == 0
    with Dataset(out) as appended, Dataset(whole) as at_once:
        assert len(appended) == 800
        np.testing.assert_array_equal(appended.samples().labels, at_once.samples().labels)
    again = tmp_path / "again.h5"
    assert main(["dataset", "make", "--like", str(out), "--out", str(again), "--quiet"]) == 0
    with Dataset(again) as remade, Dataset(out) as appended:
        np.testing.assert_array_equal(remade.samples().ratio, appended.samples().ratio)
        np.testing.assert_array_equal(remade.samples().labels, appended.samples().labels)


def test_a_users_simulator_bakes_into_an_asset_that_breaks_between_its_cells(slicer, mesh, tmp_path, capsys):
    out, figures = tmp_path / "bar.frac", tmp_path / "bar.json"
    sizes = ["--cells", "200", "--samples", "800", "--steps", "40", "--workers", "1", "--quiet"]
    code = main(["bake", str(mesh), "--out", str(out), "--simulator", slicer, *sizes, "--json", str(figures)])
    assert code == 0, capsys.readouterr().err
    assert json.loads(figures.read_text())["simulator"] == slicer
    asset = fracsim.load(out)
    assert asset.baked_from.simulator == slicer
    assert asset.arrays.complex.count == 6  # slices
    hard = asset.sample_impulses(40, 0)
    assert max(len(asset.fracture(impulse).pieces) for impulse in hard) > 1


def test_a_bake_asks_the_simulator_for_what_it_was_not_told(mesh, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(simulators.SIMULATORS, "brittle", Brittle)
    out, sizes = tmp_path / "bar.frac", ["--cells", "200", "--steps", "40", "--workers", "1", "--quiet"]
    code = main(["bake", str(mesh), "--out", str(out), "--simulator", "brittle", "--material", "ice", *sizes])
    assert code == 0, capsys.readouterr().err
    assert "ari_other_tiling" in capsys.readouterr().out
    with pytest.raises(fracsim.BakeError, match="unknown simulator 'guess'"):
        fracsim.bake(mesh, simulator="guess")
    asset = fracsim.load(out)
    record, metadata = asset.baked_from, asset.metadata
    assert (record.simulator, record.severity_kind) == ("brittle", "force")
    assert asset.arrays.complex.count == 6  # slices of ice
    assert metadata["simulator_options"]["slices"] == 6
    assert metadata["options"] == metadata["options"] | {"cells": 200, "modes": 20, "samples": 700}
    assert metadata["options"]["min_piece_volume_fraction"] == 1e-3
    assert metadata["repeatability"]["ari_moved_1_percent"] > 0.8
    strong = asset.impulse_of(20.0 * record.typical_severity, asset.vertices[0], -asset.vertices[0])
    assert asset.fracture(strong).broken


def test_a_dataset_of_the_command_line_is_of_its_material(mesh, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(simulators.SIMULATORS, "brittle", Brittle)
    out = tmp_path / "bar.h5"
    make = ["dataset", "make", str(mesh), "--out", str(out), "--simulator", "brittle", "--cells", "200", "--quiet"]
    assert main([*make, "--samples", "10", "--material", "glass"]) == 0
    with Dataset(out) as dataset:
        assert dataset.header["simulator"]["slices"] == 7
        assert dataset.severity_kind == "force"
        assert "peak force" in dataset.header["units"]
    assert main([*make, "--samples", "10", "--material", "ice"]) == 2
    assert "was made from slices 7" in capsys.readouterr().err
    assert main([*make, "--samples", "10", "--material", "ice", "--set", "slices=7"]) == 0
    assert main(["dataset", "make", "--like", str(out), "--out", str(tmp_path / "x.h5"), "--material", "ice"]) == 2


def test_options_of_a_simulator_are_its_own(slicer, mesh):
    assert options_for(slicer, slices=3) == SlicerOptions(slicer, slices=3)
    with pytest.raises(fracsim.BakeError, match="'slicer' has no option 'colour'; it has name, cells"):
        options_for(slicer, colour=1)
    with pytest.raises(fracsim.BakeError, match="'modal' has no option 'slices'"):
        options_for("modal", slices=3)
    plain = SimulatorOptions(slicer, cells=200)  # what knows of no slices takes their default
    made = make_simulator(read_surface(mesh), plain, 0)
    assert len(made.cells.volumes) == 6
    middle = make_simulator(read_surface(mesh), options_for(slicer, cells=200, slices=2), 0)
    assert separated(np.arange(2), interfaces_between(middle.cells).pairs).tolist() == [True]


def test_a_users_simulator_has_its_own_options_on_the_command_line_in_a_bake_and_in_a_plan(
    slicer, mesh, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "bar.h5"
    sizes = ["--cells", "200", "--samples", "10", "--quiet"]
    make = ["dataset", "make", str(mesh), "--out", str(out), "--simulator", slicer, *sizes]
    assert main([*make, "--set", "slices=3"]) == 0
    with Dataset(out) as dataset:
        assert dataset.header["simulator"]["slices"] == 3
    for text, fault in (("slices=three", "slices must be of type int"), ("cuts=3", "no option 'cuts'"), ("3", "NAME=")):
        assert main([*make, "--set", text]) == 2
        assert fault in capsys.readouterr().err
    assert main(["dataset", "make", "--like", str(out), "--out", str(tmp_path / "x.h5"), "--set", "slices=3"]) == 2

    assert BakeOptions(simulator=slicer, simulator_settings={"slices": 4}).simulator_options.slices == 4
    with pytest.raises(fracsim.BakeError, match="no option 'cuts'"):
        BakeOptions(simulator=slicer, simulator_settings={"cuts": 4})

    plan = tmp_path / "plan.toml"
    lines = ["[simulator]", f'name = "{slicer}"', "slices = 5", "[[meshes]]", 'name = "bar"', 'file = "bar.obj"']
    plan.write_text("\n".join([*lines, "[[models]]", 'name = "near"', 'kind = "nearest"']))
    assert read_plan(plan).simulator.slices == 5
    monkeypatch.setitem(simulators.SIMULATORS, "brittle", Brittle)
    plan.write_text(plan.read_text().replace(slicer, "brittle"))
    assert read_plan(plan).simulator_of(1.0).slices == 5  # as it says
    plan.write_text('material = "ice"\n' + plan.read_text().replace("slices = 5\n", ""))
    assert read_plan(plan).simulator_of(1.0).slices == 6
    plan.write_text(plan.read_text().replace('"ice"', '"jelly"'))
    with pytest.raises(fracsim.ModelError, match=r"plan\.toml: unknown material 'jelly'"):
        read_plan(plan)
    plan.write_text("\n".join([*lines, "[[models]]", 'name = "near"', 'kind = "nearest"']).replace("slices", "cuts"))
    with pytest.raises(fracsim.ModelError, match=r"plan\.toml: .*no option 'cuts'"):
        read_plan(plan)


class Brittle(Slicer):
    """A slicer whose number of slices follows from what the body is made of, and how large it is."""

    severity_kind: ClassVar[str] = "force"
    default_samples: ClassVar[int] = 700

    @classmethod
    def material_options(cls, material: Material, size: float) -> dict[str, float]:
        return {"slices": 6 if material.name == "ice" else max(7, round(10 * size))}


def test_options_follow_from_the_body_unless_they_are_set(monkeypatch):
    monkeypatch.setitem(simulators.SIMULATORS, "brittle", Brittle)
    ice, glass = as_material("ice"), as_material("glass")
    assert options_for_body("brittle", ice, 0.4, cells=200) == SlicerOptions("brittle", 200, slices=6)
    assert options_for_body("brittle", glass, 0.9) == SlicerOptions("brittle", slices=9)
    assert options_for_body("brittle", ice, 0.4, slices=4) == SlicerOptions("brittle", slices=4)
    assert options_for_body("modal", ice, 0.4, modes=3) == SimulatorOptions(modes=3)
    with pytest.raises(fracsim.BakeError, match="no option 'cuts'"):
        options_for_body("brittle", ice, 0.4, cuts=1)


def test_a_class_may_say_what_severities_are_to_it_and_how_many_samples_it_can_give():
    assert severity_kind_of(Brittle) == "force"
    assert severity_kind_of(Slicer) == severity_kind_of(Slicer(None, None, 1.0)) == "impulse"
    assert severity_kind_of(simulator_class("modal")) == "impulse"
    with pytest.raises(fracsim.BakeError, match="Wrong: severity_kind must be impulse or force, got 'speed'"):
        severity_kind_of(type("Wrong", (Slicer,), {"severity_kind": "speed"}))
    assert (default_samples(Brittle), default_samples(Slicer)) == (700, 250000)


def test_a_taken_name_and_a_class_that_lacks_something_are_refused():
    with pytest.raises(fracsim.BakeError, match="'modal' is taken"):
        register_simulator("modal", Slicer)
    with pytest.raises(fracsim.BakeError, match="'own' is taken"):
        register_simulator("own", Slicer)
    incomplete = type("Incomplete", (), {"build": None, "fracture": None})
    with pytest.raises(fracsim.BakeError, match=r"Incomplete lacks options_type, .*, restore"):
        register_simulator("incomplete", incomplete)
    with pytest.raises(fracsim.BakeError, match="must be a class"):
        register_simulator("instance", object())
    assert "incomplete" not in simulators.SIMULATORS


def test_a_name_that_nothing_has_is_refused_with_those_that_are_there():
    for ask in (lambda: simulator_class("guess"), lambda: SimulatorOptions(name="guess")):
        with pytest.raises(
            fracsim.BakeError,
            match=r"unknown simulator 'guess'; use modal or .*elastic or radial",
        ):
            ask()


def test_a_simulator_may_be_registered_by_where_it_is_and_is_imported_when_first_used(monkeypatch):
    monkeypatch.setitem(simulators.SIMULATORS, "later", f"{__name__}:Slicer")
    assert simulator_class("later") is Slicer
    monkeypatch.setitem(simulators.SIMULATORS, "nowhere", f"{__name__}:Missing")
    with pytest.raises(fracsim.BakeError, match="has no class 'Missing'"):
        simulator_class("nowhere")


def test_every_simulator_of_the_package_is_complete():
    for name in ("modal", "elastic", "radial"):
        cls = simulator_class(name)
        assert {attribute for attribute in simulators.REQUIRED if attribute not in dir(cls)} == set()
