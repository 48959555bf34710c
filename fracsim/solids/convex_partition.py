"""The partition of solids into convex parts: cut apart, split and joined as long as that pays. Offline only.

``convex`` is the way in. What a part is worth is measured by the sample points of ``sampled_solid``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import BakeError, MissingExtraError
from ..geometry.frames import tangent_basis
from .hulls import Mesh, hull_points, thin_hull, within
from .sampled_solid import REACH, SampledSolid

try:
    import manifold3d
except ImportError as error:
    raise MissingExtraError(str(error.name), "bake") from error


GAP = 1.5e-3  # of the largest extent, between parts of different solids; three times the engine's hull margin
PRICE = 6.5e-5  # of the whole volume and a solid: what one more part must gain
LEAST_GAIN = 5e-3  # of its solid's volume: what a part must gain however few solids there are
SMALLEST = 0.01  # of the solid's volume: smaller parts are dropped
BINS = 64  # offsets at which a direction's cut is tried


@dataclass(eq=False)
class _ConvexPart:
    """A hull and its cuts, each a half-space normal · x <= offset that keeps it from one other part."""

    owner: int
    content: manifold3d.Manifold  # the piece of the solid whose hull it is
    corners: FloatArray
    normals: FloatArray  # of the hull's faces
    inside: BoolArray  # the owner's points within the hull
    cuts: dict[_ConvexPart, tuple[FloatArray, float]] = field(default_factory=dict)
    shape: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # the corners that are left in the end

    @cached_property
    def box(self) -> FloatArray:
        """The hull's bounding box, (2, 3)."""
        return np.array([self.corners.min(axis=0), self.corners.max(axis=0)])


class ConvexPartition:
    """The convex parts of all solids while they are cut, split and joined.

    Parameters
    ----------
    surfaces : sequence of (vertices, faces)
        Watertight, of S solids.
    pairs : ndarray of int64, shape (I, 2)
        The solids that meet at each interface.
    normals : ndarray of float64, shape (I, 3)
        Of the interfaces, from the first to the second.
    gap : float
        How far parts of different solids stay apart, in units of the largest extent.

    Attributes
    ----------
    gap : float
        As above.
    solids : list of SampledSolid
        The S solids.
    volume : float
        Of all of them.
    parts : list of list
        The convex parts of each solid, as they are now.
    hints : dict
        The normal of the interface between two solids, by both orders of their indices.
    around : ndarray of float64, shape (P, 4)
        Planes of the hull of all solids, which no part may leave: what stands on a floor stands on that hull.
    """

    def __init__(self, surfaces: Sequence[Mesh], pairs: IntArray, normals: FloatArray, gap: float) -> None:
        self.gap = gap
        self.solids = [SampledSolid.of(vertices, faces) for vertices, faces in surfaces]
        self.volume = sum(solid.volume for solid in self.solids)
        self.parts: list[list[_ConvexPart]] = [[] for _ in surfaces]
        self.hints = {(int(a), int(b)): normal for (a, b), normal in zip(pairs, normals, strict=True)}
        self.hints |= {(b, a): -normal for (a, b), normal in self.hints.items()}
        around = ConvexHull(np.concatenate([vertices for vertices, _ in surfaces]))
        self.around = np.unique(np.round(around.equations, 9), axis=0)

    def begin(self, contents: Sequence[Sequence[manifold3d.Manifold]]) -> None:
        """Make the first parts, and cut them apart.

        Parameters
        ----------
        contents : sequence of sequence of manifold3d.Manifold
            For each solid, what its parts shall be the hulls of.
        """
        for k, of_solid in enumerate(contents):
            self.parts[k] = [part for content in of_solid if (part := self._hull(k, content)) is not None]
        self._cut_all(0.0, lambda _: None)

    def refine(self, price: float, progress: Callable[[float], None]) -> None:
        """Split and join parts while that is worth its price.

        Parameters
        ----------
        price : float
            What one more part must gain, as PRICE.
        progress : callable
            Hears the share that is done.
        """
        # A part costs more the more solids there are, as a break makes bodies of all of them; and the shape of a small
        # solid counts for more than its volume.
        scale = price * len(self.solids) * self.volume**0.5
        prices = [max(scale * solid.volume**0.5, LEAST_GAIN * solid.volume) for solid in self.solids]
        for k, solid in enumerate(self.solids):
            queue = list(self.parts[k])
            while queue:
                part = queue.pop(0)
                options = [part.content.split_by_plane(tuple(n), d) for n, d in self._splits(part)]
                options = [two for two in options if min(s.volume() for s in two) > 3 * SMALLEST * solid.volume]
                queue += self._exchange([part], options, prices[k])
            progress(0.8 * (k + 1) / len(self.solids))
        for k in range(len(self.solids)):
            i = 0
            while i < len(self.parts[k]):
                first = self.parts[k][i]
                for second in self.parts[k][i + 1 :]:
                    if self._exchange([first, second], [(first.content + second.content,)], -prices[k]):
                        break
                else:
                    i += 1
            progress(0.8 + 0.2 * (k + 1) / len(self.solids))

    def finish(self, progress: Callable[[float], None]) -> list[list[FloatArray]]:
        """Cut all parts once more, with more care, and give each few corners.

        Parameters
        ----------
        progress : callable
            Hears the share that is done.

        Returns
        -------
        list of list of ndarray of float64, shape (n, 3)
            For each solid its parts, each as the corners of its hull.

        Raises
        ------
        BakeError
            If a solid has no part left.
        """
        for sweep in range(2):
            self._cut_all(REACH, lambda share, sweep=sweep: progress((sweep + share) * 0.3))  # type: ignore[misc]
        for k, solid in enumerate(self.solids):
            for part in self.parts[k]:
                rest = manifold3d.Manifold.hull_points(part.corners)
                for normal, offset in part.cuts.values():
                    rest = rest.trim_by_plane(tuple(-normal), -offset)
                if rest.volume() > SMALLEST * solid.volume:
                    part.shape = thin_hull(hull_points(rest))
            self.parts[k] = [part for part in self.parts[k] if len(part.shape)]
            if not self.parts[k]:
                raise BakeError(
                    f"atom {k} lost its last convex part to its neighbours; use fewer modes or a larger mesh"
                )
        for k in range(len(self.solids)):
            for part in self.parts[k]:
                self._fit(part)
            progress(0.6 + 0.4 * (k + 1) / len(self.solids))
        return [[part.shape for part in of_solid] for of_solid in self.parts]

    def _hull(self, owner: int, content: manifold3d.Manifold) -> _ConvexPart | None:
        """Make the hull of some content a part, unless it is flat."""
        points = hull_points(content)
        try:
            hull = ConvexHull(points)
        except QhullError:  # flat
            return None
        planes = np.unique(np.round(hull.equations, 9), axis=0)
        inside = within(self.solids[owner].points, planes)
        return _ConvexPart(owner, content, points[hull.vertices], planes[:, :3], inside)

    def _near(self, owner: int, box: FloatArray, reach: float) -> list[_ConvexPart]:
        """List the parts of other solids that would come closer to a box than the gap if both grew by ``reach``."""
        low, high = box + np.array([[-1.0], [1.0]]) * (self.gap + 2 * reach)
        others = [other for k, of_solid in enumerate(self.parts) if k != owner for other in of_solid]
        if not others:
            return []
        boxes = np.array([other.box for other in others])
        near = ((low <= boxes[:, 1]) & (boxes[:, 0] <= high)).all(axis=1)
        return [others[k] for k in np.flatnonzero(near)]

    def _kept(self, part: _ConvexPart, without: _ConvexPart | None = None) -> BoolArray:
        """Decide which of the owner's points (N,) the part holds, one cut left out."""
        cuts = [cut for other, cut in part.cuts.items() if other is not without]
        if not cuts:
            return part.inside
        rows = np.flatnonzero(part.inside)
        points = self.solids[part.owner].points[rows]
        kept = (points @ np.array([n for n, _ in cuts]).T <= np.array([d for _, d in cuts])).all(axis=1)
        result = np.zeros(len(part.inside), dtype=bool)
        result[rows[kept]] = True
        return result

    def _held(self, owner: int, without: _ConvexPart | None = None) -> BoolArray:
        """Decide which points (N,) all of a solid's parts hold together, one part left out."""
        result = np.zeros(len(self.solids[owner].points), dtype=bool)
        for part in self.parts[owner]:
            if part is not without:
                result |= self._kept(part)
        return result

    def _worth(self, owners: Sequence[int]) -> float:
        """Add up what the parts of some solids hold."""
        return sum(float(self.solids[k].value[self._held(k)].sum()) for k in owners)

    def _cut_all(self, reach: float, progress: Callable[[float], None]) -> None:
        """Cut every part apart from those of other solids that are near."""
        for k, of_solid in enumerate(self.parts):
            for part in of_solid:
                for other in self._near(k, part.box, reach):
                    if other.owner > k:
                        self._cut(part, other, 2)
            progress((k + 1) / len(self.parts))

    def _cut(self, first: _ConvexPart, second: _ConvexPart, rounds: int) -> None:
        """Cut two parts apart by the plane that costs least, given what their other cuts have taken already."""
        sides: list[tuple[FloatArray, FloatArray]] = []
        for part, other in ((first, second), (second, first)):
            solid = self.solids[part.owner]
            free = self._kept(part, other) & ~self._held(part.owner, part)
            sides.append((solid.points[free], solid.value[free]))
        (a, worth_a), (b, worth_b) = sides
        directions = [second.corners.mean(axis=0) - first.corners.mean(axis=0)]
        if (hint := self.hints.get((first.owner, second.owner))) is not None:
            directions.append(hint)
        if second in first.cuts:
            directions.append(first.cuts[second][0])
        inside_a, inside_b = a[worth_a > 0], b[worth_b > 0]
        low = np.maximum(first.box[0], second.box[0]) - 2 * REACH
        high = np.minimum(first.box[1], second.box[1]) + 2 * REACH
        close_a, close_b = (points[((points >= low) & (points <= high)).all(axis=1)] for points in (inside_a, inside_b))
        for left, right in ((inside_a, inside_b), (close_a, close_b)):
            if min(len(left), len(right)) > 3:
                directions += [right.mean(axis=0) - left.mean(axis=0), _discriminant(left, right)]
        # Faces of either that the other hardly passes
        faces = np.vstack([first.normals, -second.normals])
        depth = (first.corners @ faces.T).max(axis=0) - (second.corners @ faces.T).min(axis=0)
        tried = np.vstack([np.array(directions), faces[np.argsort(depth, kind="stable")[:8]]])
        if len(a) == 0 or len(b) == 0:  # one of them is gone: any plane between the hulls' middles will do
            a, worth_a = np.vstack([a, first.corners]), np.append(worth_a, np.zeros(len(first.corners)))
            b, worth_b = np.vstack([b, second.corners]), np.append(worth_b, np.zeros(len(second.corners)))
        normal, offset = _best_plane(a, worth_a, b, worth_b, tried, self.gap, rounds)
        first.cuts[second] = normal, offset - self.gap / 2
        second.cuts[first] = -normal, -offset - self.gap / 2

    def _exchange(
        self, old: list[_ConvexPart], options: Sequence[Sequence[manifold3d.Manifold]], required: float
    ) -> list[_ConvexPart]:
        """Put the hulls of the best of some contents in the place of parts if that gains at least so much."""
        owner, parts = old[0].owner, self.parts[old[0].owner]
        boxes = np.array([part.box for part in old])  # what is near to a joint hull need not be near to either part
        near = self._near(owner, np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)]), 0.0)
        owners = [owner, *sorted({other.owner for other in near})]
        before, cuts = self._worth(owners), [dict(other.cuts) for other in near]
        rest = [part for part in parts if part not in old]
        best: tuple[list[_ConvexPart], list[dict[_ConvexPart, tuple[FloatArray, float]]]] | None = None
        for contents in options:
            new = [part for content in contents if (part := self._hull(owner, content)) is not None]
            for other in near:
                for part in old:
                    other.cuts.pop(part, None)
            self.parts[owner] = rest + new
            for part in new:
                for other in self._near(owner, part.box, 0.0):
                    self._cut(part, other, 0)
            gain = self._worth(owners) - before
            if gain >= required:
                required, best = gain, (new, [dict(other.cuts) for other in near])
            for other, saved in zip(near, cuts, strict=True):
                other.cuts = dict(saved)
        if best is None:
            self.parts[owner] = parts
            return []
        self.parts[owner] = rest + best[0]
        for other, kept in zip(near, best[1], strict=True):
            other.cuts = kept
        return best[0]

    def _splits(self, part: _ConvexPart) -> list[tuple[FloatArray, float]]:
        """List planes worth trying: between what the part holds and what it lost, and those with the smallest hulls."""
        solid = self.solids[part.owner]
        inside = part.inside & solid.inside
        points, corners = solid.points[inside], hull_points(part.content)
        if len(points) < 30:
            return []
        result = []
        lost, held = solid.points[inside & ~self._held(part.owner)], solid.points[inside & self._kept(part)]
        if min(len(lost), len(held)) > 10:
            normal = _discriminant(lost, held)
            normal /= np.linalg.norm(normal)
            along = np.concatenate([lost @ normal, held @ normal])
            order = np.argsort(along, kind="stable")
            balance = np.cumsum(np.where(order < len(lost), 1 / len(lost), -1 / len(held)))
            result.append((normal, float(along[order[np.argmax(balance)]])))
        options: list[tuple[float, FloatArray, float]] = []
        for normal in np.vstack([np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2], np.eye(3)]):
            along, ends = points @ normal, corners @ normal
            for offset in np.quantile(along, (0.15, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85)).tolist():
                close = np.abs(along - offset) < REACH  # stand in for the corners that the split will make
                halves = [
                    np.vstack([corners[side * (ends - offset) <= 0], points[close & (side * (along - offset) <= 0)]])
                    for side in (1, -1)
                ]
                try:
                    options.append((sum(ConvexHull(half).volume for half in halves), normal, offset))
                except (QhullError, ValueError):  # too few points on one side
                    continue
        options.sort(key=lambda option: option[0])
        chosen: list[tuple[FloatArray, float]] = []
        for _, normal, offset in options:
            if len(chosen) < 2 and all(abs(normal @ n) < 0.9 or abs(offset - d) > 5 * REACH for n, d in chosen):
                chosen.append((normal, offset))
        return result + chosen

    def _fit(self, part: _ConvexPart) -> None:
        """Move the shape's corners in and out, never past a cut, for what it is worth among its solid's other parts."""
        solid = self.solids[part.owner]
        low, high = part.box + np.array([[-REACH], [REACH]])
        near = ((solid.points >= low) & (solid.points <= high)).all(axis=1)
        for other in self.parts[part.owner]:
            if other is not part:
                near[near] = ~within(solid.points[near], ConvexHull(other.shape).equations)
        points, value = solid.points[near], solid.value[near]
        walls = np.vstack(
            [np.eye(3), -np.eye(3), self.around[:, :3], *(normal[None] for normal, _ in part.cuts.values())]
        )
        ends = np.concatenate([high, -low, -self.around[:, 3], [offset for _, offset in part.cuts.values()]])
        shape = part.shape
        best = float(value[within(points, ConvexHull(shape).equations)].sum())
        for step in (0.3, 0.18, 0.1, 0.05):
            for i in range(len(shape)):
                arm = shape[i] - shape.mean(axis=0)
                for shift in (step * arm, -step * arm):
                    rate, room = walls @ shift, np.maximum(ends - walls @ shape[i], 0.0)
                    share = min(1.0, float((room[rate > 1e-12] / rate[rate > 1e-12]).min(initial=1.0)))
                    if share < 0.05:
                        continue
                    moved = shape.copy()
                    moved[i] += share * shift
                    worth = float(value[within(points, ConvexHull(moved).equations)].sum())
                    if worth > best:
                        best, shape = worth, moved
                        break
        part.shape = shape[ConvexHull(shape).vertices]


def _best_plane(
    a: FloatArray,
    worth_a: FloatArray,
    b: FloatArray,
    worth_b: FloatArray,
    directions: FloatArray,
    gap: float,
    rounds: int,
) -> tuple[FloatArray, float]:
    """Find the plane normal · x = offset of most worth for points a behind it and b before it, half a gap away.

    The directions are tried first, then some around the best one, closer in each round.
    """
    points, step = np.vstack([a, b]), np.append(worth_a, -worth_b)
    shift = np.repeat([gap / 2, -gap / 2], [len(a), len(b)])[:, None]
    best, normal, offset, width, pivot = -np.inf, directions[0], 0.0, 0.0, points[0]
    for turn in (0.25, 0.1, 0.04)[: rounds + 1]:
        tried = directions / np.linalg.norm(directions, axis=1)[:, None]
        along = points @ tried.T + shift
        if width == 0.0:
            ends = np.stack([along[len(a) :].min(axis=0), along[: len(a)].max(axis=0)])
            low, high = ends.min(axis=0) - 1e-6, ends.max(axis=0) + 1e-6
        else:
            low, high = tried @ pivot - width, tried @ pivot + width
        size = (high - low) / BINS
        cell = np.clip(((along - low) / size).astype(np.int64) + 1, 0, BINS + 1)
        flat = (cell + np.arange(len(tried)) * (BINS + 2)).ravel()
        sums = np.bincount(flat, np.repeat(step, len(tried)), minlength=len(tried) * (BINS + 2))
        worth = sums.reshape(len(tried), -1)[:, :-1].cumsum(axis=1) + worth_b.sum()
        top = worth.max(axis=1)
        k = int(np.argmax(top))
        if top[k] > best:
            best, normal = float(top[k]), tried[k]
            # Where several offsets are as good, the middle of the first stretch of them
            good = worth[k] >= best - 1e-12
            first = int(np.argmax(good))
            last = first + int(np.argmin(np.append(good[first:], False))) - 1
            offset = float(low[k] + size[k] * (first + last) / 2)
            near = points[np.abs(along[:, k] - offset) <= max(4 * size[k], width)]
            pivot = near.mean(axis=0) if len(near) else points.mean(axis=0)
            pivot = pivot + normal * (offset - pivot @ normal)
        width = width / 2 if width else max(8 * float(size[k]), 4e-3)
        side, up = tangent_basis(normal, "smallest")
        angle = np.arange(8) * (np.pi / 4) + turn
        ring = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), up)
        directions = np.vstack([normal, normal + turn * ring])
    return normal, offset


def _discriminant(a: FloatArray, b: FloatArray) -> FloatArray:
    """Find the direction in which two clouds of points differ most, measured by their spread (Fisher)."""
    spread = np.cov(a.T) + np.cov(b.T) + 1e-9 * np.eye(3)
    return np.linalg.solve(spread, b.mean(axis=0) - a.mean(axis=0))
