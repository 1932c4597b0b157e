"""Cases of `robustness.py` with friction, forces and a second body: what a socket asks of the solver."""

from dataclasses import replace

import numpy as np
from mapped_bodies import Array

from limbfit.fe import History, Indenter, Motion, Problem, RigidBody
from limbfit.fe.contact.contact import ContactSurface

CLEAR_MM = 0.05  # of a second body at its start


def driven(problem: Problem, depth: float, rng: np.random.Generator) -> Problem:
    """The problem with friction up to 1, under displacement or force, alone or beside a second body.

    A force is drawn about the product of the tissue's stiffness, width and ``depth`` (mm), whatever that
    does to the limb.  The second body is a ball beside the indenter, with friction and a drive of its own.
    """
    indenter, times = problem.indenter, problem.history.times
    assert indenter is not None
    stiffness = float(np.mean([material.instantaneous_modulus for material in problem.materials.values()]))
    force = stiffness * indenter.width * depth * float(rng.uniform(0.3, 1.5))
    friction = float(rng.choice([0.0, rng.uniform(0.0, 1.0)], p=[0.2, 0.8]))
    history = problem.history
    bodies: tuple[RigidBody, ...] = ()
    if rng.uniform() < 0.5:
        history = History(times, force=np.array([0.0, force, 0.0]))
    if rng.uniform() < 0.5:
        motion = Motion.of(times, z=[0.0, 0.5 * depth, 0.0])
        if rng.uniform() < 0.5:
            motion = Motion.of(times, force={"z": [0.0, 0.3 * force, 0.0]})
        faces, rule = problem.contact_faces, problem.contact_rule
        skin = ContactSurface.build(problem.formulation, problem.mesh.points, faces, rule).points_at_rest
        skin = skin.reshape(-1, 3)
        ball = _beside(indenter, skin, float(rng.uniform(0.0, 2.0 * np.pi)))
        bodies = (RigidBody(ball, problem.contact_faces, motion, float(rng.uniform(0.0, 1.0)), name="ball"),)
    return replace(problem, history=history, friction=friction, bodies=bodies)


def _beside(indenter: Indenter, skin: Array, angle: float) -> Indenter:
    """A ball of half the indenter's width just clear of the skin, 1.2 widths beside it, where skin is."""
    across = np.cos(angle) * indenter.frame[0] + np.sin(angle) * indenter.frame[1]
    wanted = np.asarray(indenter.centre) + 1.2 * indenter.width * across
    ball = Indenter("sphere", 0.5 * indenter.width, centre=wanted, axis=indenter.axis)
    off = (skin - wanted) @ ball.frame[:2].T
    nearest = skin[np.linalg.norm(off, axis=1).argmin()]
    ball = replace(ball, centre=nearest - 30.0 * ball.frame[2])
    low, high = 0.0, 60.0
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        clear = float(ball.move(middle).signed_distance(skin).min()) > CLEAR_MM
        low, high = (middle, high) if clear else (low, middle)
    return ball.move(low)
