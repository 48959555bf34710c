"""A scene with one breakable object and what has become of it: the stage that the environments' tasks stand on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import fracsim
from fracsim.physics.scene import ContactImpulse, Motion, Scene, rotation_of

FloatArray = npt.NDArray[np.float64]


class ObjectScene:
    """A floor, one breakable object above it, and its pieces once it broke.

    Parameters
    ----------
    asset : BreakableAsset
        The object, in its size.
    time_step : float
        s.
    window : bool
        Whether to open a window.
    show : bool
        Whether images will be drawn.

    Attributes
    ----------
    asset : BreakableAsset
        The object.
    scene : Scene
        Floor, gravity and camera.
    world : World
        What breaks; a new one after each `reset`.
    body : int
        Id of the object or, once it broke, of its largest piece.
    pieces : int
        How many there are; 1 while it is whole.
    intact_fraction : float
        Mass of the largest piece as a share of the whole.
    last_impulse : float
        Strongest impulse of the last time step that had any, N·s.
    strongest_impulse : float
        Strongest impulse of the last `advance`, N·s.
    """

    world: fracsim.World

    def __init__(self, asset: fracsim.BreakableAsset, time_step: float, window: bool, show: bool) -> None:
        self.asset = asset
        self.scene = Scene(time_step, window, show)
        self.body, self.pieces, self.intact_fraction = -1, 1, 1.0
        self.last_impulse = self.strongest_impulse = 0.0
        self._masses: dict[int, float] = {}  # kg, of the object or of every piece, by id

    @property
    def is_whole(self) -> bool:
        """Whether nothing has broken yet."""
        return self.pieces == 1

    @property
    def motion(self) -> Motion:
        """Velocity, m/s, and angular velocity, rad/s, of `body`."""
        return self.scene.motion(self.body)

    @property
    def center_of_mass(self) -> tuple[float, float, float]:
        """Centre of mass of `body`, m."""
        return self.scene.placement(self.body)[0]

    @property
    def orientation(self) -> FloatArray:
        """Quaternion (x, y, z, w) of the frame of the asset, with w ≥ 0."""
        _, quaternion = self.world.pose(self.body)
        return quaternion if quaternion[3] >= 0.0 else -quaternion

    def reset(self, orientation: FloatArray, height: float) -> None:
        """Begin anew, with the whole object at rest above the origin of the floor.

        Parameters
        ----------
        orientation : ndarray of float64, shape (4,)
            Unit quaternion (x, y, z, w).
        height : float
            Height of the object's lowest point, m.
        """
        rotation = rotation_of(orientation.tolist())
        center = rotation @ self.asset.center_of_mass
        lowest = float((self.asset.vertices @ rotation.T)[:, 2].min())
        self.scene.reset()
        self.world = fracsim.World(self.scene.client, visuals=self.scene.show)
        self.body = self.world.add(self.asset, (-center[0], -center[1], height - lowest), orientation)
        self.world.on_contact(self._feel)
        self._masses = {self.body: self.asset.mass}
        self.pieces, self.intact_fraction = 1, 1.0
        self.last_impulse = self.strongest_impulse = 0.0

    def advance(self, force: FloatArray, torque: FloatArray, steps: int) -> list[fracsim.FractureEvent]:
        """Simulate some time steps, pushing the object while it is whole.

        Parameters
        ----------
        force, torque : ndarray of float64, shape (3,)
            What acts on the centre of mass, N and N·m, world frame.
        steps : int
            How many time steps.

        Returns
        -------
        list of FractureEvent
            What broke, in order.
        """
        self.strongest_impulse = 0.0
        events = []
        for _ in range(steps):
            if self.is_whole:
                self.scene.push(self.body, force, torque)
            for event in self.world.step():
                self._masses.pop(event.parent)
                masses = (piece.mass for piece in event.fracture.pieces)
                self._masses.update(zip(event.children, masses, strict=True))
                self.body = max(self._masses, key=self._masses.__getitem__)
                self.pieces = len(self._masses)
                self.intact_fraction = self._masses[self.body] / self.asset.mass
                events.append(event)
        return events

    def _feel(self, impact: ContactImpulse) -> None:
        """Keep the strongest impulse."""
        self.strongest_impulse = self.last_impulse = max(self.strongest_impulse, impact.impulse.magnitude)
