"""Throw a heavy ball at an object that stands on the floor, print what became of it, and write a GIF.

python examples/throw.py --mesh vase --speed 10 --out throw.gif
"""

from __future__ import annotations

import sys

import numpy as np
import pybullet as p
from drop import parser, play, report, save

import fracsim
from fracsim.physics.scene import GRAVITY, Scene


def main() -> int:
    arguments = parser(__doc__, "vase", "throw.gif")
    arguments.add_argument("--speed", type=float, default=10.0, help="of the ball, m/s (default 10)")
    arguments.add_argument("--mass", type=float, default=2.0, help="of the ball, kg (default 2)")
    options = arguments.parse_args()

    asset = fracsim.load(options.mesh)
    asset = asset.scaled(options.size / asset.size)
    scene = Scene(1 / 480, show=not options.no_gif)
    scene.reset()
    world = fracsim.World(scene.client, visuals=not options.no_gif)

    low, high = asset.vertices.min(axis=0), asset.vertices.max(axis=0)
    middle = (low + high) / 2
    world.add(asset, (-middle[0], -middle[1], 2e-3 * options.size - low[2]))
    radius, distance = 0.15 * options.size, 3.0 * options.size
    aim = 0.6 * (high[2] - low[2])
    ball = throw(scene.client, options.mass, radius, (-distance, 0.0, aim), options.speed, not options.no_gif)
    reach = distance - radius - (high[0] - low[0]) / 2
    frames: list[np.ndarray] = []

    def shoot() -> None:
        # Follow the middle of what is left of the object along the ball's way.
        ids = world.bodies + world.pieces
        places = [p.getBasePositionAndOrientation(body, physicsClientId=scene.client)[0][0] for body in ids]
        masses = [p.getDynamicsInfo(body, -1, physicsClientId=scene.client)[0] for body in ids]
        along = float(np.average(places, weights=masses))
        eye = np.array([0.3, -4.0, 1.8]) * options.size + [along, 0.0, 0.0]
        frames.append(scene.image(eye.tolist(), (along, 0.0, 0.5 * options.size), 480, 360))

    def time_to_impact() -> float:
        position, _ = p.getBasePositionAndOrientation(ball, physicsClientId=scene.client)
        return float((reach - distance - position[0]) / options.speed)

    events = play(scene, world, time_to_impact, (lambda: None) if options.no_gif else shoot, options.slow_motion)
    if frames:
        save(frames, options.out)
    scene.close()
    return report(events)


def throw(
    client: int, mass: float, radius: float, position: tuple[float, float, float], speed: float, show: bool
) -> int:
    """Throw a ball along x so that it passes the origin as high as it starts -> its body id."""
    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=radius, physicsClientId=client)
    visual = -1
    if show:
        color = [0.22, 0.25, 0.30, 1.0]
        visual = p.createVisualShape(p.GEOM_SPHERE, radius=radius, rgbaColor=color, physicsClientId=client)
    ball: int = p.createMultiBody(mass, shape, visual, position, physicsClientId=client)
    p.changeDynamics(ball, -1, linearDamping=0.0, contactProcessingThreshold=1e-4, physicsClientId=client)
    p.resetBaseVelocity(ball, (speed, 0.0, -0.5 * GRAVITY * position[0] / speed), physicsClientId=client)
    return ball


if __name__ == "__main__":
    sys.exit(main())
