"""Closed surfaces of revolution: an analytic limb with one bone."""

import numpy as np

from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface

LENGTH, DISTAL, PROXIMAL, BONE_RADIUS = 70.0, 28.0, 34.0, 9.0


def revolved(radii: np.ndarray, heights: np.ndarray, around: int = 72) -> Surface:
    """A closed surface of revolution about z from its pole up to its pole."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    rings = [
        np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(around, z)])
        for r, z in zip(radii, heights)
    ]
    points = np.vstack([[0, 0, heights[0]], *rings, [0, 0, heights[-1]]])
    here, there = 1 + np.arange(around), 1 + (np.arange(around) + 1) % around
    faces = [np.column_stack([np.zeros(around, int), there, here])]
    for ring in range(len(radii) - 1):
        a, b = here + ring * around, there + ring * around
        faces += [np.column_stack([a, b, b + around]), np.column_stack([a, b + around, a + around])]
    last = (len(radii) - 1) * around
    faces.append(np.column_stack([here + last, there + last, np.full(around, len(points) - 1)]))
    return Surface(points, np.vstack(faces))


def limb(turn: np.ndarray | None = None, bone_offset: float = 8.0) -> Anatomy:
    """A tapered cylinder with a rounded end, cut at z = 0; one straight bone sticks out of the cut."""
    t = np.linspace(0.02, 1, 16)
    dome = np.sqrt(1 - (1 - t) ** 2)
    rise = np.linspace(0, 1, 18)[1:]
    radii = np.concatenate([DISTAL * dome, DISTAL + (PROXIMAL - DISTAL) * rise])
    heights = np.concatenate([-LENGTH - DISTAL * (1 - t), -LENGTH + LENGTH * rise])
    skin = revolved(radii, heights)
    ends = np.concatenate([dome, np.ones(6)]) * BONE_RADIUS
    bone = revolved(ends, np.concatenate([-61 - BONE_RADIUS * (1 - t), [-50, -35, -20, -5, 3, 6.0]]), 36)
    bone = Surface(bone.points + np.array([bone_offset, 0, 0]), bone.faces)
    turn = np.eye(3) if turn is None else turn
    move = np.array([12.0, -80.0, 300.0]) if turn is not None else np.zeros(3)
    skin, bone = (Surface(part.points @ turn.T + move, part.faces) for part in (skin, bone))
    return Anatomy(skin, {"tibia": bone}, move, turn[:, 2])


def ellipsoid(centre: np.ndarray, axes: np.ndarray, rings: int = 24) -> Surface:
    """A closed ellipsoid about a centre, its axes along x, y and z."""
    angle = np.linspace(0, np.pi, rings)[1:-1]
    ball = revolved(np.sin(angle), -np.cos(angle), 48)
    points = ball.points.copy()
    points[[0, -1]] = [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]
    return Surface(points * axes + centre, ball.faces)
