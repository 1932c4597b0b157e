"""A FEBio input on limbfit's solver, outside any study."""

from pathlib import Path
from typing import Any

from ...fe import Step
from ...febio import run_feb
from ...fields import write_fields
from ..engine.context import Listener, Progress, ignore_progress


def simulate_feb(
    file: str | Path,
    output: str | Path | None = None,
    *,
    threads: int = 1,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Solve a FEBio 3 or 4 input; the tables that it asks for go to ``output``, by default beside it.

    The fields at the deepest point go there too, as VTU.  Without ``output`` a table that is there already,
    FEBio's own for example, is not written over but refused.

    Raises
    ------
    InputError
        Where the file cannot be read, or holds what limbfit does not know; with its line.
    RunError
        Where the tables cannot be written.
    """
    name, told = Path(file).name, 0.0

    def tell(step: Step, last: float) -> None:
        nonlocal told
        if step.time >= told:
            told = min(step.time + 0.05 * last, last)
            listener(Progress("febio", step.time, last, f"{name}: {step.force:.3g} N"))

    folder = Path(file).parent if output is None else output
    found = run_feb(file, folder, tell, keep=output is None, threads=threads)
    result = found.result
    fields = Path(folder) / f"{Path(file).stem}-peak.vtu"
    if result.states:
        write_fields(result.system, result.problem, result.states[0], fields)
    pushed = result.problem.indenter is not None
    return {
        "file": str(file),
        "completed": result.completed,
        "reason": result.reason,
        "warnings": list(result.warnings),
        "notes": list(found.notes),
        "peak_force_N": result.peak_force if pushed else None,
        "times_s": result.times.tolist(),
        "displacement_mm": result.displacement.tolist(),
        "force_N": result.force.tolist() if pushed else None,
        "penetration_mm": float(result.penetration.max(initial=0.0)),
        "element": result.statistics["element"],
        "unknowns": result.statistics["unknowns"],
        "steps": result.statistics["steps"],
        "fields": str(fields) if result.states else None,
        "files": [str(path) for path in found.files],
    }
