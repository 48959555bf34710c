"""The stage: a floor, gravity, and a camera that draws with and without numpy in PyBullet."""

from __future__ import annotations

import copy

import numpy as np
import pybullet as p
import pytest

import fracsim
from fracsim.physics.scene import GRAVITY, Scene

EYE, TARGET, SIZE = (1.5, -1.5, 1.0), (0.0, 0.0, 0.2), (64, 48)


@pytest.fixture
def scene():
    scene = Scene(1 / 240, show=True)
    scene.reset()
    yield scene
    scene.close()


def red_box(scene, height):
    half = [0.2] * 3
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=scene.client)
    visual = p.createVisualShape(
        p.GEOM_BOX, halfExtents=half, rgbaColor=(0.9, 0.1, 0.1, 1), physicsClientId=scene.client
    )
    return p.createMultiBody(1.0, shape, visual, (0, 0, height), physicsClientId=scene.client)


def is_red(image):
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return (red > 2 * green) & (red > 2 * blue)


def test_the_camera_sees_the_floor_and_what_stands_on_it(scene):
    bare = scene.image(EYE, TARGET, *SIZE)
    assert bare.shape == (48, 64, 3)
    assert bare.dtype == np.uint8
    assert not is_red(bare).any()
    assert np.abs(bare.astype(int) - bare.mean(axis=2, keepdims=True)).mean() < 6  # grey
    assert len(np.unique(bare[24:])) > 2  # in tiles
    red_box(scene, 0.2)
    seen = is_red(scene.image(EYE, TARGET, *SIZE))
    assert 100 < seen.sum() < 1200
    row, column = np.argwhere(seen).mean(axis=0)
    assert abs(row - 24) < 4  # it stands where the camera looks at
    assert abs(column - 32) < 3


def test_what_hangs_above_the_floor_throws_a_shadow_and_the_floor_has_no_speckles(scene):
    bare = scene.image(EYE, TARGET, 320, 240).astype(int)
    red_box(scene, 0.8)
    image = scene.image(EYE, TARGET, 320, 240).astype(int)
    darker = ((bare - image).min(axis=2) > 5) & ~is_red(image)
    assert 2000 < darker.sum() < 8000
    row, column = np.argwhere(darker).mean(axis=0)
    assert row > 120  # on the floor before the box
    assert column > 160  # away from the light
    shades = np.bincount(bare[120:].max(axis=2).ravel())
    assert np.sort(shades)[-2:].sum() > 0.95 * shades.sum()  # those of the two kinds of tiles, and little besides


def test_a_camera_that_returns_tuples_draws_the_same_image(scene, monkeypatch):
    red_box(scene, 0.3)
    expected = scene.image(EYE, TARGET, *SIZE)
    draw = p.getCameraImage

    def tuples(*arguments, **keywords):
        width, height, *layers = draw(*arguments, **keywords)
        return width, height, *(tuple(np.ravel(layer).tolist()) for layer in layers)

    monkeypatch.setattr(p, "getCameraImage", tuples)
    np.testing.assert_array_equal(scene.image(EYE, TARGET, *SIZE), expected)


def test_what_is_pushed_moves_as_newton_has_it(scene):
    body = red_box(scene, 5.0)
    p.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=scene.client)
    inertia = 0.4**2 / 6
    for _ in range(24):
        scene.push(body, np.array([3.0, 0.0, GRAVITY]), np.array([0.0, 0.0, 0.01]))
        p.stepSimulation(physicsClientId=scene.client)
    linear, angular = scene.motion(body)
    np.testing.assert_allclose(linear, (0.3, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(angular, (0.0, 0.0, 0.1 * 0.01 / inertia), rtol=1e-6, atol=1e-9)
    assert scene.placement(body)[0][2] == pytest.approx(5.0)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy])
def test_a_scene_is_not_copied(scene, duplicate):
    with pytest.raises(fracsim.PhysicsError, match="make another Scene"):
        duplicate(scene)


def test_closing_twice_is_fine(scene):
    scene.close()
    scene.close()
    assert not p.getConnectionInfo(scene.client)["isConnected"]
