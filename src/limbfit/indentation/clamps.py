"""The pins that hold the limb while one indents it, as rigid bodies under force.

The device of the source paper (section 2.1) has 14 pins in a ring.  The one at the site indents, the two
beside it stay clear of the skin so that tissue can bulge, and the other eleven press the limb with 14 to 16 N
before the test.  There they then stay where they are; here each keeps its force.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Array, Indices
from ..errors import ProblemError
from ..fe import Indenter, Motion, Problem, RigidBody
from ..fe.contact.contact import ContactSurface, find_touching_offset
from ..study import ClampsTable


def build_clamping_pins(
    points: Array, faces: Indices, indenter: Indenter, along: Array, clamps: ClampsTable
) -> dict[str, Indenter]:
    """The clamping pins by name, each off the skin at its angle; of the usual ones those that meet it.

    Parameters
    ----------
    points, faces : (n, 3) mm, and (f, 3 or more) the skin, corners first.
    indenter : the test pin, at its site.
    along : (3,) the limb's axis, proximally; the ring lies across it, in the plane of the test pin.

    Raises
    ------
    ProblemError
        Where the test pin points along the limb, where a stated pin, or every pin, misses the skin, and where
        one would lie on the test pin.
    """
    inwards = indenter.frame[2]
    normal = np.asarray(along, dtype=float) - (along @ inwards) * inwards
    if np.linalg.norm(normal) < 0.3 * np.linalg.norm(along):
        raise _build_refusal("the indenter points along the limb, where no ring of pins holds it")
    normal /= np.linalg.norm(normal)
    middles = points[faces[:, :3]].mean(axis=1) - np.asarray(indenter.centre)
    found: dict[str, Indenter] = {}
    for degrees, level in zip(clamps.angles, np.broadcast_to(clamps.levels_mm, len(clamps.angles))):
        name = f"clamp at {degrees:.4g} degrees"
        section = middles[np.abs(middles @ normal - level) < clamps.width_mm / 2.0]
        radius = 0.5 * float(np.ptp(section @ inwards)) if len(section) else 0.0
        centre = radius * inwards + level * normal
        turn = np.radians(degrees)
        axis = np.cos(turn) * inwards + np.sin(turn) * np.cross(normal, inwards)
        across, ahead = (section - centre) @ np.cross(normal, axis), (section - centre) @ axis
        ahead = ahead[(np.abs(across) < clamps.width_mm / 2.0) & (ahead < 0.0)]
        if not len(ahead):
            if clamps.angles_degrees:
                raise _build_refusal(f"the {name}, {level:g} mm along the limb, misses the skin")
            continue
        apart = float(np.linalg.norm(centre + ahead.min() * axis))
        if apart < 0.5 * (clamps.width_mm + indenter.width):
            raise _build_refusal(f"the {name} would lie on the test pin, {apart:.3g} mm off it")
        at = indenter.centre + centre - 3.0 * radius * axis
        found[name] = Indenter("square", clamps.width_mm, centre=at, axis=axis, edge=normal)
    if not found:
        raise _build_refusal("no clamping pin meets the skin")
    return found


def clamp_problem(problem: Problem, along: Array, clamps: ClampsTable) -> Problem:
    """A site's problem with the clamping pins as further bodies, which press from its beginning to its end.

    Parameters
    ----------
    problem : its indenter touches when they have pressed for `ClampsTable.begun_s`.
    along : (3,) the limb's axis, proximally.

    Raises
    ------
    ProblemError
        As `build_clamping_pins`.
    """
    mesh, indenter = problem.mesh, problem.indenter
    assert indenter is not None
    pins = build_clamping_pins(mesh.points, mesh.face_sets["skin"], indenter, along, clamps)
    bodies = tuple(_build_pin_body(problem, pin, clamps, name) for name, pin in pins.items())
    return replace(problem, bodies=(*problem.bodies, *bodies))


def _build_pin_body(problem: Problem, pin: Indenter, clamps: ClampsTable, name: str) -> RigidBody:
    """A pin that just touches the skin, pressed by its force until the end."""
    mesh, skin = problem.mesh, problem.mesh.face_sets["skin"]
    local = (mesh.points[skin[:, :3]].mean(axis=1) - pin.centre) @ pin.frame.T
    reach = 0.5 * clamps.width_mm + 8.0
    near = (np.abs(local[:, :2]) < reach).all(axis=1) & (local[:, 2] > 0.0)
    near &= local[:, 2] < local[near, 2].min() + clamps.width_mm
    surface = ContactSurface.build(problem.formulation, mesh.points, skin[near], problem.contact_rule)
    times = [0.0, clamps.clamping_s, float(problem.history.times[-1])]
    motion = Motion.of(times, force={"z": [0.0, clamps.force_N, clamps.force_N]})
    return RigidBody(pin.moved(find_touching_offset(surface, pin)), skin[near], motion, name=name)


def _build_refusal(what: str) -> ProblemError:
    remedy = "give clamps.angles_degrees or clamps.levels_mm, or leave [clamps] out"
    return ProblemError(what, place="clamps", remedy=remedy)
