"""Drop an object onto the floor, print what became of it, and write a GIF in slow motion.

python examples/drop.py --mesh bunny --height 3 --out drop.gif
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable

import numpy as np

import fracsim
from fracsim.physics.scene import GRAVITY, Scene, rotation_of

FPS = 25  # images per second shown; GIFs count in hundredths of a second, so it divides 100
# s of simulated time, seen from the first impact: the film begins and slow motion begins before it, slow motion and
# then the film end after it.
FILM_BEFORE, SLOW_BEFORE, SLOW_AFTER, FILM_AFTER = 0.3, 0.03, 0.25, 0.75
LONGEST_WAIT = 3.0  # s; what has met nothing by then will not
COLOURS = 96  # of the GIF; more make it larger, and fewer show bands


def parser(description: str | None, mesh: str, out: str) -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(description=description, formatter_class=argparse.RawTextHelpFormatter)
    result.add_argument("--mesh", default=mesh, help=f"an asset's name or its file (default {mesh})")
    result.add_argument("--size", type=float, default=0.3, help="largest extent, m (default 0.3)")
    result.add_argument("--slow-motion", type=float, default=8.0, help="factor around the impact (default 8)")
    result.add_argument("--out", default=out, help=f"the GIF (default {out})")
    result.add_argument("--no-gif", action="store_true", help="simulate and print, draw nothing")
    return result


def play(
    scene: Scene,
    world: fracsim.World,
    time_to_impact: Callable[[], float],
    shoot: Callable[[], None],
    slow_motion: float,
) -> list[fracsim.FractureEvent]:
    """Step until 0.75 s after the first impact, and shoot 25 frames for each second shown -> what broke."""
    events: list[fracsim.FractureEvent] = []
    impacts: list[float] = []  # s, when
    world.on_contact(lambda _: impacts.append(world.time))
    next_shot = 0.0
    while world.time < (impacts[0] + FILM_AFTER if impacts else LONGEST_WAIT):
        until_impact = impacts[0] - world.time if impacts else time_to_impact()
        if world.time >= next_shot and until_impact < FILM_BEFORE:
            shoot()
            is_slow = -SLOW_AFTER < until_impact < SLOW_BEFORE
            next_shot = world.time + 1 / FPS / (slow_motion if is_slow else 1.0)
        events += world.step()
    return events


def save(frames: list[np.ndarray], path: str) -> None:
    """A GIF of one palette for all frames, the last held for a second."""
    try:
        from PIL import Image
    except ImportError as error:
        raise fracsim.MissingExtraError("pillow", "plot") from error
    sample = Image.fromarray(np.vstack(frames[:: max(1, len(frames) // 8)]))
    palette = sample.quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [1000 // FPS] * (len(images) - 1) + [1000]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)
    print(f"{path}: {len(frames)} frames")


def report(events: list[fracsim.FractureEvent]) -> int:
    """Print what broke -> the exit code: 1 when nothing did."""
    if not events:
        print("It did not break; try a greater height or speed.")
        return 1
    for event in events:
        masses = sorted((piece.mass for piece in event.fracture.pieces), reverse=True)
        print(f"hit with {event.impulse.magnitude:.2f} N·s after {event.time:.3f} s: {len(masses)} pieces")
        print("  kg:", " ".join(f"{mass:.3f}" for mass in masses))
        stages = {**event.timings, **{f"fracture/{k}": v for k, v in event.fracture.timings.items()}}
        print("  ms:", ", ".join(f"{stage} {time:.2f}" for stage, time in stages.items()))
    return 0


def main() -> int:
    arguments = parser(__doc__, "bunny", "drop.gif")
    arguments.add_argument("--height", type=float, default=3.0, help="of the lowest point, m (default 3)")
    arguments.add_argument("--seed", type=int, default=0, help="of the orientation it falls in")
    options = arguments.parse_args()

    asset = fracsim.load(options.mesh)
    asset = asset.scaled(options.size / asset.size)
    scene = Scene(1 / 480, show=not options.no_gif)
    scene.reset()
    world = fracsim.World(scene.client, visuals=not options.no_gif)

    orientation = np.random.default_rng(options.seed).normal(size=4)
    orientation /= np.linalg.norm(orientation)
    rotation = rotation_of(orientation.tolist())
    position = -rotation @ asset.center_of_mass
    position[2] = options.height - (asset.vertices @ rotation[2]).min()
    body = world.add(asset, position, orientation)
    frames: list[np.ndarray] = []
    height = options.height  # of the camera's target

    def time_to_impact() -> float:
        nonlocal height
        if body not in world.bodies:
            return 0.0
        height = lowest_point(world, body, asset)
        return height / max(math.sqrt(2 * GRAVITY * max(options.height - height, 0.0)), 1e-3)

    def shoot() -> None:
        time_to_impact()
        target = max(height, 0.0) + 0.3 * options.size
        eye = np.array([1.7, -2.6, 1.1]) * options.size + [0.0, 0.0, max(height, 0.0)]
        frames.append(scene.image(eye.tolist(), (0.0, 0.0, target), 480, 360))

    events = play(scene, world, time_to_impact, (lambda: None) if options.no_gif else shoot, options.slow_motion)
    if frames:
        save(frames, options.out)
    scene.close()
    return report(events)


def lowest_point(world: fracsim.World, body: int, asset: fracsim.BreakableAsset) -> float:
    """m above the floor."""
    position, orientation = world.pose(body)
    return float((asset.vertices @ rotation_of(orientation.tolist())[2]).min() + position[2])


if __name__ == "__main__":
    sys.exit(main())
