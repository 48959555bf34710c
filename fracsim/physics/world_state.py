"""The state of a world: its engine, its clock, and the bodies that it made.

Every stage of `World.step` reads and changes this one state.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ..common.errors import PhysicsError
from .activity import Activity
from .bodies import Body
from .bullet import Engine
from .clock import Clock
from .contact_materials import ContactMaterials
from .records import BodyRecord
from .spin import GyroscopicCorrection

if TYPE_CHECKING:
    from .states import Motion


class WorldState:
    """The bodies of a world, and what the stages of a step share.

    Parameters
    ----------
    engine : Engine
        Engine that the bodies are in.

    Attributes
    ----------
    engine : Engine
        Engine that the bodies are in.
    clock : Clock
        Simulated time, time step and gravity.
    activity : Activity
        Breakable bodies, by id, and what is known of their motion.
    gyroscopic : GyroscopicCorrection
        Pieces whose spin is corrected after each step.
    pieces : dict of int to Body
        Pieces of what broke, by id; those that break no more too.
    materials : ContactMaterials
        What the bodies are made of that do not break.
    damping : dict of int to tuple of float
        Linear and angular damping of the pieces, 1/s; the engine does not tell them.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.clock = Clock(engine)
        self.activity = Activity(engine)
        self.gyroscopic = GyroscopicCorrection(engine)
        self.pieces: dict[int, Body] = {}
        self.materials = ContactMaterials(engine)
        self.damping: dict[int, tuple[float, float]] = {}

    @property
    def records(self) -> dict[int, BodyRecord]:
        """Records of the breakable bodies, by id."""
        return self.activity.records

    def find(self, body: int) -> Body:
        """Look a body up.

        Parameters
        ----------
        body : int
            Id of a breakable body or of a piece.

        Returns
        -------
        Body
            The body.

        Raises
        ------
        PhysicsError
            Where this world has no such body.
        """
        self.forget_removed()
        if body in self.records:
            return self.records[body].body
        if body in self.pieces:
            return self.pieces[body]
        known = sorted({*self.records, *self.pieces}) or "none"
        raise PhysicsError(f"body {body} is not in this world; it has {known}")

    def add_piece(self, piece: Body, damping: tuple[float, float]) -> None:
        """Take a new piece in, in place of whatever had its id.

        Parameters
        ----------
        piece : Body
            The piece, as it is in the engine.
        damping : tuple of float
            Its linear and angular damping, 1/s.
        """
        self.forget(piece.id)
        self.pieces[piece.id] = piece
        self.damping[piece.id] = damping
        self.activity.tokens[piece.id] = piece.token

    def forget(self, body: int) -> None:
        """Drop all that is known of a body, which may be gone.

        Parameters
        ----------
        body : int
            Its id.
        """
        self.activity.forget(body)
        self.activity.tokens.pop(body, None)
        self.gyroscopic.drop(body)
        self.damping.pop(body, None)
        self.pieces.pop(body, None)

    def forget_removed(self) -> None:
        """Drop all that is known of bodies that somebody else took out of the engine.

        Raises
        ------
        PhysicsError
            Where the client is no longer connected.
        """
        self.engine.require_connection()
        bodies = {body: record.body for body, record in self.records.items()} | self.pieces
        for body, known in bodies.items():
            if not self.engine.is_marked(body, known.token):
                self.forget(body)

    def velocities_set(self, bodies: Iterable[Body], motions: Iterable[Motion]) -> None:
        """Take note of velocities that this world gave to bodies after the step.

        Parameters
        ----------
        bodies : iterable of Body
            The bodies.
        motions : iterable of Motion
            Their new motions, in the same order (m/s, rad/s).
        """
        for body, motion in zip(bodies, motions, strict=True):
            self.activity.velocity_set(body.id, motion)
            self.gyroscopic.changed(body.id, motion[1])
