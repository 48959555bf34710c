"""What all models share: the body they are about, the door that blows come in by, and the file they are kept in.

A model is of one body. ``fit`` makes it from samples, ``predict`` answers blows with distance fields, and what it
learned is a handful of arrays. Offline only, but for the field model, whose arrays an asset carries.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt

from ..asset import header_of, write_beside
from ..atoms import Atoms, atoms_for
from ..breaking import Interfaces, separated
from ..dataset import Samples
from ..errors import DatasetError, ModelError
from ..generator import Blows
from ..mesh import Surface, facing_vertices
from ..pieces import vertex_cells
from ..segmentation.basins import Basins
from ..spectrum import Spectrum, spectrum
from ..storage import Dataset
from ..udf import CAP, CurveDistances, interface_distances, split_in_four
from .field import field_from_scores

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

FORMAT = 1
MODELS = {
    "mlp": "mlp:MLP",
    "deltaconv": "deltaconv:DeltaConv",
    "field": "fit_field:Field",
    "interfaces": "interfaces:InterfaceModel",
    "shared": "shared:SharedField",
    "nearest": "nearest:Nearest",
}


@dataclass(frozen=True, eq=False)
class Body:
    """What a model may know of a body: its shape, and where cracks can run in it; never how it answers a blow.

    surface: of largest extent 1, with V vertices and E edges. atoms: A building blocks of its pieces, and the I
    interfaces between them. distances: (I, V + E) float32, geodesic, from each interface's curve to the vertices and
    then the edge midpoints, capped at CAP. shores: (I, S) vertices along the curves.
    """

    surface: Surface
    atoms: Atoms
    distances: Float32Array
    shores: IntArray

    @classmethod
    def of(cls, surface: Surface, atoms: Atoms, progress: Callable[[float], None] = lambda _: None) -> Self:
        curves = CurveDistances(atoms.parts, surface)
        distances, shores = interface_distances(curves, atoms.interfaces.pairs, progress)
        return cls(surface, atoms, distances.astype(np.float32), shores)

    @classmethod
    def read(cls, dataset: Dataset, progress: Callable[[float], None] = lambda _: None) -> tuple[Self, Samples]:
        """The body of a dataset, and its samples in terms of the body's atoms."""
        generator = dataset.generator
        if generator is None:
            raise DatasetError(f"{dataset.path}: holds no generator, which says what the body is made of")
        samples = dataset.samples()
        if not len(samples):
            raise DatasetError(f"{dataset.path}: holds no samples; make some with: fracsim dataset make")
        floor = float(dataset.header["truth"]["crumb_floor"])
        atoms = atoms_for(generator, [] if generator.fixed_cracks else [samples.rows(slice(2 * dataset.block))], floor)
        return cls.of(dataset.surface, atoms, progress), atoms.project(samples)

    @property
    def vertices(self) -> FloatArray:
        return self.surface.vertices

    @property
    def faces(self) -> IntArray:
        return self.surface.faces

    @property
    def interfaces(self) -> Interfaces:
        return self.atoms.interfaces

    @property
    def volumes(self) -> FloatArray:
        return self.atoms.parts.volumes

    @cached_property
    def vertex_atom(self) -> IntArray:
        """(V,) the atom of each vertex."""
        parts = self.atoms.parts
        return vertex_cells(parts.triangles, parts.sides, len(parts.points))[: len(self.vertices)]

    @cached_property
    def split(self) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
        """``udf.split_in_four`` of the surface."""
        return split_in_four(self.surface)

    @property
    def nodes(self) -> FloatArray:
        """(V + E, 3): the vertices, then the midpoints of ``edges``."""
        return self.split[0]

    @property
    def edges(self) -> IntArray:
        """(E, 2) in lexicographic order."""
        return self.split[2]

    @cached_property
    def links(self) -> IntArray:
        """(L, 2) vertices that face each other through a thin wall."""
        return facing_vertices(self.surface)

    @cached_property
    def basins(self) -> Basins:
        distances = self.distances[:, : len(self.vertices)]
        return Basins.of(self.shores, distances, self.interfaces.pairs, self.interfaces.areas, len(self.volumes))

    def spectrum(self, count: int, radii: Sequence[float]) -> Spectrum:
        return spectrum(self.atoms.cells, self.atoms.atom, self.surface, count, radii)

    def fields(self, labels: IntArray, nodes: bool = False) -> Float32Array:
        """(N, V) the true fields of fractures that leave the atoms labels (N, A): the least distance to an interface
        that parts two pieces. nodes: (N, V + E), at the edge midpoints as well."""
        parted = separated(labels, self.interfaces.pairs).astype(np.float64)
        distances = self.distances if nodes else self.distances[:, : len(self.vertices)]
        fields = [field_from_scores(row, distances, CAP) for row in parted]
        return np.array(fields, dtype=np.float32).reshape(len(labels), distances.shape[1])


class Model(Protocol):
    """One architecture.

    kind: its name in MODELS. options_type: a frozen dataclass of its hyperparameters, all with defaults; where the
    common trainer fits it, one of them is ``training: TrainingOptions``. Beside what is below, a class has
    ``fit(body, samples, options, seed, run) -> (model, figures)``, which learns from ``samples.part(0)`` and watches
    ``samples.part(1)``. It may have ``predict_nodes(blows) -> (N, V + E)``, fields at edge midpoints as well, and
    ``predict_labels(blows) -> (N, A)``, pieces with no field between.
    """

    kind: ClassVar[str]
    options_type: ClassVar[type[Any]]

    def predict(self, blows: Blows) -> Float32Array:
        """(N, V) the distance fields of N blows, in units of the largest extent, capped at CAP."""
        ...

    def state(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Arrays and plain numbers from which ``restore`` makes the model again, or raises ValueError where they are
        of another body."""
        ...

    @classmethod
    def restore(cls, body: Body, arrays: dict[str, npt.NDArray[Any]], numbers: dict[str, Any]) -> Self: ...


def model_class(kind: str) -> Any:
    """The class of a model by its name in MODELS; its module is imported now."""
    if kind not in MODELS:
        raise ModelError(f"unknown model {kind!r}; use one of {', '.join(MODELS)}")
    module, name = MODELS[kind].split(":")
    return getattr(importlib.import_module(f".{module}", __package__), name)


def save_model(model: Model, path: str | Path, metadata: dict[str, Any] | None = None) -> None:
    """Write a model's arrays and how it was made, as safetensors: all of it, or nothing."""
    from safetensors.numpy import save

    arrays, numbers = model.state()
    header = {"format": FORMAT, "kind": model.kind, "numbers": numbers, "metadata": metadata or {}}
    packed = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    write_beside(Path(path), save(packed, metadata={"fracsim_model": json.dumps(header, sort_keys=True)}))


def load_model(path: str | Path, body: Body) -> tuple[Any, dict[str, Any]]:
    """Read a model of this body, and its metadata. Raises ModelError, naming the file and the fault."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{path}: no such file")
    data = path.read_bytes()
    try:
        arrays = load(data)
        header = header_of(data, "fracsim_model")
    except SafetensorError as error:
        raise ModelError(f"{path}: truncated or not a model ({error}); train it again with: fracsim train") from error
    except (KeyError, ValueError, TypeError) as error:
        raise ModelError(f"{path}: not a fracsim model (its header is missing)") from error
    if header.get("format") != FORMAT:
        raise ModelError(f"{path}: format {header.get('format')}, this version reads {FORMAT}; train it again")
    for name, value in arrays.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ModelError(f"{path}: {name} holds values that are not finite; train it again")
    try:
        return model_class(header["kind"]).restore(body, arrays, header["numbers"]), header["metadata"]
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: an entry is missing or does not fit this body ({error})") from error
