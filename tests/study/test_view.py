"""Pictures: what a mesh looks like from where it was hit, and what a sheet of fractures shows."""

from __future__ import annotations

import matplotlib.image
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

import fracsim
from fracsim.study import view
from fracsim.study.view import as_png, draw_mesh, picture_fractures, view_frame


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3))
def test_the_frame_of_a_view_is_right_handed_and_faces_the_side_that_was_hit(outward):
    outward = np.array(outward)
    frame = view_frame(outward)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    if np.linalg.norm(outward) > 0.1:
        assert frame[2] @ outward > 0


def test_only_faces_towards_the_eye_are_drawn_and_nearer_ones_later():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    frame = view_frame(np.array([1.0, 0.0, 0.0]))
    axes = Figure().subplots()
    colours = np.tile([0.2, 0.4, 0.8], (12, 1))
    draw_mesh(axes, np.asarray(box.vertices), np.asarray(box.faces), colours, frame)
    drawn = axes.collections[0].get_facecolor()
    assert len(drawn) == 6  # three sides of a box, two triangles each
    np.testing.assert_allclose(drawn[:, :3] / drawn[:, 2:3], np.tile([0.25, 0.5, 1.0], (6, 1)))
    assert len(np.unique(np.round(drawn[:, 2], 6))) == 3  # each side has its own brightness
    assert (drawn[:, 2] >= 0.8 * view.AMBIENT - 1e-9).all()


def test_a_png_shows_the_colours_that_were_drawn(tmp_path):
    figure = Figure(figsize=(2, 2))
    axes = figure.subplots()
    ball = trimesh.creation.icosphere(2)
    green = np.tile([0.0, 1.0, 0.0], (len(ball.faces), 1))
    draw_mesh(axes, np.asarray(ball.vertices), np.asarray(ball.faces), green, np.eye(3))
    axes.set_axis_off()
    (tmp_path / "ball.png").write_bytes(as_png(figure, 50))
    pixels = matplotlib.image.imread(tmp_path / "ball.png")[..., :3]
    assert pixels.shape == (100, 100, 3)
    is_green = (pixels[..., 1] > pixels[..., 0] + 0.2) & (pixels[..., 1] > pixels[..., 2] + 0.2)
    assert 0.2 < is_green.mean() < 0.6
    assert (pixels[:5] == 1).all()  # the margin is white


def test_a_sheet_of_fractures_has_a_row_for_each_and_a_colour_for_each_piece(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(view, "as_png", lambda figure, dpi: figures.append(figure) or b"")
    chair = fracsim.load("chair")
    shown = []
    for impulse in chair.sample_impulses(40, seed=3):
        fracture = chair.fracture(impulse)
        if fracture.broken and len(shown) < 2:
            shown.append(((impulse,), fracture))
    picture_fractures(chair, shown, tmp_path / "sheet.png")
    (figure,) = figures
    assert len(figure.axes) == 8
    assert "chair" in figure.get_suptitle()
    for axes, (impulses, fracture) in zip(np.reshape(figure.axes, (2, 4)), shown, strict=True):
        assert f"{impulses[0].magnitude:.3g} N·s" in axes[0].get_title()
        assert axes[1].get_title() == f"{len(fracture.pieces)} pieces"
        assert axes[0].lines[0].get_xydata().shape == (1, 2)  # the contact
        for axis in axes[1:]:
            colour = axis.collections[0].get_facecolor()[:, :3]
            hues = np.unique(np.round(colour / colour.max(axis=1, keepdims=True), 4), axis=0)
            assert len(hues) >= 2
        apart, together = (np.ptp([*axis.get_xlim(), *axis.get_ylim()]) for axis in (axes[2], axes[1]))
        assert apart > together
