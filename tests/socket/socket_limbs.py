"""Limbs for the tests of the socket's shape: a round one, and real ones where they are here."""

from functools import cache
from pathlib import Path

import numpy as np

from limbfit.anatomy.surfaces.exchange import name_bodies
from limbfit.anatomy.surfaces.files import read_surface
from limbfit.anatomy.surfaces.mending import build_closed_anatomy
from limbfit.anatomy.surfaces.surfaces import Anatomy
from limbfit.anatomy.surfaces.triangles import Surface, remove_unused_points
from limbfit.socket.shape import cut_section

SHARED = Path(__file__).parents[2] / ".." / "shared" / "data"
FILES = {
    "mean": SHARED / "residuum" / "openlimb_mean.stl",
    **{f"limb-{i}": SHARED / "limbs" / f"limb-{i}.stl" for i in range(1, 10)},
}
TOP, TIP = 150.0, 0.0
CUT_NORMAL = np.array([0.0, 0.0, 1.0])


def revolved(profile: np.ndarray, around: int, centre: tuple[float, float] = (0.0, 0.0)) -> Surface:
    """A closed surface of revolution about z of (k, 2) radius and height, from its lower pole up."""
    angle = 2 * np.pi * np.arange(around) / around
    inner = profile[1:]
    rings = np.stack(
        [
            inner[:, :1] * np.cos(angle) + centre[0],
            inner[:, :1] * np.sin(angle) + centre[1],
            np.repeat(inner[:, 1:], around, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    poles = np.array([[*centre, profile[0, 1]], [*centre, profile[-1, 1]]])
    points = np.vstack([rings, poles])
    here, there = np.arange(around), np.roll(np.arange(around), -1)
    low, high = len(rings), len(rings) + 1
    faces = [np.column_stack([there, here, np.full(around, low)])]
    for k in range(len(inner) - 1):
        a, b = k * around + here, k * around + there
        faces += [np.column_stack([a, b, b + around]), np.column_stack([a, b + around, a + around])]
    last = (len(inner) - 1) * around
    faces.append(np.column_stack([last + here, last + there, np.full(around, high)]))
    return Surface(points, np.vstack(faces))


@cache
def round_limb() -> Anatomy:
    """A cone of 40 to 52 mm radius on half a ball, with a tibia in it whose top is at z = 120."""
    fall = np.linspace(0.0, np.pi / 2, 16)
    end = np.column_stack([40.0 * np.sin(fall), 40.0 - 40.0 * np.cos(fall)])
    z = np.linspace(40.0, TOP, 28)[1:]
    shank = np.column_stack([40.0 + 12.0 * (z - 40.0) / (TOP - 40.0), z])
    bone = np.array([[0.0, 25.0], [8.0, 27.0], [11.0, 60.0], [12.0, 100.0], [14.0, 118.0], [9.0, 120.0]])
    fibula = np.array([[0.0, 40.0], [4.0, 42.0], [4.0, 75.0], [5.0, 108.0], [3.0, 110.0]])
    return Anatomy(
        revolved(np.vstack([end, shank]), 72),
        {"tibia": revolved(bone, 24, (0.0, -10.0)), "fibula": revolved(fibula, 16, (-22.0, 5.0))},
        np.array([0.0, 0.0, TOP]),
        CUT_NORMAL,
    )


@cache
def real_limb(name: str) -> Anatomy:
    """A limb of OpenLimb, its bodies told apart by size and place."""
    whole = read_surface(FILES[name])
    named = name_bodies(whole, FILES[name])
    bodies = {body: remove_unused_points(Surface(whole.points, faces)) for body, faces in named.items()}
    return build_closed_anatomy(bodies.pop("skin"), bodies, None, {})[0]


def measure_circumference(surface: Surface, point: np.ndarray, normal: np.ndarray) -> float:
    """Length of a surface's section by a plane, mm: what a thread along the surface measures."""
    segments = cut_section(surface, point, normal)
    return float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum())
