"""TODO physics.events."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..common.impulse import Impulse
from .energy import CrackEnergy

if TYPE_CHECKING:
    from ..fracture.result import Fracture


@dataclass(frozen=True, eq=False)
class FractureEvent:
    """A body that broke, or held when it was told to break.

    parent: its id, gone from the engine unless `children` is empty.
    children: the ids of the pieces, in the order of fracture.pieces; () when it did not break. A ``budget`` may have
    removed some again.
    impulses: what it was hit with, in the asset's frame, strongest first.
    fracture: the model's answer, whole when it had none that made sense. time: s, simulated by this world.
    timings: ms of each stage: impulse (contacts to impulses), fracture (model to pieces), bodies (the swap).
    energy: what its cracks take and have taken so far. generation: 0 for a body that was added, 1 for its pieces.
    constraints: those that held it, by their ids before and now that they hold pieces.
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
        """The strongest impulse."""
        return self.impulses[0]
