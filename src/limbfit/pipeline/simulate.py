"""One indentation of a study, simulated and stored for ParaView."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import InputError
from ..execution import SerialExecutor
from ..indentation import Parameters, simulate_fields
from ..study import Study
from .context import Context, Listener
from .model_stages import write_curves
from .run import keys, run_study
from .simulations import CURVE_POINTS, planned_model, recorded_model
from .store import Store, write_json


def simulate_site(
    study: Study,
    name: str,
    *,
    parameters: Parameters | None = None,
    animation: bool = False,
    listener: Listener,
) -> dict[str, Any]:
    """Simulate one indentation: as recorded, or as the study plans it; meshes are made where missing.

    Curve and fields at the deepest point go to ``results/simulate``.

    Parameters
    ----------
    parameters : per tissue; by default the identified ones, or the study's start where none were identified.
    animation : also the fields of every step, as a PVD collection.

    Raises
    ------
    InputError
        For a site that the study does not have, identified parameters that are stale, or any input of the
        stages before.
    """
    site = study.site(name)
    store = Store(study.results)
    used, origin = (parameters, "given") if parameters else known_parameters(study, store)
    run_study(study, until="mesh", listener=listener)
    context = Context(study, store, SerialExecutor(), listener)
    model = planned_model(context, site) if site.trace is None else recorded_model(context, site)
    folder = store["simulate"]
    folder.mkdir(exist_ok=True)
    context.tell("simulate", 0, 1, f"site {name}")
    played = folder / f"{name}.pvd" if animation else None
    result = simulate_fields(model, used, folder / f"{name}.vtu", played)
    context.tell("simulate", 1, 1, f"site {name}")
    times = np.linspace(0.0, model.knots_s[-1], CURVE_POINTS)
    curve = folder / f"{name}.csv"
    write_curves(
        curve,
        time_s=times,
        displacement_mm=np.interp(times, model.knots_s, model.knots_mm),
        force_N=result.force_at(times),
    )
    found = {
        "site": name,
        "parameters": used,
        "parameters_from": origin,
        "peak_force_N": result.peak_force,
        "depth_mm": max(model.knots_mm),
        "penetration_mm": float(result.penetration.max(initial=0.0)),
        "completed": result.completed,
        "reason": result.reason,
        "element": result.statistics["element"],
        "unknowns": result.statistics["unknowns"],
        "curve": str(curve),
        "fields": str(folder / f"{name}.vtu") if result.states else None,
        "animation": None if played is None else str(played),
    }
    write_json(folder / f"{name}.json", found)
    return found


def known_parameters(study: Study, store: Store) -> tuple[Parameters, str]:
    """The identified parameters, else the study's start, and which they are.

    Neither will do where the calibration is stale: it is not this study's, and who has identified a model
    does not expect the start.
    """
    if store.stamp("calibrate") is None:
        start = {tissue: study.material.of(tissue, "start") for tissue in study.tissues}
        return start, "start of the study"
    if store.state("calibrate", keys(study)["calibrate"]).state != "done":
        raise InputError(
            "the identified parameters are stale: made from other inputs, settings or code",
            file=store["calibrate"] / "calibration.json",
            remedy="identify again (limbfit run), or give --parameters",
        )
    return store.read("calibrate", "calibration.json")["stages"][-1]["parameters"], "identified"
