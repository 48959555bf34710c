"""Convex parts made live or in the background: finer, in place, and the same in every run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pybullet as p
import pytest

import fracsim
from fracsim.physics import convex_worker, live_convex

# As a page would show it, with nothing to keep it from running again when another process imports it.
SCRIPT = """
import os, sys, time
import pybullet
import fracsim
from fracsim.physics import convex_worker

world = fracsim.World(pybullet.connect(pybullet.DIRECT), decomposition="background", refine_after=0.05)
asset = fracsim.load("chair")
body = world.add(asset)
impulse = next(one for one in asset.sample_impulses(100, 5) if len(asset.fracture(one).pieces) == 2)
event = world.fracture(body, impulse)
before = [len(pybullet.getCollisionShapeData(child, -1)) for child in event.children]
if sys.argv[1] == "waits":
    while convex_worker.worker(os.getpid()).process is None: time.sleep(0.01)
    print(convex_worker.worker(os.getpid()).process.pid, flush=True)
    time.sleep(60)
for _ in range(60):
    world.step()
assert [len(pybullet.getCollisionShapeData(child, -1)) for child in event.children] != before
assert not {"coacd", "manifold3d"} & set(sys.modules)
print("refined")
if sys.argv[1] == "raises":
    raise SystemExit(3)
"""


def run(asset, decomposition, steps=60):
    """Break at once, step on -> (events, states of the children, parts of each) in the end."""
    client = p.connect(p.DIRECT)
    world = fracsim.World(client, decomposition=decomposition, refine_after=0.1)
    body = world.add(asset, linear_velocity=(1, 0, 0), linear_damping=0.0)
    impulse = next(one for one in asset.sample_impulses(100, 5) if 2 <= len(asset.fracture(one).pieces) <= 4)
    event = world.fracture(body, impulse)
    for _ in range(steps):
        world.step()
    assert set(world.pieces) == set(event.children)
    states = [
        (*p.getBasePositionAndOrientation(child, client), *p.getBaseVelocity(child, client)) for child in event.children
    ]
    parts = [len(p.getCollisionShapeData(child, -1, physicsClientId=client)) for child in event.children]
    masses = [p.getDynamicsInfo(child, -1, physicsClientId=client)[0] for child in event.children]
    p.disconnect(client)
    return event, np.array([np.concatenate(state) for state in states]), parts, masses


def test_parts_made_in_the_background_take_their_place_in_flight(slab):
    event, baked, _, _ = run(slab, "baked")
    _, refined, parts, masses = run(slab, "background")
    np.testing.assert_allclose(refined, baked, atol=2e-3)  # it flies on as it did
    np.testing.assert_allclose(masses, [piece.mass for piece in event.fracture.pieces], rtol=1e-12)
    _, live, live_parts, _ = run(slab, "coacd")
    assert parts == live_parts
    np.testing.assert_allclose(live, baked, atol=2e-3)
    _, again, _, _ = run(slab, "background")
    np.testing.assert_array_equal(refined, again)


def test_an_unknown_decomposition_is_refused():
    client = p.connect(p.DIRECT)
    with pytest.raises(fracsim.PhysicsError, match="unknown decomposition"):
        fracsim.World(client, decomposition="magic")
    p.disconnect(client)


def test_a_script_without_a_guard_runs_once_and_needs_nothing_of_the_bake(tmp_path, bake_extra):
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "numpy.py").write_text("raise ImportError('not this one')")
    for how, code in (("ends", 0), ("raises", 3)):
        command = [sys.executable, "-P", tmp_path / "script.py", how]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert result.returncode == code, result.stderr
        assert result.stdout.count("refined") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_the_worker_ends_with_its_parent_however_that_ends(tmp_path, bake_extra, end):
    (tmp_path / "script.py").write_text(SCRIPT)
    parent = subprocess.Popen([sys.executable, tmp_path / "script.py", "waits"], stdout=subprocess.PIPE, text=True)
    worker = next(int(line) for line in parent.stdout if line.strip().isdigit())
    time.sleep(1.5)  # in the middle of CoACD
    assert running(worker)
    parent.send_signal(end)
    parent.wait(10)
    parent.stdout.close()
    deadline = time.monotonic() + 5
    while running(worker) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not running(worker)


def running(process):
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def started(worker):
    while worker.process is None or worker.process.poll() is not None:
        time.sleep(0.01)
    return worker.process


def test_a_worker_that_is_killed_leaves_the_baked_parts_and_one_warning(slab):
    baked = run(slab, "baked")[2]
    worker = convex_worker.worker(os.getpid())
    if worker.process is not None:
        worker.process.kill()
        worker.process.wait()
    client = p.connect(p.DIRECT)
    world = fracsim.World(client, decomposition="background", refine_after=0.1)
    impulse = next(one for one in slab.sample_impulses(100, 5) if 2 <= len(slab.fracture(one).pieces) <= 4)
    event = world.fracture(world.add(slab), impulse)
    started(worker).kill()
    with pytest.warns(RuntimeWarning, match="worker ended with exit status -9.*baked parts are kept") as caught:
        assert not any([world.step() for _ in range(60)])
    assert len(caught) == 1
    assert [len(p.getCollisionShapeData(child, -1, physicsClientId=client)) for child in event.children] == baked
    p.disconnect(client)
    assert run(slab, "background")[2] == run(slab, "coacd")[2]  # by another one


def submitted(asset, change):
    """The decomposition of one piece, changed, in the background -> what waits for it, and the piece."""
    [piece, *_] = asset.fracture(asset.sample_impulses(1, 5)[0]).pieces
    [(vertices, faces)], pairs, normals = live_convex.decomposition_task(asset, [piece])
    future = convex_worker.worker(os.getpid()).submit(([change(vertices, faces)], pairs, normals))
    return live_convex.Refinement(asset, (piece,), [], 0.0, future), piece


def test_what_a_library_refuses_in_the_worker_leaves_the_baked_parts_and_a_warning(slab):
    refinement, piece = submitted(slab, lambda vertices, faces: (vertices * [1, 1, 0], faces))  # flat
    with pytest.warns(RuntimeWarning, match=r"not decomposed \(.*\) in the background; baked parts are kept"):
        assert refinement.refined() == (piece,)


def test_a_fault_in_the_worker_s_code_surfaces_with_its_traceback(slab):
    refinement, _ = submitted(slab, lambda vertices, faces: (vertices, faces[:, :2]))
    with pytest.raises(RuntimeError, match=r"(?s)worker that decomposes pieces failed:\nTraceback .*AssertionError"):
        refinement.refined()


@pytest.mark.parametrize("error", [RuntimeError("from C++"), fracsim.BakeError("no part is left")])
def test_a_decomposition_that_fails_at_once_leaves_the_baked_parts_and_a_warning(slab, monkeypatch, error):
    def fail(*arguments):
        raise error

    monkeypatch.setattr("fracsim.solids.convex.separate", fail)
    pieces = slab.fracture(slab.sample_impulses(1, 5)[0]).pieces
    with pytest.warns(RuntimeWarning, match="baked parts are kept"):
        assert live_convex.refined_now(slab, pieces) == pieces


def test_a_fault_in_the_code_of_a_decomposition_surfaces(slab, monkeypatch):
    monkeypatch.setattr("fracsim.solids.convex.separate", lambda *arguments: None + 1)
    with pytest.raises(TypeError, match="unsupported operand"):
        live_convex.refined_now(slab, slab.fracture(slab.sample_impulses(1, 5)[0]).pieces)
