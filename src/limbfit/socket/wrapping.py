"""A flat sheet of cells wrapped over the face of a socket, held at landmarks.

A sheet bends and hardly stretches: neighbours keep their distances, also diagonally. From a guess, affine in
the coordinates of the limb's rays, all distances are corrected in turns while cells stay on the face and
landmarks where they are: position-based dynamics (Mueller et al., J Vis Commun Image R 2007, 18:109).
"""

import numpy as np

from ..anatomy.grid import Frame
from ..arrays import Array, Indices
from ..errors import SurfaceError
from .rays import Rays
from .sensors import SheetLayout
from .shape import Socket

ROUNDS, MOMENTUM = 600, 0.95  # of the corrections, which go on as they went
MAX_STRETCH_PERCENT = 10.0  # no sheet does that: its landmarks or its spacing are wrong


def wrap_sheet(
    layout: SheetLayout, cells: Indices, points: Array, socket: Socket, rays: Rays, frame: Frame
) -> tuple[Array, float]:
    """Wrap a sheet, whose ``cells`` (k, 2), rows and columns from 0, lie at ``points`` (k, 3) mm.

    Returns positions (rows, columns, 3) mm, on the face or on the lid over its brim, and by how many percent
    distances of neighbours are off (root of the mean square). Raises `SurfaceError` where that is more than a
    sheet can stretch.
    """
    shape, spacing, face = layout.shape, np.array(layout.spacing_mm), socket.closed_surface
    angle, station, radius = rays.coordinates(frame.to_limb(points))
    flat = (cells - cells[0]) * spacing
    # Landmarks may lie on either side of where angles start: each is as far from the first as on the sheet.
    turns = angle + 2 * np.pi * np.arange(-1, 2)[:, None]
    apart = np.hypot(radius * (turns - angle[0]), station - station[0]) - np.linalg.norm(flat, axis=1)
    angle = turns[np.abs(apart).argmin(axis=0), np.arange(len(angle))]
    known, rest = np.insert(flat, 0, 1.0, axis=1), np.indices(shape).reshape(2, -1).T
    fit = np.linalg.lstsq(known, np.column_stack([angle, station, radius]), rcond=None)[0]
    guess = np.insert((rest - cells[0]) * spacing, 0, 1.0, axis=1) @ fit
    place = face.find_nearest(frame.to_patient(rays.points(*guess.T)))[2]
    held, there = cells @ (shape[1], 1), face.find_nearest(points)[2]
    number = np.arange(len(place)).reshape(shape)
    starts = number[:, :-1], number[:-1], number[:-1, :-1], number[:-1, 1:]
    ends = number[:, 1:], number[1:], number[1:, 1:], number[1:, :-1]
    first, second = (np.concatenate([part.ravel() for part in parts]) for parts in (starts, ends))
    length = np.linalg.norm((rest[second] - rest[first]) * spacing, axis=1)
    count = np.bincount(np.concatenate([first, second]))[:, None]
    move = np.zeros_like(place)
    for _ in range(ROUNDS):
        place[held], move[held] = there, 0.0
        along = place[second] - place[first]
        step = 0.5 * (1.0 - length / np.maximum(np.linalg.norm(along, axis=1), 1e-9))[:, None] * along
        move *= MOMENTUM
        np.add.at(move, first, step / count[first])
        np.add.at(move, second, -step / count[second])
        place = face.find_nearest(place + move)[2]
    place[held] = there
    now = np.linalg.norm(place[second] - place[first], axis=1)
    stretch = 100.0 * float(np.sqrt(np.mean((now / length - 1.0) ** 2)))
    if stretch > MAX_STRETCH_PERCENT:
        raise SurfaceError(
            f"the sheet would be stretched by {stretch:.0f} % over the socket's face",
            remedy="check rows, columns and places of its landmarks, and its spacing",
        )
    return place.reshape(*shape, 3), stretch
