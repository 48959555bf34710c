"""From what height do everyday things break? ``python benchmarks/heights.py [--quick] [--resume] [--redraw]``.

Things of real size and of every preset fall in random orientations; the lowest point strikes the floor, the mass that
it moves brings the energy of the fall, and the contact law says how hard floor and body press on each other. Nothing is
fitted to a height. For each thing: the median height of the first crack, of the first piece of more than 1 % of the
body, and of what leaves less than 90 % of it in one piece, on floors of stone, wood, carpet and rubber; and how many
pieces there are at 1, 2 and 4 times the last. Only the first contact counts: what is left of a mug that fell on its
handle falls on, and what its wall meets then is another impact. Below are checks against what everybody knows of such
things, each of which may fail. Writes benchmarks/results/heights.{json,md,png}, or, with ``--quick`` (three falls of a
coarse mug), only prints; about 15 minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from fracsim.common.arrays import FloatArray, IntArray
from fracsim.common.contact import ContactLaw
from fracsim.common.material import CONTACT_PRESETS, PRESETS, Material
from fracsim.simulators import simulator_class
from fracsim.simulators.base import Impacts
from fracsim.simulators.registry import options_for_body
from fracsim.simulators.sequential import SequentialSimulator
from fracsim.simulators.structural import StructuralSimulator
from fracsim.solids.surface import Surface, read_surface

RESULTS = Path(__file__).parent / "results"
MESHES = Path(__file__).parent.parent / "meshes"
SIZES = {"mug": 0.114, "plate": 0.27, "bunny": 0.3, "chair": 0.3, "vase": 0.3}  # m, of the largest extent
FLOORS = ("stone", "wood", "carpet", "rubber")
GRAVITY = 9.81  # m/s²
CELLS = 300
FALLS = {"structural": 100, "sequential": 25}
SMALLEST = 0.01  # of the body: what counts as a piece
BROKEN = 0.9  # of the body: what the largest piece has less of once it is broken
MULTIPLES = (1.0, 2.0, 4.0)  # of the median height of breaking, at which pieces are counted
PRECISION = 1.3  # of a severity, as a factor; heights go with about its square
GROWTH = 2.5  # of a severity, until it does it
FARTHEST = 60.0  # times the severity of the first crack: what still holds then does not break
TILT = 5.0  # degrees: how far from upright things are set down
SET_DOWN = 20  # of these
LOW = 0.005  # m, from which
SMALL_AND_LARGE = (0.03, 0.1, 0.3)  # m

Simulator = SequentialSimulator | StructuralSimulator
Record = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Falls:
    """N falls of one body: impacts of severity 1, masses over density L³, compliances in 1 / (E L)."""

    impacts: Impacts
    masses: FloatArray
    compliances: FloatArray


def falls(simulator: Simulator, up: FloatArray) -> Falls:
    """Let a body fall with directions ``up`` (N, 3), of its own frame, upwards."""
    surface, lattice = simulator.surface, simulator.lattice
    up = up / np.linalg.norm(up, axis=1)[:, None]
    lowest = np.argmin(up @ surface.vertices.T, axis=1)
    # A face of each vertex: of all that have it, the last that is written.
    owner = np.empty(len(surface.vertices), dtype=np.int64)
    owner[surface.faces.ravel()] = np.repeat(np.arange(len(surface.faces)), 3)
    faces, points = owner[lowest], surface.vertices[lowest]
    corners = (surface.faces[faces] == lowest[:, None]).astype(float)
    cells = np.array([lattice.cell_at(int(face), point) for face, point in zip(faces, points, strict=True)])
    contacts = list(zip(cells.tolist(), points, up, strict=True))
    masses = np.array([lattice.effective_mass(lattice.force(*contact)) for contact in contacts])
    impacts = Impacts(faces[:, None], corners[:, None], up[:, None], np.ones((len(up), 1)))
    return Falls(impacts, masses, lattice.compliances(cells, points, up))


@dataclass(frozen=True, eq=False)
class Floor:
    """What a body of a material and size meets on a floor."""

    material: Material
    size: float
    floor: str

    def law(self, compliance: FloatArray) -> ContactLaw:
        """Make the contact law of bodies of compliances (N,) in 1 / (E L)."""
        body, floor = self.material, CONTACT_PRESETS[self.floor]
        elastic = (body.youngs_modulus, body.poisson_ratio, floor.youngs_modulus, floor.poisson_ratio, floor.travel)
        return ContactLaw.of(self.size, *elastic, compliance=compliance / (body.youngs_modulus * self.size))

    def heights(self, severities: FloatArray, drops: Falls) -> FloatArray:
        """Turn severities (N,) into the heights, m, from which falls have them."""
        force = np.where(np.isfinite(severities), severities, 0.0) * self.material.tensile_strength * self.size**2
        weight = drops.masses * self.material.density * self.size**3 * GRAVITY
        return np.where(np.isfinite(severities), self.law(drops.compliances).energy(force) / weight, np.inf)

    def severities(self, height: float, drops: Falls) -> FloatArray:
        """Turn a height, m, into the severities (N,) of falls."""
        weight = drops.masses * self.material.density * self.size**3 * GRAVITY
        force = self.law(drops.compliances).peak_force(weight * height)
        return np.asarray(force / (self.material.tensile_strength * self.size**2))


def shares(simulator: Simulator, labels: IntArray) -> FloatArray:
    """Measure the pieces as shares of the body, the largest first."""
    volumes = np.bincount(labels, simulator.cells.volumes)
    return np.sort(volumes / volumes.sum())[::-1]


def one(impacts: Impacts, row: int) -> Impacts:
    """Take one of several impacts."""
    only = slice(row, row + 1)
    return Impacts(impacts.faces[only], impacts.barycentric[only], impacts.directions[only], impacts.severities[only])


def chipped(share: FloatArray) -> bool:
    """Say whether a piece of more than SMALLEST has come off."""
    return bool((share >= SMALLEST).sum() > 1)


def broken(share: FloatArray) -> bool:
    """Say whether the largest piece has less than BROKEN of the body."""
    return bool(share[0] < BROKEN)


def critical(simulator: Simulator, impact: Impacts, first: float) -> tuple[float, float]:
    """Find the severities at which one impact chips and breaks a body, from that of its first crack.

    ``sequential`` says exactly, from one ramp. ``structural`` is asked again and again: breaking needs at least what
    chipping needs, and more breaks more.
    """
    if isinstance(simulator, SequentialSimulator):
        count = len(simulator.interfaces)

        def after(factor: float, ramp: Any) -> FloatArray:
            return shares(simulator, simulator.pieces(ramp.whole(factor, count)[None]).labels[0])

        def done(whole: np.ndarray) -> bool:
            return broken(shares(simulator, simulator.pieces(whole[None]).labels[0]))

        ramp = simulator.breaks(impact, 0, FARTHEST * first, done)
        steps = np.unique(ramp.factors)
        found = [np.inf, np.inf]
        for which, test in enumerate((chipped, broken)):
            low, high = 0, len(steps)  # by halves: what has come off stays off
            while low < high:
                middle = (low + high) // 2
                low, high = (low, middle) if test(after(steps[middle], ramp)) else (middle + 1, high)
            if low < len(steps):
                found[which] = float(steps[low])
        return found[0], found[1]

    known: dict[float, FloatArray] = {}

    def at(severity: float) -> FloatArray:
        if severity not in known:
            labels = simulator.fracture(impact.times(np.array([severity]))).labels[0]
            known[severity] = shares(simulator, labels)
        return known[severity]

    result, low = [], first
    for test in (chipped, broken):
        high = low
        while not test(at(high)) and high < FARTHEST * first:
            low, high = high, GROWTH * high
        if not test(at(high)):
            result.append(np.inf)
            continue
        while high > PRECISION * low:
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if test(at(middle)) else (middle, high)
        result.append(float(np.sqrt(low * high)))
    return result[0], result[1]


def make(name: str, surface: Surface, material: Material, size: float, cells: int) -> Simulator:
    """Build a simulator of a body of a material and size."""
    options = options_for_body(name, material, size, cells=cells)
    simulator = simulator_class(name).build(surface, options, np.random.default_rng(0))
    assert isinstance(simulator, SequentialSimulator | StructuralSimulator)
    return simulator


def directions(count: int, seed: int) -> FloatArray:
    """Draw directions (count, 3) evenly over the sphere."""
    return np.random.default_rng(seed).standard_normal((count, 3))


def upright(count: int) -> FloatArray:
    """Draw directions (count, 3) within TILT of upright."""
    rng = np.random.default_rng(2)
    tilt, turn = np.radians(TILT) * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.column_stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])


def case(name: str, body: str, preset: str, count: int, cells: int) -> Record:
    """Let one thing of one material fall."""
    began = time.perf_counter()
    material, size = PRESETS[preset], SIZES[body]
    simulator = make(name, read_surface(MESHES / f"{body}.obj"), material, size, cells)
    drops = falls(simulator, directions(count, 1))
    first = simulator.first_crack(drops.impacts)
    both = np.array([critical(simulator, one(drops.impacts, row), float(first[row])) for row in range(count)])
    needed = {"crack": first, "chip": both[:, 0], "broken": both[:, 1]}
    floors = {floor: Floor(material, size, floor) for floor in FLOORS}
    heights = {
        floor: {event: meets.heights(values, drops).tolist() for event, values in needed.items()}
        for floor, meets in floors.items()
    }
    typical = float(np.median(heights["stone"]["broken"]))
    pieces = []
    for multiple in MULTIPLES if np.isfinite(typical) else ():
        labels = simulator.fracture(drops.impacts.times(floors["stone"].severities(multiple * typical, drops))).labels
        pieces.append(float(np.mean([(shares(simulator, row) >= SMALLEST).sum() for row in labels])))
    set_down = falls(simulator, upright(SET_DOWN))
    low = set_down.impacts.times(floors["stone"].severities(LOW, set_down))
    cracked = np.flatnonzero(simulator.first_crack(low) < 1.0)
    fell_apart = sum(bool(simulator.fracture(one(low, row)).labels.any()) for row in cracked.tolist())
    return {
        "simulator": name, "body": body, "material": preset, "size": size, "falls": count, "heights": heights,
        "pieces": pieces, "set_down_broken": fell_apart, "speed_number": simulator.lattice.speed_number,
        "seconds": time.perf_counter() - began,
    }  # fmt: skip


def first_crack_by_size(body: str, preset: str, count: int, cells: int) -> Record:
    """Find the median height of the first crack on stone, of a thing made small and large."""
    surface, result = read_surface(MESHES / f"{body}.obj"), {}
    for size in SMALL_AND_LARGE:
        simulator = make("structural", surface, PRESETS[preset], size, cells)
        drops = falls(simulator, directions(count, 1))
        heights = Floor(PRESETS[preset], size, "stone").heights(simulator.first_crack(drops.impacts), drops)
        result[str(size)] = float(np.median(heights))
    return {"body": body, "material": preset, "crack": result}


@dataclass(frozen=True)
class Check:
    """Something that everybody knows, and what the simulators say of it."""

    says: str
    simulator: str
    got: str
    passed: bool


def share_broken(found: Record, floor: str, event: str, height: float) -> float:
    """Compute the share of falls from a height that do something to a thing."""
    return float((np.array(found["heights"][floor][event]) <= height).mean())


def checks(cases: list[Record], sizes: list[Record]) -> list[Check]:
    """Hold the results against common knowledge."""
    result = []
    for name in FALLS:
        of = {(record["body"], record["material"]): record for record in cases if record["simulator"] == name}
        mug = of["mug", "ceramic"]
        for says, floor, height, least, most in (
            ("a ceramic mug survives a fall of 0.2 m onto stone", "stone", 0.2, 0.0, 0.5),
            ("it mostly breaks from 1 m onto stone", "stone", 1.0, 0.5, 1.0),
            ("carpet saves it from 0.5 m", "carpet", 0.5, 0.0, 0.1),
        ):
            share = share_broken(mug, floor, "chip", height)
            result.append(Check(says, name, f"{share:.0%} lose a piece", least <= share <= most))
        worst = max((share_broken(of[body, "stone"], "stone", "chip", 0.05), body) for body in ("bunny", "chair"))
        says = "granite figures of 0.3 m survive 5 cm onto stone"
        result.append(Check(says, name, f"at most {worst[0]:.0%} lose a piece ({worst[1]})", worst[0] <= 0.1))
        tally = [(r["set_down_broken"], f"{r['body']}, {r['material']}") for r in of.values() if r["material"] != "ice"]
        bad = sorted((entry for entry in tally if entry[0]), reverse=True)
        got = "none breaks" if not bad else "; ".join(f"{what}: {n} of {SET_DOWN}" for n, what in bad[:4])
        result.append(Check("nothing breaks when set down upright from 5 mm onto stone, but ice", name, got, not bad))
    for record in sizes:
        heights = np.array(list(record["crack"].values()))
        got = ", ".join(f"{size} m: {height:.2g} m" for size, height in record["crack"].items())
        says = f"size changes the height of the first crack by less than 2 ({record['body']}, {record['material']})"
        result.append(Check(says, "structural", got, bool(heights.max() < 2.0 * heights.min())))
    return result


def metres(height: float) -> str:
    """Write a height."""
    return "never" if not np.isfinite(height) else f"{height:.2g}" if height < 9.5 else f"{height:.0f}"


def table(cases: list[Record], found: list[Check]) -> str:
    """Write the tables."""
    floors = " | ".join(f"piece, {floor}" for floor in FLOORS)
    lines = [
        "Median heights in m, onto stone if no other floor is named; *broken*: the largest piece has less than 90 %.",
        "",
        f"| thing | material | simulator | first crack | {floors} | broken | pieces at 1×, 2×, 4× that |",
        "|---" * (6 + len(FLOORS)) + "|",
    ]
    for record in cases:
        heights = record["heights"]
        middle = [np.median(heights["stone"]["crack"]), *(np.median(heights[floor]["chip"]) for floor in FLOORS)]
        numbers = " | ".join(metres(float(height)) for height in [*middle, np.median(heights["stone"]["broken"])])
        thing = f"{record['body']} {record['size']:g} m | {record['material']} | {record['simulator']}"
        pieces = " / ".join(f"{count:.1f}" for count in record["pieces"]) or "–"
        lines.append(f"| {thing} | {numbers} | {pieces} |")
    lines += ["", "| what everybody knows | simulator | got | holds |", "|---|---|---|---|"]
    lines += [f"| {c.says} | {c.simulator} | {c.got} | {'yes' if c.passed else '**no**'} |" for c in found]
    return "\n".join(lines) + "\n"


def spread(heights: list[float]) -> tuple[float, float, float]:
    """Quartiles of heights, of which some may be infinite."""
    low, middle, high = np.quantile(np.array(heights), [0.25, 0.5, 0.75], method="nearest")
    return float(low), float(middle), float(high)


def draw(cases: list[Record], path: Path) -> None:
    """Draw medians and quartiles of the heights onto stone, a panel for each thing and simulator."""
    import matplotlib.pyplot as plt

    bodies, names = list(SIZES), list(FALLS)
    figure, axes = plt.subplots(len(names), len(bodies), figsize=(14, 6.4), sharey=True, squeeze=False)
    for row, name in enumerate(names):
        for column, body in enumerate(bodies):
            axis = axes[row, column]
            for k, preset in enumerate(PRESETS):
                records = [r for r in cases if (r["simulator"], r["body"], r["material"]) == (name, body, preset)]
                for shift, (event, color) in enumerate(
                    zip(("crack", "chip", "broken"), ("C7", "C0", "C3"), strict=True)
                ):
                    for record in records:
                        low, middle, high = spread(record["heights"]["stone"][event])
                        x, top = k + 0.25 * (shift - 1), min(high, 1e3)
                        axis.plot([x, x], [low, top], color=color, lw=2)
                        if np.isfinite(middle):
                            axis.plot(x, middle, "o", color=color, ms=5)
            axis.set_yscale("log")
            axis.set_ylim(1e-3, 1e2)
            axis.set_xticks(range(len(PRESETS)), list(PRESETS), rotation=45, ha="right")
            axis.set_title(f"{body}, {SIZES[body]:g} m: {name}", fontsize=10)
            axis.grid(axis="y", alpha=0.3)
        axes[row, 0].set_ylabel("height of fall onto stone, m")
    events = (("first crack", "C7"), ("a piece of 1 %", "C0"), ("largest piece below 90 %", "C3"))
    handles = [plt.Line2D([], [], color=color, marker="o", label=text) for text, color in events]
    figure.legend(handles=handles, loc="upper center", ncols=3, frameon=False)
    figure.tight_layout(rect=(0, 0, 1, 0.95))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def measure(share: float, workers: int, resume: bool) -> dict[str, list[Record]]:
    """Let everything fall, ``share`` of the falls; what is measured is kept at once, so that it can be resumed."""
    path = RESULTS / "heights.json"
    counts = {name: max(int(share * count), 2) for name, count in FALLS.items()}
    work = [(name, body, preset, counts[name], CELLS) for name in FALLS for body in SIZES for preset in PRESETS]
    known = json.loads(path.read_text(encoding="utf-8"))["cases"] if resume and path.exists() else []
    cases = {(r["simulator"], r["body"], r["material"], r["falls"], CELLS): r for r in known}
    missing = [each for each in work if each not in cases]
    found = Parallel(workers, return_as="generator")(delayed(case)(*each) for each in missing)
    for each, record in zip(missing, found, strict=True):
        cases[each] = record
        print(*each, f"{record['seconds']:.0f} s", flush=True)
        path.write_text(json.dumps({"cases": [cases[key] for key in work if key in cases]}), encoding="utf-8")
    pairs = [("mug", "ceramic"), ("vase", "glass"), ("bunny", "stone")]
    sizes = Parallel(workers)(delayed(first_crack_by_size)(*pair, 100, CELLS) for pair in pairs)
    return {"cases": [cases[key] for key in work], "sizes": list(sizes)}


def main() -> None:
    """Run everything, or redraw what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="three falls of a coarse mug; nothing is written")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--share", type=float, default=1.0, help="of the falls, for a look that takes less time")
    parser.add_argument("--resume", action="store_true", help="go on where a run was stopped")
    parser.add_argument("--redraw", action="store_true", help="write table and picture from the numbers that are there")
    arguments = parser.parse_args()
    if arguments.redraw:
        results = json.loads((RESULTS / "heights.json").read_text(encoding="utf-8"))
    elif arguments.quick:
        cases = [case(name, "mug", "ceramic", 3, 100) for name in FALLS]
        print(table(cases, []))
        return
    else:
        results = measure(arguments.share, arguments.workers, arguments.resume)
    found = checks(results["cases"], results["sizes"])
    results["checks"] = [asdict(check) for check in found]
    (RESULTS / "heights.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "heights.md").write_text(table(results["cases"], found), encoding="utf-8")
    draw(results["cases"], RESULTS / "heights.png")
    print((RESULTS / "heights.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
