"""What `World.step` and `World.fracture` return: an account of a break.

Plain data: it pickles, deep-copies and travels between processes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..common.impulse import Impulse
from .energy import CrackEnergy

if TYPE_CHECKING:
    from ..fracture.result import Fracture


@dataclass(frozen=True, eq=False)
class FractureEvent:
    """A body that broke, or that held although `World.fracture` was called on it.

    Attributes
    ----------
    parent : int
        Id of the body. It is gone from the engine unless `children` is empty.
    children : tuple of int
        Ids of the pieces, in the order of `fracture.pieces`; () where it did not break. A world with a `budget` may
        have removed some of them again.
    impulses : tuple of Impulse
        What acted on the body, in its asset's frame (m, N·s), strongest first.
    fracture : Fracture
        The model's answer; the whole body where it had none that made sense.
    time : float
        When it broke, s, simulated by its world.
    timings : dict of str to float
        Time of each stage, ms: "impulse" (contacts to impulses), "fracture" (model to pieces), "bodies" (pieces to
        bodies).
    energy : CrackEnergy
        Energy that the cracks take, and what they have taken so far, J. It grows for 20 ms after the break; a copy
        does not.
    generation : int
        0 for a body that was added, 1 for its pieces, and so on.
    constraints : dict of int to int
        Constraints that held the body: their ids before, and now that they hold pieces.
    """

    parent: int
    children: tuple[int, ...]
    impulses: tuple[Impulse, ...]
    fracture: Fracture
    time: float
    timings: dict[str, float]
    energy: CrackEnergy = field(default_factory=lambda: CrackEnergy(0.0))
    generation: int = 0
    constraints: dict[int, int] = field(default_factory=dict)

    @property
    def impulse(self) -> Impulse:
        """The strongest impulse (m, N·s)."""
        return self.impulses[0]
