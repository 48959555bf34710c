"""Results are plain data: they pickle, copy and travel between processes, small and whole."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from dataclasses import replace

import numpy as np
import pytest

import fracsim
from fracsim.fracture.pieces import LatePieceShape, PieceShape
from fracsim.fracture.result import LateVertexAnswer, VertexAnswer

LARGEST_PICKLE = 2_000_000  # bytes; the file of the bunny has 4.7 million


@pytest.fixture
def fracture(shipped):
    fractures = (shipped.fracture(impulse) for impulse in shipped.sample_impulses(60, 4))
    return next(fracture for fracture in fractures if len(fracture.pieces) > 2)


def assert_same(fracture, other):
    np.testing.assert_array_equal(fracture.labels, other.labels)
    np.testing.assert_array_equal(fracture.udf, other.udf)
    assert (fracture.timings, fracture.predictor, fracture.severity) == (other.timings, other.predictor, other.severity)
    assert (fracture.clamped, fracture.crack_area, fracture.broken) == (other.clamped, other.crack_area, other.broken)
    assert len(fracture.pieces) == len(other.pieces)
    for piece, twin in zip(fracture.pieces, other.pieces, strict=True):
        assert (piece.volume, piece.mass) == (twin.volume, twin.mass)
        for name in ("center_of_mass", "inertia", "atoms", "vertices", "faces", "outer"):
            np.testing.assert_array_equal(getattr(piece, name), getattr(twin, name), name)
        for hull, twin_hull in zip(piece.hulls, twin.hulls, strict=True):
            np.testing.assert_array_equal(hull[0], twin_hull[0])
            np.testing.assert_array_equal(hull[1], twin_hull[1])
        assert piece.convex_parts.blocks == twin.convex_parts.blocks
        assert piece.convex_parts.scale == twin.convex_parts.scale
        np.testing.assert_array_equal(piece.convex_parts.offset, twin.convex_parts.offset)
        for points, twin_points in zip(piece.convex_parts.points, twin.convex_parts.points, strict=True):
            np.testing.assert_array_equal(points, twin_points)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["copy", "pickle"])
def test_a_fracture_survives_with_all_its_arrays_and_without_the_assets(fracture, copied):
    again = copied(fracture)
    assert_same(fracture, again)
    assert isinstance(fracture.at_vertices, LateVertexAnswer)
    assert type(again.at_vertices) is VertexAnswer
    assert all(isinstance(piece.shape, LatePieceShape) for piece in fracture.pieces)
    assert all(type(piece.shape) is PieceShape for piece in again.pieces)
    assert_same(again, copied(again))


def test_a_pickled_fracture_is_small(shipped):
    for impulse in shipped.sample_impulses(10, 4):
        assert len(pickle.dumps(shipped.fracture(impulse))) < LARGEST_PICKLE


def test_a_single_piece_survives_and_can_be_given_other_parts(fracture):
    piece = pickle.loads(pickle.dumps(fracture.pieces[0]))
    np.testing.assert_array_equal(piece.vertices, fracture.pieces[0].vertices)
    other = replace(piece, convex_parts=fracture.pieces[1].convex_parts)
    np.testing.assert_array_equal(other.faces, piece.faces)


def test_a_copied_piece_breaks_in_turn_as_the_piece_does(shipped, fracture):
    piece = max(fracture.pieces, key=lambda piece: len(piece.atoms))
    twin = copy.deepcopy(piece)
    impulse = max(shipped.sample_impulses(20, 8), key=lambda impulse: impulse.magnitude)
    answers = [shipped.breakable_piece(solid).fracture(impulse) for solid in (piece, twin)]
    np.testing.assert_array_equal(answers[0].labels, answers[1].labels)


def test_answers_of_every_kind_survive(shipped):
    impulse = shipped.sample_impulses(1, 4)[0]
    given = shipped.fracture_from_field(np.full(shipped.vertex_count, 0.1 * shipped.size))
    for fracture in (shipped.fracture(impulse, "interfaces"), shipped.unbroken(), given):
        again = pickle.loads(pickle.dumps(fracture))
        np.testing.assert_array_equal(again.udf, fracture.udf)
        np.testing.assert_array_equal(again.labels, fracture.labels)


def fracture_in_another_process(name):
    asset = fracsim.load(name)
    return next(f for f in map(asset.fracture, asset.sample_impulses(60, 4)) if len(f.pieces) > 2)


def test_a_fracture_comes_whole_out_of_a_spawned_process():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(fracture_in_another_process, ("chair",))
    here = fracture_in_another_process("chair")
    assert_same(replace(here, timings={}), replace(there, timings={}))


def test_an_asset_and_its_pieces_pickle_too(shipped, fracture):
    again = pickle.loads(pickle.dumps(shipped))
    impulse = shipped.sample_impulses(1, 6)[0]
    np.testing.assert_array_equal(again.fracture(impulse).labels, shipped.fracture(impulse).labels)
    piece = pickle.loads(pickle.dumps(shipped.breakable_piece(fracture.pieces[0])))
    assert piece.mass == fracture.pieces[0].mass
