"""What a socket needs beside FEBio's stored results: friction, press fit, force, follower pressure."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from blocks import MUSCLE, SKIN, block

from limbfit.fe import (
    History,
    Indenter,
    Motion,
    OpenSurface,
    Problem,
    RigidBody,
    StepControl,
    Support,
    System,
    iterate,
)
from limbfit.febio import FaceWise, mean_penalty, run_feb
from limbfit.febio.logs import read_log
from limbfit.febio.model import Contact
from limbfit.mesh import Mesh

SOCKET = Path(__file__).parents[3] / "shared" / "reference" / "socket"
pytestmark = pytest.mark.skipif(
    not SOCKET.is_dir(), reason="the FEBio reference results are not beside the repository"
)


@pytest.mark.slow
def test_a_dragged_block_is_febios():
    """A plate presses 1.5 mm, is dragged 6 mm and back, with mu 0.3: within 1 % of the largest force while it
    slips, and within 3 % while it goes over from sticking to slipping.

    At the end of pressing the normal force is 1.6 % above FEBio's, where 1 % was aimed at.
    """
    log = read_log(SOCKET / "slide.txt")
    lines = np.linspace(0.0, 20.0, 9)
    mesh = block("hex8", lines, lines, np.linspace(-10.0, 0.0, 6))
    turns = np.array([[0.0, 0.0], [0.0, 0.0], [6.0, 0.0], [0.0, 0.0]])
    history = History(np.array([0.0, 1.0, 3.0, 5.0]), np.array([0.0, 1.55, 1.55, 1.55]), turns)
    plate = Indenter("square", 60.0, centre=(10.0, 10.0, 0.05), axis=(0, 0, -1), edge=(1, 0, 0))
    problem = Problem(
        mesh, {"skin": MUSCLE, "muscle": MUSCLE}, mesh.node_sets["bottom"], mesh.face_sets["top"], plate,
        history, start="as-given", friction=0.3,
    )  # fmt: skip
    contact = Contact("sliding-elastic", ("skin", "face"), 10.0, True, False, 0)
    times = tuple(log.times[log.times > 0.0])
    control = StepControl(
        times=times, stress="linear", penalty=mean_penalty(contact, problem, times[0]), penetration=1.0,
        hold_penalty=True,
    )  # fmt: skip
    system = System(problem)
    weights = FaceWise(system, contact, np.array(times))
    found = []
    for step in iterate(problem, control, system=system):
        weights.after(step)
        found.append(step.reaction @ system.indenter.frame)
    assert len(found) == len(times)
    expected = np.column_stack([log.column(name)[log.times > 0.0] for name in ("Fx", "Fy", "Fz")])
    off = np.abs(np.array(found) - expected).max(axis=1) / np.abs(expected).max()
    t = np.array(times)
    turning = ((t > 1.0) & (t < 1.5)) | ((t > 3.0) & (t < 3.5))
    pressing = t <= 1.0
    assert off[~turning & ~pressing].max() < 0.01
    assert off[turning].max() < 0.03
    assert off[pressing].max() < 0.02


@dataclass(frozen=True)
class Input:
    """A FEBio input as arrays: the tissue's mesh, sets and faces, all points, the faces of a socket."""

    mesh: Mesh
    faces: np.ndarray
    points: np.ndarray
    rigid: np.ndarray

    @classmethod
    def read(cls, case: str) -> Input:
        mesh = ET.parse(SOCKET / f"{case}.feb").getroot().find("Mesh")
        nodes = {int(node.get("id")): node.text.split(",") for node in mesh.find("Nodes")}
        points, number = np.array(list(nodes.values()), dtype=float), {id: i for i, id in enumerate(nodes)}

        def listed(text: str) -> list[int]:
            return [number[int(id)] for id in text.split(",")]

        parts = {group.get("name"): [listed(e.text) for e in group] for group in mesh.findall("Elements")}
        surfaces = {group.get("name"): [listed(e.text) for e in group] for group in mesh.findall("Surface")}
        cells = np.array([*parts["part1"], *parts["part2"]])
        used = np.unique(cells)
        own = np.full(len(points), -1)
        own[used] = np.arange(len(used))
        regions = np.repeat([0, 1], [len(parts["part1"]), len(parts["part2"])])
        sets = {group.get("name"): own[listed(group.text)] for group in mesh.findall("NodeSet")}
        tissue = Mesh(points[used], own[cells], "hex8", regions, ("skin", "muscle"), sets, {})
        rigid = np.array(surfaces.get("face", []), dtype=int).reshape(-1, 4)
        return cls(tissue, own[np.array(surfaces["skin"])], points, rigid)

    def problem(self, seconds: float, **more) -> Problem:
        sets = self.mesh.node_sets
        held = Support(sets["y0"], 1), Support(sets["x0"], 0)
        return Problem(
            self.mesh, {"skin": SKIN, "muscle": MUSCLE}, sets["core"], self.faces, None,
            History(np.array([0.0, seconds]), np.zeros(2)), supports=held, **more,
        )  # fmt: skip


PUSHED_ON = Motion.of([0.0, 2.5, 5.5], z=[0.0, 25.0, 25.0])
LOADED = Motion.of([0.0, 1.0, 3.0, 4.0, 5.0], force={"z": [3.457002666, 5.185503999, 5.185503999, 0.0, 0.0]})


def donned(motion: Motion, case: str) -> tuple[np.ndarray, ...]:
    """Times, coordinates along z, forces (n, 3) of the socket and the same of FEBio, at FEBio's steps."""
    given, log = Input.read(case), read_log(SOCKET / f"{case}.txt")
    triangles = np.vstack([given.rigid[:, [0, 1, 2]], given.rigid[:, [0, 2, 3]]])
    socket = RigidBody(OpenSurface(given.points, triangles), given.faces, motion, 0.3, name="socket")
    problem = given.problem(motion.times[-1], bodies=(socket,))
    kept = log.times > 0.0
    times = log.times[kept]
    contact = Contact("sliding-elastic", ("skin", "face"), 10.0, True, False, 0)
    control = StepControl(
        times=tuple(times), stress="linear", penalty=mean_penalty(contact, problem, times[0]),
        penetration=1.0, hold_penalty=True, most_iterations=10**5,
    )  # fmt: skip
    system = System(problem)
    weights, found = FaceWise(system, contact, times), []
    for step in iterate(problem, control, system=system):
        weights.after(step)
        found.append((step.time, step.coordinates[0, 2], *step.reactions[0, :3]))
    reached = np.array(found)
    at = np.searchsorted(times, reached[:, 0] - 1e-9)
    there = np.isclose(times[np.minimum(at, len(times) - 1)], reached[:, 0])  # steps between FEBio's are cuts
    expected = np.column_stack([log.column(name)[kept] for name in ("z", "Fx", "Fy", "Fz")])[at[there]]
    return reached[there, 0], reached[there, 1:], expected


@pytest.mark.slow
def test_a_press_fit_with_friction_is_febios():
    """A conical limb in a conical socket: pushed on with mu 0.3, then held."""
    t, found, expected = donned(PUSHED_ON, "cone")
    assert t[-1] == pytest.approx(5.5)
    off = np.abs(found[:, 1:] - expected[:, 1:]) / np.abs(expected[:, 1:]).max()
    pushing = t <= 2.5
    assert off[pushing, 2].max() < 0.01  # axial
    assert off[pushing, :2].max() < 0.02  # radial
    assert off[~pushing].max() < 0.03


@pytest.mark.slow
def test_a_follower_pressure_is_febios(tmp_path):
    """2 kPa on the lower half of a tube's outside: the meridian's displacement within 1 % of its largest.

    The whole way: FEBio's own input, solved with its steps, and the table that it asks for.
    """
    run, log = run_feb(SOCKET / "tube.feb", tmp_path), read_log(SOCKET / "tube.txt")
    assert run.result.completed, run.result.reason
    found = read_log(tmp_path / "tube.txt")
    np.testing.assert_allclose(found.times, log.times, rtol=1e-6)
    off = np.abs(found.values - log.values).max()
    assert off < 0.01 * np.abs(log.values - log.values[0]).max()


@pytest.mark.slow
def test_a_load_on_the_socket_is_nearly_febios():
    """Then pressed on by 5.2 N, left to creep, and let go: the way within 2 % of its largest, where 1 % was
    aimed at; FEBio's socket slips on where limbfit's sticks."""
    t, found, expected = donned(PUSHED_ON.then(LOADED), "cone-load")
    assert t[-1] == pytest.approx(10.5)
    off = np.abs(found[:, 0] - expected[:, 0]) / expected[:, 0].max()
    assert off.max() < 0.02
    assert off[t <= 6.5].max() < 0.006
    forced = t > 5.5
    np.testing.assert_allclose(found[forced, 3], expected[forced, 3], atol=2e-3)
