"""The options of a world that concern pieces, checked at the door.

`World` checks them once; the replacement reads them.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..common.checks import at_least
from ..common.errors import PhysicsError
from .live_convex import DECOMPOSITIONS, require_decomposition


@dataclass(frozen=True)
class ReplacementSettings:
    """What a world's options say of pieces.

    Attributes
    ----------
    visuals : bool
        Whether bodies have visual shapes.
    generations : int
        How often what breaks may break again, at least 1.
    smallest : float
        Share of the whole object's volume below which a piece breaks no more, at least 0.
    budget : int or None
        Number of pieces that there may be, at least 0; None for any number.
    decomposition : str
        Where the convex parts of pieces come from: "baked", "coacd" or "background".
    refine_after : float
        Time after a break at which finer convex parts take over, s, at least 0.
    immunity : float
        Time after a break in which nothing that was in it may break its pieces, s: that impact is counted already, and
        the engine needs a few steps to bring it to an end.
    resting_speed : float
        Speed that a piece at rest counts as having when the budget is exceeded, m/s, so that of two at rest the heavier
        one stays.

    Raises
    ------
    PhysicsError
        Where an option is out of its range.
    MissingExtraError
        Where a decomposition other than "baked" needs what is not installed.
    """

    visuals: bool = False
    generations: int = 3
    smallest: float = 0.01
    budget: int | None = None
    decomposition: str = "baked"
    refine_after: float = 0.5
    immunity: float = 0.02
    resting_speed: float = 0.1

    def __post_init__(self) -> None:
        checked = {
            "generations": int(at_least(self.generations, 1, "generations")),
            "smallest": at_least(self.smallest, 0.0, "smallest"),
            "budget": None if self.budget is None else int(at_least(self.budget, 0, "budget")),
            "refine_after": at_least(self.refine_after, 0.0, "refine_after"),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.decomposition not in DECOMPOSITIONS:
            raise PhysicsError(f"unknown decomposition {self.decomposition!r}; use one of {', '.join(DECOMPOSITIONS)}")
        if self.decomposition != "baked":
            require_decomposition()
