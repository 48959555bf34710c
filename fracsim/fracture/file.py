"""The asset's file: arrays in the safetensors format, a header, and a checksum over both.

``asset`` reads and writes through it; nothing else needs it.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..common.arrays import FloatArray
from ..common.checks import is_number, vector_of
from ..common.errors import AssetError, MaterialError
from ..common.files import compact, header_of
from ..common.material import PRESETS, Material
from .arrays import AssetArrays, SimulatorRecord
from .predictor import FieldWeights

FORMAT = 3
SUFFIX = ".frac"
BAKE_AGAIN = "bake it again with: fracsim bake MESH --out FILE.frac"
OPTIONAL = {  # entries that came later, so that files of this format may lack them
    *("compliance", "severity_kind", "gauge"),
    *("youngs_modulus", "poisson_ratio", "weibull_modulus"),
}
UNSIGNED = b"00000000"  # stands for the checksum where the checksum itself is computed
CHECKSUM = re.compile(rb'\\"checksum\\": \\"([0-9a-f]{8})\\"')  # as it stands in the file: JSON within JSON


@dataclass(frozen=True, eq=False)
class AssetContents:
    """What is in the file; attributes as of `fracsim.fracture.asset.BreakableAsset`."""

    name: str
    material: Material
    scale: float
    offset: FloatArray
    cap: float
    min_piece_volume_fraction: float
    arrays: AssetArrays
    model: FieldWeights
    metadata: dict[str, Any]
    baked_from: SimulatorRecord


def read_source(source: str | os.PathLike[str]) -> tuple[bytes, str]:
    """Read the bytes of an asset's file.

    Parameters
    ----------
    source : str or path
        A file, or the name of an asset that ships.

    Returns
    -------
    data : bytes
        The file.
    where : str
        What messages call it.

    Raises
    ------
    AssetError
        If there is no such file, or it cannot be read.
    """
    path = Path(source)
    if not path.suffix and not path.exists():
        shipped = resources.files("fracsim.meshes")
        entry = shipped / f"{source}{SUFFIX}"
        if not entry.is_file():
            names = sorted(item.name[: -len(SUFFIX)] for item in shipped.iterdir() if item.name.endswith(SUFFIX))
            raise AssetError(f"{source}: no such asset; those that ship are {', '.join(names)}; or give a file")
        return entry.read_bytes(), str(source)
    if path.is_dir():
        raise AssetError(f"{path}: is a folder; name a file in it")
    if not path.is_file():
        raise AssetError(f"{path}: no such file")
    try:
        return path.read_bytes(), str(path)
    except OSError as error:
        raise AssetError(f"{path}: cannot be read ({error.strerror})") from error


def pack(contents: AssetContents) -> bytes:
    """Write an asset.

    Parameters
    ----------
    contents : AssetContents
        What it consists of.

    Returns
    -------
    bytes
        The file.
    """
    from safetensors.numpy import save

    arrays = {name: getattr(contents.arrays, name) for name in AssetArrays.__dataclass_fields__}
    tensors = {f"asset.{name}": compact(value) for name, value in arrays.items() if value is not None}
    tensors |= {f"model.{name}": np.ascontiguousarray(getattr(contents.model, name)) for name in FieldWeights.names()}
    header = {
        "format": FORMAT,
        "checksum": UNSIGNED.decode(),
        "name": contents.name,
        "material": contents.material.to_dict(),
        "scale": contents.scale,
        "offset": contents.offset.tolist(),
        "cap": contents.cap,
        "min_piece_volume_fraction": contents.min_piece_volume_fraction,
        "metadata": contents.metadata,
        "baked_from": asdict(contents.baked_from),
    }
    return sign(save(tensors, metadata={"fracsim": json.dumps(header, sort_keys=True)}))


def sign(data: bytes) -> bytes:
    """Put the checksum of a file into its header.

    Parameters
    ----------
    data : bytes
        A file whose header has an entry for the checksum, whatever it holds.

    Returns
    -------
    bytes
        The same file with the right checksum.

    Raises
    ------
    ValueError
        If the header has no such entry.
    """
    place = _checksum_place(data)
    if place is None:
        raise ValueError("the header has no entry for a checksum")
    return data[: place[0]] + _checksum(data, place) + data[place[1] :]


def _checksum_place(data: bytes) -> tuple[int, int] | None:
    """Find where in a file its checksum stands; None if nowhere."""
    end = 8 + int.from_bytes(data[:8], "little")
    match = CHECKSUM.search(data, 8, end)
    return None if match is None else match.span(1)


def _checksum(data: bytes, place: tuple[int, int]) -> bytes:
    """Compute the CRC-32 of all bytes of a file, those of the checksum itself counted as zeros.

    It finds every single flipped bit. It guards against damage, not forgery, so it needs no slower cryptographic hash.
    """
    view = memoryview(data)
    value = zlib.crc32(view[place[1] :], zlib.crc32(UNSIGNED, zlib.crc32(view[: place[0]])))
    return b"%08x" % value


def unpack(data: bytes, where: str) -> AssetContents:
    """Read and check an asset.

    Parameters
    ----------
    data : bytes
        The file.
    where : str
        What messages call it.

    Returns
    -------
    AssetContents
        What it consists of.

    Raises
    ------
    AssetError
        If it is truncated, damaged, of another format, or contradicts itself.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load as load_tensors

    try:
        tensors = load_tensors(data)
    except SafetensorError as error:
        raise AssetError(f"{where}: truncated or not an asset ({error}); {BAKE_AGAIN}") from error
    try:
        header = header_of(data, "fracsim")
    except (KeyError, ValueError) as error:
        raise AssetError(f"{where}: not a fracsim asset (its header is missing); {BAKE_AGAIN}") from error
    if header.get("format") != FORMAT:
        raise AssetError(f"{where}: format {header.get('format')}, this version reads {FORMAT}; {BAKE_AGAIN}")
    place = _checksum_place(data)
    if place is None or data[place[0] : place[1]] != _checksum(data, place):
        raise AssetError(f"{where}: damaged, its checksum is not that of its content; copy it again, or {BAKE_AGAIN}")
    contents = _contents(tensors, header, where)
    for name, value in tensors.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise AssetError(f"{where}: {name} holds values that are not finite; {BAKE_AGAIN}")
    for fault in contradictions(contents.arrays, contents.model):
        raise AssetError(f"{where}: {fault}; {BAKE_AGAIN}")
    return contents


def _contents(tensors: dict[str, npt.NDArray[Any]], header: dict[str, Any], where: str) -> AssetContents:
    def malformed(entry: str, fault: object = "") -> AssetError:
        detail = f" ({fault})" if fault else ""
        return AssetError(f"{where}: the entry {entry} of the asset is missing or malformed{detail}; {BAKE_AGAIN}")

    def entry(name: str) -> npt.NDArray[Any]:
        if name not in tensors:
            raise malformed(name)
        value = tensors[name]
        return value.astype(np.int64) if value.dtype.kind == "i" and name.startswith("asset.") else value

    present = [name for name in AssetArrays.__dataclass_fields__ if name not in OPTIONAL or f"asset.{name}" in tensors]
    arrays = AssetArrays(**{name: entry(f"asset.{name}") for name in present})
    model = FieldWeights(**{name: entry(f"model.{name}") for name in FieldWeights.names()})
    for name in ("scale", "cap", "min_piece_volume_fraction"):
        if not is_number(header.get(name)):
            raise malformed(name)
    offset = vector_of(header.get("offset"), 3)
    if offset is None or not np.isfinite(offset).all():
        raise malformed("offset")
    for name, names in (("material", Material), ("baked_from", SimulatorRecord)):
        known = set(names.__dataclass_fields__)
        if not isinstance(header.get(name), dict) or not known - OPTIONAL <= set(header[name]) <= known:
            raise malformed(name)
    baked_from = asdict(SimulatorRecord()) | header["baked_from"]
    for name in ("min_severity", "typical_severity", "gauge"):
        if not is_number(baked_from[name]):
            raise malformed("baked_from", name)
    if not isinstance(baked_from["driven_by_impact_field"], bool):
        raise malformed("baked_from", "driven_by_impact_field")
    if baked_from["severity_kind"] not in ("impulse", "force"):
        raise malformed("baked_from", "severity_kind")
    if not isinstance(header.get("metadata"), dict):
        raise malformed("metadata")
    try:
        material = _material(header["material"])
    except MaterialError as error:
        raise malformed("material", error) from error
    return AssetContents(
        name=str(header.get("name")),
        material=material,
        scale=float(header["scale"]),
        offset=offset,
        cap=float(header["cap"]),
        min_piece_volume_fraction=float(header["min_piece_volume_fraction"]),
        arrays=arrays,
        model=model,
        metadata=header["metadata"],
        baked_from=SimulatorRecord(**baked_from),
    )


def _material(properties: dict[str, Any]) -> Material:
    """Read a material. Files of before elastic constants have those of the preset, where it is one."""
    preset = PRESETS.get(properties["name"]) if isinstance(properties["name"], str) else None
    if preset is not None and preset.to_dict() | properties == preset.to_dict():
        return preset
    return Material(**properties)


def contradictions(arrays: AssetArrays, model: FieldWeights) -> Iterator[str]:
    """Find what cannot be, so that no later question meets it: indices out of range, sizes that do not agree.

    Parameters
    ----------
    arrays : AssetArrays
        Those of an asset.
    model : FieldWeights
        Its model.

    Yields
    ------
    str
        A fault.
    """
    vertices, atoms, interfaces = *arrays.impact_field.shape, len(arrays.pairs)
    for name, limit in (
        ("faces", vertices),
        ("triangles", len(arrays.points)),
        ("sides", atoms),
        ("pairs", atoms),
        ("interface_vertices", vertices),
        ("hull_atoms", atoms),
    ):
        values = getattr(arrays, name)
        lowest = -1 if name in ("sides", "interface_vertices") else 0
        if values.size and not (lowest <= values.min() and values.max() < limit):
            yield f"{name} points outside its range"
    if arrays.compliance is not None and (arrays.compliance.shape != (vertices,) or (arrays.compliance < 0.0).any()):
        yield "the compliance does not fit the vertices, or is negative"
    if vertices > len(arrays.points) or len(model.coordinates) != vertices:
        yield "the numbers of vertices do not agree"
    if (
        not interfaces
        == len(arrays.distances)
        == len(arrays.interface_vertices)
        == len(arrays.normals)
        == len(model.slope)
    ):
        yield "the numbers of interfaces do not agree"
    if arrays.distances.shape != (interfaces, vertices):
        yield "the distances do not fit the vertices"
    for kind in ("hull", "body"):
        points, faces, sizes = (getattr(arrays, f"{kind}_{what}") for what in ("points", "faces", "sizes"))
        if not np.array_equal(sizes.sum(axis=0), (len(points), len(faces))):
            yield "the convex parts are not of the sizes stated"
