"""How near the largest forces on a study's meshes come to those on much finer ones.

    python benchmarks/default_meshes.py STUDY [--sites 01 05] [--folder runs/default-meshes]

STUDY has records (``limbfit demo``, or one of `protocols.py`); each is simulated at the start's parameters on
the study's mesh of its site and on one with 0.6 of the edges, fine to 1.5 times as far, of at most 12 mm.
Fine meshes are kept in the folder.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from limbfit import load_study, run_study
from limbfit.execution import SerialExecutor
from limbfit.mesh import read_vtu
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.identification.search import build_unknowns
from limbfit.pipeline.limb.mesh import mesh_settings, plan_meshes
from limbfit.pipeline.limb.remesh import mesh_models
from limbfit.pipeline.records.records import load_site_record
from limbfit.pipeline.simulation.simulations import SimulationCache

FINER, FARTHER, FAR_MM, GROWTH, FLATNESS = 0.6, 1.5, 12.0, 0.4, 1.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--sites", nargs="+", help="by default all")
    parser.add_argument("--folder", type=Path, default=Path("runs/default-meshes"))
    given = parser.parse_args()
    study = load_study(given.study)
    run_study(study, until="mesh", listener=lambda event: None)
    context = Context(study, Store(study.results), SerialExecutor(), lambda event: None)
    own = mesh_settings(study)
    fine = replace(
        own,
        edge_near_mm=FINER * own.edge_near_mm,
        edge_far_mm=FAR_MM,
        near_radius_mm=FARTHER * own.near_radius_mm,
        growth=GROWTH,
        flatness=FLATNESS,
    )
    start, cache = build_unknowns(study).start, SimulationCache(given.folder / "runs")
    errors = []
    for recorded in study.recorded:
        if given.sites and recorded.site.name not in given.sites:
            continue
        record = load_site_record(context, recorded)
        (given.folder / "fine").mkdir(parents=True, exist_ok=True)
        place = record.model.site, record.model.position, record.model.axis
        jobs = plan_meshes(context, given.folder / "fine", [place], fine)
        (model,) = mesh_models(jobs, [record.model], context.executor, lambda text: None)
        jobs = [one.job(start, sensitivities=False) for one in (record, replace(record, model=model))]
        found = list(cache.run(jobs, context.executor))
        if failed := [one.reason for one in found if not one.completed]:
            print(f"{record.name}: {failed[0]}", flush=True)
            continue
        peaks = [float(one.force_N.max()) for one in found]
        nodes = [len(read_vtu(one).points) for one in (record.model.mesh, model.mesh)]
        errors.append(100.0 * (peaks[0] / peaks[1] - 1.0))
        print(
            f"{record.name}: {peaks[0]:.3f} N on {nodes[0]} nodes, {peaks[1]:.3f} N on {nodes[1]}: "
            f"{errors[-1]:+.1f} %",
            flush=True,
        )
    print(f"root mean square {np.sqrt(np.mean(np.square(errors))):.1f} %, most {max(map(abs, errors)):.1f} %")


if __name__ == "__main__":
    main()
