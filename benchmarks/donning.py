"""Donning a socket on a whole limb, and standing on it: steps, iterations, processor seconds, memory.

    python benchmarks/donning.py --detail 6 --json socket.json
    python benchmarks/donning.py --detail 4 --cases 20 --seed 0 --json rectified.json
    python benchmarks/donning.py --detail 4 --grown --penalty 50 --json pressure.json

A synthetic residual limb: tapered, elliptical, with a rounded distal end and a rigid bone; muscle, 3 mm of
skin and a liner of 6 mm, `tet10p0`.  A socket smaller in circumference, pressed in here and relieved there,
grows onto it in 2 s, is held for 10 s, and is then pushed on by 800 N with all six coordinates free, friction
0.5: 1 s of ramp, 1 s of hold.  ``--cases`` draws rectifications: 0 to 6 % of circumference, three areas of -4
(relieved) to 6 mm (pressed in).  ``--grown`` ends when the socket has grown, with the pressure by region.
"""

import argparse
import json
import resource
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

from limbfit.fe import (
    History,
    Motion,
    NeoHookean,
    OgdenQLV,
    Problem,
    RigidBody,
    SmoothSurface,
    Step,
    StepControl,
    System,
    compute_tractions,
)
from limbfit.fe import solve as simulate
from limbfit.fe.kernel.laws import Laws
from limbfit.mesh import TET_FACES, Mesh, to_tet10

LENGTH, BRIM, TIP = 160.0, 125.0, 35.0  # mm from where the rounded end begins
SKIN, LINER = 3.0, 6.0  # mm
CLEAR = 1.5  # mm
LAWS = {
    "muscle": OgdenQLV(0.004, 4.0, 3.0, 0.3),
    "skin": OgdenQLV(0.009, 6.0, 2.0, 0.5),
    "liner": NeoHookean(0.05, kappa_ratio=100.0),
}
# Where the socket is pressed in (mm, positive) or relieved: height, mm, angle, degrees, radius, mm.
AREAS = ((40.0, 60.0, 25.0, 6.0), (70.0, 200.0, 30.0, 4.0), (20.0, 300.0, 20.0, -4.0))


def grid(n: int, rows: int, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions (k, 3) on an open box (bottom, sides up to ``height``) and quadrilaterals, outward."""
    lines = np.linspace(-1.0, 1.0, 2 * n + 1)
    quads = []
    for i in range(2 * n):
        for j in range(2 * n):
            x, y = lines[[i, i + 1]], lines[[j, j + 1]]
            quads.append([(x[0], y[0], -1), (x[0], y[1], -1), (x[1], y[1], -1), (x[1], y[0], -1)])
    around = [(a, -1.0) for a in lines[:-1]] + [(1.0, a) for a in lines[:-1]]
    around += [(a, 1.0) for a in lines[:0:-1]] + [(-1.0, a) for a in lines[:0:-1]]
    up = np.concatenate([np.linspace(-1.0, 0.0, n + 1), np.linspace(0.0, height, rows + 1)[1:]])
    for low, high in pairwise(up):
        for (a, b), (c, d) in zip(around, around[1:] + around[:1]):
            quads.append([(a, b, low), (c, d, low), (c, d, high), (a, b, high)])
    corners = np.round(np.array(quads, dtype=float).reshape(-1, 3), 9)
    points, inverse = np.unique(corners, axis=0, return_inverse=True)
    return points, inverse.reshape(-1, 4)


def limb(box: np.ndarray, radii: tuple[float, float], tip: float, taper: float) -> np.ndarray:
    """Points of a box's grid on a tapered pipe with an ellipsoid below z = 0; ``tip`` mm deep."""
    x, y, z = box.T
    flat = np.maximum(np.abs(x), np.abs(y))
    round_ = np.hypot(x, y)
    share = np.where(round_ > 0.0, flat / np.where(round_ > 0.0, round_, 1.0), 0.0)
    largest = np.maximum(flat, np.maximum(-z, 0.0))
    # below z = 0 a cube's surface is drawn onto a ball's by its angles
    turn = np.where(-z >= flat, flat / largest, 2.0 - -np.minimum(z, 0.0) / largest) * np.pi / 4
    below = z < 0.0
    across = np.where(below, np.sin(turn), 1.0)
    up = np.where(below, -tip * np.cos(turn), z)
    wide = across * (1.0 + taper * np.maximum(up, 0.0))
    unit = (
        np.where(flat > 0.0, 1.0, 0.0)[:, None]
        * np.column_stack([x, y])
        * (share / np.where(flat > 0.0, flat, 1.0))[:, None]
    )
    return np.column_stack([wide * radii[0] * unit[:, 0], wide * radii[1] * unit[:, 1], up])


def outward(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    normals, out = np.cross(b - a, c - a), np.zeros_like(points)
    for i in range(3):
        np.add.at(out, triangles[:, i], normals)
    return out / np.linalg.norm(out, axis=1)[:, None]


def halves(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def shapes(n: int, rows: int, height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Bone, skin and liner's outside over one grid of triangles, outward."""
    box, quads = grid(n, rows, height)
    triangles = halves(quads)
    skin = limb(box, (50.0, 43.0), TIP, 0.0016)
    bone = limb(box, (13.0, 12.0), 5.0, 0.0008)
    normals = outward(skin, triangles)
    normals[box[:, 2] > height - 1e-6, 2] = 0.0
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return bone, skin, skin + LINER * normals, triangles


def body(detail: int) -> tuple[Mesh, np.ndarray]:
    """The limb's mesh with its liner, and the liner's outer faces."""
    bone, skin, liner, triangles = shapes(detail, 2 * detail, LENGTH)
    normals = (liner - skin) / LINER
    muscle = skin - SKIN * normals
    shares = np.linspace(0.0, 1.0, max(2, detail // 2) + 1)
    layers = [bone + s * (muscle - bone) for s in shares] + [skin, liner]
    k, count = len(bone), len(layers)
    points = np.concatenate(layers)
    cells, regions = [], []
    ordered = np.sort(triangles, axis=1)  # the diagonals of prisms' sides match by the nodes' numbers
    for i in range(count - 1):
        a, b, c = ordered.T + i * k
        d, e, f = ordered.T + (i + 1) * k
        for tet in ((a, b, c, f), (a, b, f, e), (a, e, f, d)):
            cells.append(np.column_stack(tet))
            regions += [max(0, i - count + 4)] * len(a)
    cells, names = np.concatenate(cells), ("muscle", "skin", "liner")
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    cells[np.linalg.det(edges) < 0.0] = cells[np.linalg.det(edges) < 0.0][:, [1, 0, 2, 3]]
    linear = Mesh(points, cells, "tet4", np.array(regions), names, {}, {})
    mesh = to_tet10(linear)
    corner = mesh.cells[:, TET_FACES].reshape(-1, 3)
    on = corner[(corner >= (count - 1) * k).all(axis=1)]
    edge = {tuple(sorted(p)): m for c in mesh.cells for p, m in zip(_edges(c), c[4:].tolist())}
    faces = [[*t, *(edge[tuple(sorted((t[i], t[(i + 1) % 3])))] for i in range(3))] for t in on.tolist()]
    held = np.zeros(len(mesh.points), dtype=bool)
    held[np.arange(k)] = True
    held[mesh.points[:, 2] > LENGTH - 1e-6] = True
    for face in corner[(corner < k).all(axis=1)].tolist():
        held[[edge[tuple(sorted((face[i], face[(i + 1) % 3])))] for i in range(3)]] = True
    low = mesh.points[np.array(faces)][..., 2].min(axis=1) < BRIM + 12.0
    sets = {"held": np.flatnonzero(held)}
    return Mesh(mesh.points, mesh.cells, "tet10", mesh.regions, names, sets, {}), np.array(faces)[low]


def _edges(cell: np.ndarray) -> list[tuple[int, int]]:
    a, b, c, d = cell[:4].tolist()
    return [(a, b), (b, c), (c, a), (a, d), (b, d), (c, d)]


def socket(smaller: float, areas: tuple[tuple[float, ...], ...], spacing: float) -> SmoothSurface:
    """The rectified inner face, and 1.5 mm clear of the liner."""
    _, skin, liner, triangles = shapes(12, 24, BRIM)
    normals = (liner - skin) / LINER
    final = liner * [1.0 - smaller, 1.0 - smaller, 1.0]
    angle = np.degrees(np.arctan2(liner[:, 1], liner[:, 0]))
    for height, towards, radius, depth in areas:
        apart = (angle - towards + 180.0) % 360.0 - 180.0
        around = np.radians(apart) * np.hypot(liner[:, 0], liner[:, 1])
        fall = np.exp(-2.0 * (around**2 + (liner[:, 2] - height) ** 2) / radius**2)
        final = final - (depth * fall)[:, None] * normals
    return SmoothSurface.of(final, triangles[:, ::-1], clear=liner + CLEAR * normals, spacing=spacing)


def donned(
    mesh: Mesh,
    faces: np.ndarray,
    smaller: float,
    areas: tuple[tuple[float, ...], ...],
    mu: float,
    hard: float | None,
    grown_only: bool = False,
) -> Problem:
    grown = Motion.of([0.0, 2.0, 12.0], growth=[0.0, 1.0, 1.0])
    force = dict.fromkeys(("x", "y", "turn_x", "turn_y", "turn_z"), 0.0)
    loaded = Motion.of([0.0, 1.0, 2.0], force={**force, "z": [0.0, 800.0, 800.0]})
    shape, end = socket(smaller, areas, 2.0), GROWN_S if grown_only else 14.0
    one = RigidBody(
        shape,
        faces,
        grown if grown_only else grown.then(loaded),
        mu,
        pivot=(0.0, 0.0, LENGTH),
        name="socket",
        hardness=hard,
    )
    return Problem(
        mesh, LAWS, mesh.node_sets["held"], np.zeros((0, 6), int), None,
        History(np.array([0.0, end]), np.zeros(2)), bodies=(one,), element="tet10p0",
    )  # fmt: skip


GROWN_S = 2.0
TIMES = (
    *np.linspace(0.0, 2.0, 9)[1:], 2.1, 2.4, 3.0, 4.5, 7.0, 12.0,
    12.1, 12.25, 12.5, 12.75, 13.0, 13.1, 13.4, 14.0,
)  # fmt: skip


def pressures(problem: Problem, last: Step) -> dict[str, dict[str, float]]:
    """Largest and mean contact pressure, kPa, on the liner below the brim, and within the radius of each of
    the `AREAS`, by where it is at rest."""
    system = System(problem)
    laws = Laws.build([problem.materials[name] for name in problem.mesh.region_names])
    found = compute_tractions(system, laws, last.state, 0)
    surface = system.bodies.all[0].surface
    rest, pressure, areas = (
        surface.points_at_rest.reshape(-1, 3),
        found.pressure_kPa.ravel(),
        surface.areas.ravel(),
    )
    inside = {"below the brim": rest[:, 2] < BRIM}
    angle = np.degrees(np.arctan2(rest[:, 1], rest[:, 0]))
    for height, towards, radius, _ in AREAS:
        around = np.radians((angle - towards + 180.0) % 360.0 - 180.0) * np.hypot(rest[:, 0], rest[:, 1])
        inside[f"{height:g} mm, {towards:g} degrees"] = np.hypot(around, rest[:, 2] - height) < radius
    return {
        name: {
            "largest_kPa": float(pressure[own].max()),
            "mean_kPa": float(np.average(pressure[own], weights=areas[own])),
        }
        for name, own in inside.items()
    }


def run(problem: Problem, control: StepControl, tell: bool) -> dict:
    started, last = time.process_time(), []

    def on_step(step) -> None:
        last[:] = [step]
        if tell:
            z, r = step.coordinates[0, 2], np.round(step.reactions[0], 2).tolist()
            print(f"{step.time:8.3f} s  {step.newton_iterations:3d} its  {time.process_time() - started:7.1f}"
                  f" CPU s  z {z:.3f} mm  area {step.contact_area:.0f} mm^2  deep {step.penetration:.4f} mm"
                  f"  {r}", flush=True)  # fmt: skip

    found = simulate(problem, control, on_step=on_step, store="none")
    stats = found.statistics
    kept = ("unknowns", "steps", "cuts", "newton_iterations", "factorisations", "solves", "penalty_per_mm",
            "sunk_steps", "unbalanced_steps", "unsettled_steps")  # fmt: skip
    return {
        "completed": found.completed, "reason": found.reason, **{name: stats[name] for name in kept},
        "cpu_s": round(time.process_time() - started, 1),
        "memory_MB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "imbalance": float(found.imbalance.max()), "settled_mm": float(found.coordinates[-1, 0, 2]),
        "contact_points": 3 * len(problem.bodies[0].faces),
        "seconds": {name: round(value, 1) for name, value in stats["seconds"].items()},
        "doubts": list(found.warnings), "pressure": pressures(problem, last[0]) if last else {},
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--detail", type=int, default=6, help="elements across the rounded end, halved")
    parser.add_argument(
        "--cases", type=int, default=0, help="random rectifications instead of the stated one"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--friction", type=float, default=0.5)
    parser.add_argument("--hardness", type=float, default=None, help="of sticking, over that of contact")
    parser.add_argument("--penalty", type=float, default=None, help="1/mm")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--grown", action="store_true", help="end when the socket has grown")
    given = parser.parse_args()
    mesh, faces = body(given.detail)
    times = tuple(t for t in TIMES if t <= GROWN_S) if given.grown else TIMES
    control = StepControl(times=times, penalty=given.penalty)
    rows, failed = [], 0
    for case in range(max(given.cases, 1)):
        rng = np.random.default_rng([given.seed, case])
        smaller, areas = 0.03, AREAS
        if given.cases:
            smaller = float(rng.uniform(0.0, 0.06))
            areas = tuple((rng.uniform(10, 100), rng.uniform(0, 360), rng.uniform(15, 30), rng.uniform(-4, 6))
                          for _ in range(3))  # fmt: skip
        row = run(
            donned(mesh, faces, smaller, areas, given.friction, given.hardness, given.grown),
            control,
            not given.cases,
        )
        rows.append({"case": case, "smaller": smaller, "areas": areas, **row})
        failed += not row["completed"]
        print(json.dumps(row), flush=True)
        if given.json is not None:
            given.json.write_text(json.dumps(rows, indent=1))
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
