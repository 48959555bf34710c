"""Replacement: a body that breaks gives way to its pieces, at the state in which it was before the impact.

`World.step` and `World.fracture` call it with what breaks; it also reshapes pieces whose finer convex parts are ready,
and keeps the number of pieces within the budget.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.errors import PhysicsError
from ..fracture.pieces import ConvexParts
from .bodies import PIECE_COLOURS, Body, spawn
from .breakable import bearable_force_of
from .bullet import Engine
from .energy import EnergyBalance, RigidStates
from .events import FractureEvent
from .last_step import LastStep
from .live_convex import Refinement, asset_of, refined_now
from .records import BodyRecord
from .settings import ReplacementSettings
from .states import BodyState, ConstraintInfo
from .verdicts import Break
from .world_state import WorldState

if TYPE_CHECKING:
    from ..fracture.pieces import Piece

NO_IMPACTS: frozenset[tuple[int, int]] = frozenset()


class Replacement:
    """Puts pieces in the place of bodies that break.

    Parameters
    ----------
    state : WorldState
        The world.
    last_step : LastStep
        How things moved before the step.
    energy : EnergyBalance
        Where the energy of each break is settled.
    settings : ReplacementSettings
        What the world's options say of pieces.
    """

    def __init__(
        self, state: WorldState, last_step: LastStep, energy: EnergyBalance, settings: ReplacementSettings
    ) -> None:
        self.settings = settings
        self._state = state
        self._last_step = last_step
        self._energy = energy
        self._refinements: list[Refinement] = []
        self._relived = NO_IMPACTS
        self._relived_in = 0  # the step that goes through them again
        self._renamed: dict[int, int] = {}  # constraints that went over to pieces: old id to new id

    @property
    def relived(self) -> frozenset[tuple[int, int]]:
        """Impacts that the last step lived a second time, (body, other) each; callbacks have seen them already."""
        return self._relived if self._state.clock.steps == self._relived_in else NO_IMPACTS

    def constraint(self, constraint: int) -> int:
        """Find the id by which a constraint goes now.

        Parameters
        ----------
        constraint : int
            An id that it had.

        Returns
        -------
        int
            Its present id; the same where it held nothing that broke.
        """
        while constraint in self._renamed:
            constraint = self._renamed[constraint]
        return constraint

    # What breaks in a step

    def replace(self, breaks: list[Break]) -> list[FractureEvent]:
        """Put everything that the impacts reached back to before the step, and pieces in place of what broke.

        Parameters
        ----------
        breaks : list of Break
            The bodies that break in the last step.

        Returns
        -------
        list of FractureEvent
            One for each.
        """
        if not breaks:
            return []
        engine = self._state.engine
        start = perf_counter()
        broken = [each.record.body.id for each in breaks]
        constrained = engine.constraints.pairs()
        pairs = [*self._last_step.contact_forces.bodies.tolist(), *constrained]
        reached = contact_island(pairs, broken, engine.is_static)
        states = {body: self._state_before(body) for body in reached}
        others = [body for body in reached if body not in broken]
        self._put_back([states[body] for body in others])
        rewinding = 1e3 * (perf_counter() - start)
        events = []
        for each in breaks:
            each.timings["bodies"] = rewinding / len(breaks)
            immune_to = each.others | frozenset(reached)
            events.append(self._put_pieces(each, states[each.record.body.id], immune_to))
        self._energy.drop_guards(set(reached))
        if not any(map(engine.is_articulated, others)):  # whose energy the states do not tell
            start = perf_counter()
            self._guard(breaks, events, others, states)
            breaks[0].timings["bodies"] += 1e3 * (perf_counter() - start)
        self.keep_budget()
        return events

    def replace_now(self, broken: Break) -> FractureEvent:
        """Put pieces in place of a body as it is now.

        Parameters
        ----------
        broken : Break
            The body that breaks on command.

        Returns
        -------
        FractureEvent
            What became of it.
        """
        engine, body = self._state.engine, broken.record.body.id
        event = self._put_pieces(broken, BodyState(body, engine.placement(body), engine.motion(body)), broken.others)
        self.keep_budget()
        return event

    def _state_before(self, body: int) -> BodyState:
        state = self._state
        motion = self._last_step.motion_before(body, -1)
        rates = state.activity.joint_rates_before(body)
        return state.engine.state_before(body, motion, rates, state.clock.time_step)

    def _put_back(self, states: Sequence[BodyState]) -> None:
        """Put bodies that do not break back to before the step, with what the step has made known of them."""
        world, time, relived = self._state, self._state.clock.time, set()
        for state in states:
            world.engine.restore(state)
            world.activity.body_restored(state)
            world.gyroscopic.changed(state.body, state.motion[1])
            record = world.records.get(state.body)
            if record is not None:
                relived |= {(state.body, impact.other) for when, impact in record.recent_impacts if when >= time}
                record.recent_impacts = [entry for entry in record.recent_impacts if entry[0] < time]
                if record.damage_before[0] >= time:
                    record.damage = record.damage_before[1]
        self._relived, self._relived_in = frozenset(relived), world.clock.steps + 1

    def _guard(
        self, breaks: list[Break], events: list[FractureEvent], others: list[int], states: dict[int, BodyState]
    ) -> None:
        """Guard the pieces of some breaks and what they live the step with against energy from penetration."""
        pieces: list[Body] = []
        parents: list[Body] = []  # with the mass of the pieces, which have their energy
        for each, event in zip(breaks, events, strict=True):
            children = [self._state.pieces[child] for child in event.children]
            pieces += children
            body, mass = each.record.body, sum(piece.mass for piece in children)
            parents.append(replace(body, mass=mass, moments=body.moments * mass / body.mass))
        beside = []
        for other in others:
            rigid = self._state.engine.rigid_body(other, -1)
            beside.append(Body(other, "", rigid.mass, np.zeros(3), np.eye(3), rigid.moments))
        known = [states[body.id] for body in (*parents, *beside)]
        before = RigidStates.of(
            [*parents, *beside], [state.placement for state in known], [state.motion for state in known]
        )
        self._energy.begin_guard([*pieces, *beside], before)

    def _put_pieces(self, broken: Break, at: BodyState, immune_to: frozenset[int]) -> FractureEvent:
        """Put pieces in place of a body at the state given; immune_to: bodies that may not break them at once."""
        world, engine, record, fracture = self._state, self._state.engine, broken.record, broken.fracture
        start = perf_counter()
        parent, time = record.body, world.clock.time
        surface = engine.contact_properties(parent.id, *record.damping)
        constraints = engine.constraints.of(parent.id)
        solids = fracture.pieces
        if self.settings.decomposition == "coacd":
            solids = refined_now(asset_of(record.breakable), solids)
        # Somebody may have given the body another mass; a static one's pieces have what its material makes them.
        mass_factor = (engine.mass(parent.id) or parent.mass) / parent.mass
        colours = PIECE_COLOURS if self.settings.visuals else None
        pieces = spawn(engine, solids, parent.pose(at.placement, at.motion), surface, colours, mass_factor)
        parts = [piece.convex_parts for piece in solids]
        renamed = {
            constraint[0]: self._rename(constraint[0], transfer_constraint(engine, constraint, parent, pieces, parts))
            for constraint in constraints
        }
        engine.remove_body(parent.id)  # after the pieces are made, so that none of them gets its id
        world.forget(parent.id)
        children = tuple(piece.id for piece in pieces)
        for piece, solid in zip(pieces, fracture.pieces, strict=True):
            world.add_piece(piece, record.damping)
            self._observe_piece(piece, solid, record, immune_to | frozenset(children))
        if self.settings.decomposition == "background":
            due = time + self.settings.refine_after
            self._refinements.append(Refinement.begun(asset_of(record.breakable), solids, pieces, due))
        world.gyroscopic.add(pieces, at.motion[1])
        demand = record.breakable.material.fracture_energy * fracture.crack_area
        energy = self._energy.begin_dissipation(demand, pieces)
        timings = broken.timings
        timings["bodies"] += 1e3 * (perf_counter() - start)
        return FractureEvent(
            parent.id, children, broken.impulses, fracture, time, timings, energy, record.generation, renamed
        )

    def _observe_piece(self, piece: Body, solid: Piece, parent: BodyRecord, immune_to: frozenset[int]) -> None:
        """Let a piece break in turn, unless it is too small or the last of its line."""
        generation = parent.generation + 1
        if generation >= self.settings.generations or len(solid.atoms) == 1:
            return
        breakable = parent.breakable.breakable_piece(solid)
        if breakable.volume_fraction < self.settings.smallest:
            return
        bearable_force = bearable_force_of(breakable)
        record = BodyRecord(piece, breakable, parent.damping, breakable.reach, bearable_force, generation)
        record.immune_to = immune_to
        record.immune_until = self._state.clock.time + self.settings.immunity
        self._state.activity.add(record)

    def _rename(self, constraint: int, new: int) -> int:
        self._renamed.pop(new, None)  # the engine may hand out ids again
        self._renamed[constraint] = new
        return new

    # What becomes of pieces

    def refine(self) -> None:
        """Give pieces the finer convex parts that are due, as made in the background."""
        for refinement in tuple(self._refinements):
            if self._state.clock.time < refinement.due:
                continue
            self._refinements.remove(refinement)
            self._state.forget_removed()
            for index, (solid, body) in enumerate(zip(refinement.refined(), refinement.bodies, strict=True)):
                if self._state.pieces.get(body.id) is body:
                    self._reshape(solid, body, index)

    def _reshape(self, solid: Piece, old: Body, index: int) -> None:
        """Make a piece anew, with the same id and motion and other convex parts."""
        world, engine = self._state, self._state.engine
        motion, damping = engine.motion(old.id), world.damping[old.id]
        pose, surface = old.pose_now(engine), engine.contact_properties(old.id, *damping)
        constraints = engine.constraints.of(old.id)
        for constraint, _ in constraints:
            engine.constraints.remove(constraint)
        engine.remove_body(old.id)
        colours = [PIECE_COLOURS[index % len(PIECE_COLOURS)]] if self.settings.visuals else None
        [new] = spawn(engine, [solid], pose, surface, colours)
        if new.id != old.id:  # the engine hands out the id that was freed last
            raise PhysicsError(f"piece {old.id} came back as {new.id}; use decomposition='baked'")
        for constraint, info in constraints:
            self._rename(constraint, engine.constraints.create(info))
        world.pieces[new.id] = new
        world.activity.tokens[new.id] = new.token
        world.gyroscopic.add([new], motion[1])
        self._energy.exchange(old, new)
        record = world.records.get(new.id)
        if record is not None:
            record.body = new
            world.activity.wake(record)

    def keep_budget(self) -> None:
        """Remove the smallest and stillest pieces while there are more than the budget allows."""
        world, budget = self._state, self.settings.budget
        if budget is None or len(world.pieces) <= budget:
            return
        excess = len(world.pieces) - budget
        world.forget_removed()

        def momentum(body: int) -> float:
            speed = float(np.linalg.norm(world.engine.motion(body)[0]))
            return world.pieces[body].mass * (self.settings.resting_speed + speed)

        for body in sorted(world.pieces, key=momentum)[:excess]:
            world.engine.remove_body(body)
            world.forget(body)


def contact_island(pairs: Iterable[Sequence[int]], seeds: Iterable[int], is_static: Callable[[int], bool]) -> list[int]:
    """Find the bodies that contacts and constraints join to some bodies; a static one joins nothing.

    Parameters
    ----------
    pairs : iterable of (int, int)
        Ids of bodies that a contact with force or a constraint joins.
    seeds : iterable of int
        Ids of the bodies to begin with.
    is_static : callable
        Tells whether the body of an id is static.

    Returns
    -------
    list of int
        The seeds, then the others in the order in which they are reached.
    """
    neighbours: dict[int, set[int]] = {}
    for a, b in pairs:
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    island = list(dict.fromkeys(seeds))
    known = set(island)
    for body in island:  # grows while it runs
        for other in sorted(neighbours.get(body, set()) - known):
            if not is_static(other):
                known.add(other)
                island.append(other)
    return island


def transfer_constraint(
    engine: Engine,
    constraint: tuple[int, ConstraintInfo],
    parent: Body,
    pieces: Sequence[Body],
    parts: Sequence[ConvexParts],
) -> int:
    """Give a constraint on a body to the piece that has the convex part nearest to where it holds.

    Parameters
    ----------
    engine : Engine
        Engine that the constraint is in.
    constraint : tuple of (int, ConstraintInfo)
        Id and description of the constraint, as `Engine.constraints` has them.
    parent : Body
        The body that it holds.
    pieces : sequence of Body
        The pieces of that body.
    parts : sequence of ConvexParts
        The convex parts of each piece.

    Returns
    -------
    int
        The constraint's new id.
    """
    old, info = constraint
    side = 0 if info[0] == parent.id else 1
    pivot = parent.center + parent.axes @ np.array(info[6 + side])  # in the asset's frame
    gaps = [
        min(float(((points * hulls.scale + hulls.offset - pivot) ** 2).sum(axis=1).min()) for points in hulls.points)
        for hulls in parts
    ]
    piece = pieces[int(np.argmin(gaps))]
    turn = Rotation.from_matrix(piece.axes.T @ parent.axes) * Rotation.from_quat(info[8 + side])
    changed: list[object] = list(info)
    changed[2 * side] = piece.id
    changed[6 + side] = (piece.axes.T @ (pivot - piece.center)).tolist()
    changed[8 + side] = turn.as_quat().tolist()
    engine.constraints.remove(old)
    return engine.constraints.create(changed)
