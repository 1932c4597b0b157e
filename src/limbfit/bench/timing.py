"""Time and memory of single simulations, each in a process of its own: reference cases, and blocks.

Blocks are structured, of two layers and any size, under the square punch: meshes that need no mesher.
"""

import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import InputError, ProblemError, RunError
from ..execution import ProcessExecutor
from ..fe import ELEMENTS, History, Indenter, OgdenQLV, Problem, Result, StepControl, solve
from ..febio import find_febio, read_log, run_feb, run_febio
from ..indentation import SiteModel
from ..mesh import Mesh, to_tet10
from ..mesh.cells import HEX, SIX_TETS, build_boxes
from ..study import SolverTable
from . import UNKNOWNS
from .parity import GIVE_FOLDER, PUNCHED, SOCKET, Tell, find_reference, load_case

Answer = TypeVar("Answer")
CASES = {case.name: case for case in PUNCHED}
# The paper's model of one site: about 150,000 linear tetrahedra.
PAPER_ELEMENT, PAPER_DIVISIONS = "tet4", 37
CONTROL = StepControl()
MIB = 1024.0
SKIN, MUSCLE = OgdenQLV(0.009, 6.0, 2.0, 0.5), OgdenQLV(0.004, 4.0, 3.0, 0.3)
HALF, DEPTH, LAYER = 30.0, 30.0, 3.0  # mm
INDENTATION, SPEED = 6.0, 0.96  # mm, mm/s


def bench_forward(
    reference: Path | None = None,
    case: str = "residuum/posterior_tet10",
    element: str = "",
    threads: int = 1,
    as_febio: bool = False,
    beside_febio: bool = False,
    *,
    tell: Tell,
) -> dict[str, Any]:
    """Time a reference case on FEBio's mesh and steps, with limbfit's own contact or FEBio's.

    Raises `InputError` where the case is missing, the element does not fit its mesh, or FEBio is wanted
    and not there, and `RunError` where FEBio did not come to its end.

    Parameters
    ----------
    reference : folder of FEBio's results; None: ``shared/reference``, here or above.
    case : a case with an indenter in it.
    element : name in the element table; empty: that of the mesh.
    threads : of assembly and linear algebra.
    as_febio : with the element's quadrature and the contact penalty of the parity table.
    beside_febio : FEBio itself runs the case afterwards, on as many threads: ``ratio`` is its time over that
        of the plain simulation.
    """
    program = find_febio() if beside_febio else None
    if case not in CASES:
        raise InputError(f"unknown case {case!r}", remedy=f"use one of {', '.join(CASES)}")
    folder = reference or find_reference(Path.cwd())
    named = CASES[case] if as_febio else replace(CASES[case], problem={}, control={})
    problem = {**named.problem, "element": element} if element else named.problem
    control = {**named.control, "threads": threads}
    posed, stepped, _ = load_case(replace(named, problem=problem, control=control), folder)
    tell(0, 3, f"{case}, plain")
    plain = run_in_fresh_process(solve_timed, threads, posed, stepped, False)
    tell(1, 3, f"{plain['seconds']:.1f} s plain; with sensitivities")
    full = run_in_fresh_process(solve_timed, threads, posed, stepped, True)
    tell(2, 3, f"{full['seconds']:.1f} s with sensitivities")
    febio = None if program is None else time_febio(program, folder, case, threads)
    return {
        "case": case,
        **plain,
        "seconds_with_sensitivities": full["seconds"],
        "sensitivities_over_plain": full["seconds"] / plain["seconds"],
        "max_rss_with_sensitivities_MB": full["max_rss_MB"],
        "seconds_by_part_with_sensitivities": full["seconds_by_part"],
        "threads": threads,
        "as_febio": as_febio,
        "febio_seconds": febio,
        "ratio": None if febio is None else febio / plain["seconds"],
    }


def bench_socket(
    reference: Path | None = None,
    case: str = "cone",
    threads: int = 1,
    beside_febio: bool = False,
    *,
    tell: Tell,
) -> dict[str, Any]:
    """Time FEBio's input of a socket on limbfit, with FEBio's steps and contact penalty; kernels are warm.

    Parameters and errors are those of `bench_forward`; a case is one of the folder ``socket``.
    """
    program, cases = find_febio() if beside_febio else None, [one.name for one in SOCKET]
    if case not in cases:
        raise InputError(f"unknown case {case!r}", remedy=f"use one of {', '.join(cases)}")
    folder = reference or find_reference(Path.cwd())
    file = folder / "socket" / f"{case}.feb"
    if not file.is_file():
        raise InputError("is missing", file=file, remedy=GIVE_FOLDER)
    tell(0, 2, f"{case} on limbfit")
    found = run_in_fresh_process(solve_input_timed, threads, threads, file)
    tell(1, 2, f"{found['seconds']:.1f} s on limbfit")
    febio = None if program is None else time_febio(program, folder, f"socket/{case}", threads)
    ratio = None if febio is None else febio / found["seconds"]
    return {"case": case, **found, "threads": threads, "febio_seconds": febio, "ratio": ratio}


def solve_input_timed(threads: int, file: Path) -> dict[str, Any]:
    """Sizes, steps, seconds by part and largest memory of a FEBio input; its kernels are loaded before."""
    with tempfile.TemporaryDirectory(prefix="limbfit-bench-") as out:
        run_feb(file, out, times=(0.01,), threads=threads)  # compiles by one small step
        result = run_feb(file, out, threads=threads).result
    return describe_result(result)


def time_febio(program: Path, folder: Path, case: str, threads: int) -> float:
    """Seconds that FEBio takes for a reference case here and now. Raises `RunError` where it stops early."""
    file = folder / f"{case}.feb"
    with tempfile.TemporaryDirectory(prefix="limbfit-bench-") as scratch:
        shutil.copy(file, Path(scratch) / "model.feb")
        table = file.with_suffix(".txt")
        end_s = float(read_log(table).times[-1])
        run = run_febio(program, Path(scratch), end_s, table.name, threads=threads)
    if not run.verdict.is_completed:
        raise RunError(f"{file}: {run.verdict.reason}")
    return run.seconds


def bench_scaling(
    element: str = "tet10",
    unknowns: Sequence[int] = UNKNOWNS,
    threads: int = 1,
    paper_divisions: int = PAPER_DIVISIONS,
    *,
    tell: Tell,
    control: StepControl = CONTROL,
) -> dict[str, Any]:
    """Seconds and memory over unknowns, the exponent of their power law, and a model of the paper's size.

    Raises `InputError` for an element that is not in the table.

    Parameters
    ----------
    element : name in the element table.
    unknowns : about how many, two sizes or more.
    paper_divisions : cells along the side of the model of the paper's size.
    """
    control = replace(control, threads=threads)
    blocks = [(element, choose_divisions(element, size)) for size in unknowns]
    blocks.append((PAPER_ELEMENT, paper_divisions))
    rows = []
    for i, (kind, divisions) in enumerate(blocks):
        tell(i, len(blocks), f"{kind}, {divisions} cells along 60 mm")
        problem = build_punched_block(kind, divisions)
        timed = run_in_fresh_process(solve_timed, threads, problem, control, False)
        rows.append({"cells": len(problem.mesh.cells), **timed})
    tell(len(blocks), len(blocks), "done")
    *curve, paper = rows
    return {
        "element": element,
        "threads": threads,
        "sizes": curve,
        "seconds_exponent": fit_exponent(curve, "seconds"),
        "memory_exponent": fit_exponent(curve, "max_rss_MB"),
        "paper_sized": paper,
    }


def fit_exponent(rows: list[dict[str, Any]], key: str) -> float:
    """Slope of the least-squares line of log ``key`` over log unknowns."""
    x = np.log([row["unknowns"] for row in rows])
    slope, _ = np.polyfit(x, np.log([row[key] for row in rows]), 1)
    return float(slope)


def run_in_fresh_process(function: Callable[..., Answer], threads: int, *arguments: Any) -> Answer:
    """``function(*arguments)`` in a new process with that many threads: its largest memory is its own."""
    *first, last = arguments
    with ProcessExecutor(1, threads) as executor:
        return next(executor.map(partial(function, *first), [last]))


def solve_timed(problem: Problem, control: StepControl, sensitivities: bool) -> dict[str, Any]:
    """Sizes, seconds by part with warm kernels, largest memory of this process, and how far it came."""
    warm_up(problem.formulation.name, sensitivities)
    result = solve(problem, control, sensitivities, store="none")
    return describe_result(result) | {"peak_force_N": float(np.max(result.force))}


def describe_result(result: Result) -> dict[str, Any]:
    """Sizes, seconds by part, largest memory of this process, and how far a simulation came."""
    seconds = dict(result.statistics["seconds"])
    kept = ("unknowns", "element", "steps", "newton_iterations", "factorisations", "linear_solver")
    return {
        **{key: result.statistics[key] for key in kept},
        "seconds": seconds.pop("total"),
        "max_rss_MB": measure_max_rss_MB(),
        "seconds_by_part": seconds,
        "completed": result.completed,
        "reason": result.reason,
    }


def warm_up(element: str, sensitivities: bool) -> None:
    """Compile, or load from the cache, all kernels of an element with a problem of a few cells."""
    solve(build_punched_block(element, 4), StepControl(load_steps=2, unload_steps=2), sensitivities)


def measure_max_rss_MB() -> float:
    """Largest resident memory of this process so far, MiB."""
    status = Path("/proc/self/status")
    if status.is_file():  # the resource usage of a young process includes what its parent held
        lines = status.read_text().splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / MIB
    usage = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return usage / (MIB * MIB if sys.platform == "darwin" else MIB)


def build_punched_block(element: str, divisions: int) -> Problem:
    """The square punch on a block of 60 x 60 x 30 mm with a 3 mm layer; ``divisions`` cells along 60 mm."""
    mesh = build_layered_block(ELEMENTS[element].cell_type, divisions)
    ramp = INDENTATION / SPEED
    return Problem(
        mesh=mesh,
        materials={"skin": SKIN, "muscle": MUSCLE},
        fixed=mesh.node_sets["bottom"],
        contact_faces=mesh.face_sets["skin"],
        indenter=Indenter("square", 20.0, 2.0, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
        history=History(np.array([0.0, ramp, 2 * ramp]), np.array([0.0, INDENTATION, 0.0])),
        element=element,
    )


def build_block_model(
    name: str, file: Path, steps: SolverTable, element: str, depth_mm: float = INDENTATION
) -> SiteModel:
    """A site in the middle of a block's top, of a mesh that ``file`` holds."""
    ramp = depth_mm / SPEED
    return SiteModel(
        name=name,
        mesh=file,
        mesh_digest=name,
        position=(0.0, 0.0, 0.0),
        axis=(0.0, 0.0, -1.0),
        knots_s=(0.0, ramp, 2 * ramp),
        knots_mm=(0.0, depth_mm, 0.0),
        steps=steps,
        element=element,
    )


def build_layered_block(cell_type: str, divisions: int) -> Mesh:
    """Boxes of equal size below a layer; node set ``bottom``, face set ``skin`` (the whole top)."""
    side = np.linspace(-HALF, HALF, divisions + 1)
    n_below, n_above = _divide_depth(divisions)
    below, above = np.linspace(-DEPTH, -LAYER, n_below + 1), np.linspace(-LAYER, 0.0, n_above + 1)
    points, corners = build_boxes(side, side, np.concatenate([below, above[1:]]))
    cells = corners[:, HEX] if cell_type == "hex8" else corners[:, SIX_TETS].reshape(-1, 4)
    below_skin = points[cells][:, :, 2].mean(axis=1) <= -LAYER
    mesh = Mesh.from_arrays(points, cells, below_skin.astype(int), {0: "skin", 1: "muscle"})
    bottom, top = mesh.nodes_where(lambda p: p[:, 2] <= -DEPTH), mesh.faces_where(lambda p: p[:, 2] >= 0.0)
    mesh = replace(mesh, node_sets={"bottom": bottom}, face_sets={"skin": top})
    return to_tet10(mesh) if cell_type == "tet10" else mesh


def _divide_depth(divisions: int) -> tuple[int, int]:
    """Cells through the depth, below the layer and in it, of about the same size as along the side."""
    size = 2 * HALF / divisions
    return max(round((DEPTH - LAYER) / size), 1), max(round(LAYER / size), 1)


def choose_divisions(element: str, unknowns: int) -> int:
    """Fewest cells along the side for so many unknowns; `ProblemError` for an element not in the table."""
    if element not in ELEMENTS:
        raise ProblemError(f"no element {element!r}", remedy=f"use one of {', '.join(ELEMENTS)}")
    order = 2 if ELEMENTS[element].cell_type == "tet10" else 1
    divisions = 2
    while 3 * (order * divisions + 1) ** 2 * order * sum(_divide_depth(divisions)) < unknowns:
        divisions += 1
    return divisions
