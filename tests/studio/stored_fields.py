"""Results of one site made from formulas: fields of some steps, parameters, errors and curves."""

import numpy as np
import pyvista as pv

from completing import write_result
from limbfit.mesh import Mesh, to_tet10, write_pvd, write_vtu
from limbfit.results.identification import CalibrationResult, PredictResult

STEPS = 4
BESIDE_SITE_1 = np.array([28.0, -4.5, 55.0])


def block() -> Mesh:
    grid = pv.ImageData(dimensions=(4, 4, 4), spacing=(3, 3, 3), origin=BESIDE_SITE_1).to_tetrahedra(5)
    grid.cell_data["tissue"] = np.full(grid.n_cells, "muscle")
    return to_tet10(Mesh.from_pyvista(grid, "tissue"))


def fields(mesh: Mesh, share: float) -> tuple[dict, dict]:
    """Fields that differ from cell to cell and grow with the step."""
    moved = share * np.column_stack([0 * mesh.points[:, 0], 0 * mesh.points[:, 0], -0.1 * mesh.points[:, 2]])
    count = np.arange(len(mesh.cells), dtype=float)
    cells = {"von_mises_kPa": share * count, "J": 1 - 0.01 * share * count / count.max()}
    cells |= {f"{name}_stretch": 1 + share * count for name in ("largest", "middle", "smallest")}
    cells["cauchy_kPa"] = share * np.column_stack([count + 10 * k for k in range(6)])
    return {"displacement_mm": moved}, cells


def write_outcome(results, error: float = 3.0) -> None:
    """What calibration and prediction store, as far as the view shows it."""
    parameters = {
        tissue: {"c_kPa": error, "m": 4.0, "gamma": 1.0, "tau_s": 0.5} for tissue in ("skin", "muscle")
    }
    stages = [
        {"name": name, "parameters": parameters, "iterations": [{}]}
        for name in ("one material", "two materials")
    ]
    write_result(results, CalibrationResult, {"stages": stages})
    rows = [
        {
            "site": "1",
            "record": "1",
            "region": "",
            "fitted": True,
            "error_percent": error,
            "peak_force_N": 6.0,
        }
    ]
    content = {"sites": rows, "mean_error_fitted_percent": error, "mean_error_heldout_percent": None}
    write_result(results, PredictResult, content)
    (results / "predict" / "1.csv").write_text(
        f"time_s,displacement_mm,force_measured_N,force_simulated_N\n0,0,0,0\n1,5,6,{error}\n2,0,0,0\n"
    )


def write_stored(results) -> None:
    """Outcome of site 1, its fields at every step and at the deepest point."""
    mesh = block()
    write_outcome(results)
    folder = results / "simulate" / "1"
    folder.mkdir(parents=True)
    frames = []
    for step in range(STEPS):
        file = folder / f"step-{step:04d}.vtu"
        write_vtu(mesh, file, *fields(mesh, step / (STEPS - 1)))
        frames.append((0.5 * step, file))
    write_pvd(results / "simulate" / "1.pvd", frames)
    write_vtu(mesh, results / "predict" / "1.vtu", *fields(mesh, 1.0))
