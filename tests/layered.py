"""Blocks of layered tissue under a square punch as sites of a study: real solving without the mesher."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from editing import write_study
from limbfit.anatomy.surfaces.surfaces import Anatomy, save_anatomy
from limbfit.anatomy.surfaces.triangles import Surface
from limbfit.arrays import Array
from limbfit.bench.timing import build_block_model
from limbfit.execution import SerialExecutor
from limbfit.indentation import Parameters, Simulation, SimulationJob, SiteModel, simulate
from limbfit.mesh import Mesh, boundary_faces, to_tet10, write_vtu
from limbfit.mesh.cells import SIX_TETS, build_boxes
from limbfit.phantom.robot import Ramp, record
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import COARSE, Store, write_json
from limbfit.pipeline.records.traces import run_traces
from limbfit.pipeline.simulation.limb_geometry import find_fibre_directions
from limbfit.study import SolverTable, Study
from tetrahedra import turn_upright

TISSUES = ("skin", "fat", "muscle")
TRUTH = {
    "skin": {"c_kPa": 12.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.6},
    "fat": {"c_kPa": 2.0, "m": 4.0, "gamma": 1.0, "tau_s": 1.2},
    "muscle": {"c_kPa": 5.0, "m": 5.0, "gamma": 3.0, "tau_s": 0.3},
}
SKIN_OVER_MUSCLE = {
    "skin": {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.6},
    "muscle": {"c_kPa": 4.5, "m": 4.5, "gamma": 3.0, "tau_s": 0.3},
}

BLOCK_STUDY = """
[study]
name = "block"
[surfaces]
skin = "skin.stl"
[mesh]
element = "tet10"
[material]
{material}
[solver]
load_steps = 4
unload_steps = 3
{more}
[[sites]]
name = "a"
fitted = true
trace = "a.csv"
position = [0.0, 0.0, 0.0]
{site}
"""


def block_study(folder: Path, material: str, more: str = "", site: str = "") -> Study:
    """The study of one block, by its ``[material]``, what stands before its site ``a``, and more of that."""
    text = BLOCK_STUDY.format(material=material, more=more, site=site)
    return write_study(folder, text, ("skin.stl", "a.csv"))


BLOCK_SITE = """
[[sites]]
name = "{name}"
fitted = {fitted}
trace = "{name}.csv"
position = [0.0, 0.0, 0.0]
"""


def blocks_study(folder: Path, text: str, sites: Mapping[str, bool]) -> Study:
    """The study of ``text`` and ``sites``, which are fitted or not; records that are there stay."""
    text += "".join(
        BLOCK_SITE.format(name=name, fitted=str(fitted).lower()) for name, fitted in sites.items()
    )
    return write_study(folder, text, ("skin.stl", *(f"{name}.csv" for name in sites)))


def block_context(study: Study, truth: Parameters) -> Context:
    """That of a `block_study`, 18 mm of skin and muscle pressed by 3 mm, up to its records."""
    store = store_blocks(study, {"a": ((3.0, 15.0), 3.0, True)}, truth, 3)
    return Context(study, store, SerialExecutor(), lambda event: None)


def build_block_site(
    name: str, file: Path, mesh: Mesh, depth_mm: float, steps: SolverTable | None = None, element: str = ""
) -> SiteModel:
    """A site in the middle of a block's top, its mesh stored in ``file``; in and out at the usual speed."""
    write_vtu(mesh, file)
    return build_block_model(name, file, steps or SolverTable(), element, depth_mm)


def layered_block(
    thickness_mm: Sequence[float],
    tissues: Sequence[str] = TISSUES,
    half_mm: float = 24.0,
    divisions: int = 4,
    height_mm: float = 8.0,
) -> Mesh:
    """A block of quadratic tetrahedra whose top is z = 0; ``thickness_mm`` of each tissue, outermost first.

    ``divisions`` of its sides, of ``2 half_mm``; elements are about ``height_mm`` high.

    Node set ``fixed_bottom``, face set ``skin`` (the whole top).
    """
    side = np.linspace(-half_mm, half_mm, divisions + 1)
    ends = -np.concatenate([[0.0], np.cumsum(thickness_mm)])
    lines = [np.linspace(a, b, max(round((a - b) / height_mm), 1), endpoint=False) for a, b in pairwise(ends)]
    z = np.concatenate([*lines, ends[-1:]])[::-1]
    points, corners = build_boxes(side, side, z)
    cells = turn_upright(points, corners[:, SIX_TETS].reshape(-1, 4))
    depth = -points[cells][:, :, 2].mean(axis=1)
    regions = np.searchsorted(np.cumsum(thickness_mm)[:-1], depth)
    mesh = Mesh(points, cells, "tet4", regions, tuple(tissues))
    faces = boundary_faces(mesh)
    top = faces[(points[faces][:, :, 2] >= 0.0).all(axis=1)]
    bottom = np.flatnonzero(points[:, 2] <= ends[-1])
    return to_tet10(
        Mesh(points, cells, "tet4", regions, tuple(tissues), {"fixed_bottom": bottom}, {"skin": top})
    )


def box(sides: tuple[float, float], height: tuple[float, float]) -> Surface:
    """A closed box, outward."""
    points = np.array([[x, y, z] for x in sides for y in sides for z in height])
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Surface(points, np.array([t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))]))


def write_ramps(study: Study, model: SiteModel, truth: Parameters, random: np.random.Generator) -> None:
    """What a robot writes down of the true forces."""
    times = np.linspace(0.0, model.knots_s[-1], 201)
    job = SimulationJob(model, study.tissues, tuple(study.vector(truth)), tuple(times), False)
    force = simulate(job).force_N
    made = record(Ramp(max(model.knots_mm), 0.96), lambda t: np.interp(t, times, force), random)
    made.write(study.path(Path(f"{model.name}.csv")))


def store_blocks(
    study: Study,
    blocks: Mapping[str, tuple[Sequence[float], float, bool]],
    truth: Parameters,
    divisions: int,
    coarse: int | None = None,
    write: Callable[[Study, SiteModel, Parameters, np.random.Generator], None] = write_ramps,
) -> Store:
    """Surfaces, places, noisy records and meshes of blocks, as their stages store them.

    ``blocks``: thickness of each tissue, depth, whether fitted.  ``coarse``: divisions of a second mesh.
    ``write`` writes the records of a site.
    """
    store, tissues = Store(study.results), study.tissues
    for stage in ("sites", "traces", "mesh"):
        store[stage].mkdir(parents=True)
    bone = {"bone": box((-20.0, 20.0), (-34.0, -32.0))}
    plane = np.array([0.0, 0.0, -36.0]), np.array([0.0, 0.0, -1.0])
    anatomy = Anatomy(box((-24.0, 24.0), (-36.0, 0.0)), bone, *plane)

    def save(folder: Path) -> dict[str, object]:
        save_anatomy(folder, anatomy)
        return {}

    store.make("surfaces", "blocks", save)
    places = []
    for i, (name, (thickness, depth, fitted)) in enumerate(blocks.items()):
        mesh = layered_block(thickness, tissues, divisions=divisions)
        file, element = store["mesh"] / f"{name}.vtu", study.mesh.element
        model = build_block_site(name, file, mesh, depth, study.solver, element=element)
        if coarse is not None:
            (store["mesh"] / COARSE).mkdir(exist_ok=True)
            write_vtu(
                layered_block(thickness, tissues, divisions=coarse), store["mesh"] / COARSE / f"{name}.vtu"
            )
        model = replace(model, indenter=study.indenter, law=study.material.law, extensions=study.extensions)
        model = replace(model, course=study.material.course)
        model = replace(model, relaxation_span_s=study.material.relaxation_span_s)
        model = replace(model, fibres=find_fibre_directions(study, store.results))
        write(study, model, truth, np.random.default_rng(i))
        places.append(
            {"site": name, "region": "", "fitted": fitted, "position_mm": [0.0] * 3, "axis": [0.0, 0.0, -1.0]}
            | {"off_skin_mm": 0.0, "marker": None}
        )
    write_json(store["sites"] / "sites.json", {"sites": places})
    run_traces(Context(study, store, SerialExecutor(), lambda event: None), store["traces"])
    return store


def check_derivative(job: SimulationJob, found: Simulation, step: Array, share: float) -> None:
    """The derivative of a job's force along a ``step`` of its parameters is a central difference.

    To a ``share`` of the largest change. ``found`` is the job's simulation.
    """
    flat = np.array(job.parameters)
    ends = [replace(job, parameters=tuple(end), sensitivities=False) for end in (flat + step, flat - step)]
    ahead, back = (simulate(end).force_N for end in ends)
    change = (ahead - back) / 2.0
    assert found.jacobian is not None
    np.testing.assert_allclose(found.jacobian @ step, change, atol=share * np.abs(change).max())
