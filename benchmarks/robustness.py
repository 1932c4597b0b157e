"""How often does a simulation come to its end, whatever limb, indenter and material it is given?

    python benchmarks/robustness.py --cases 200 --seed 0 --json robustness.json
    python benchmarks/robustness.py --only 17 32         # some cases of the same 200

Every case is drawn from (seed, number) alone: body, site, depth, indenter, speed, and the eight material
parameters over the whole bounds of the calibration.  Each runs in a worker process with a time limit; what
came of it is ``completed``, ``partial`` (with the solver's reason), ``crash`` or ``hang``.  Completed
simulations are then held against physics; see `broken_laws`.  Cases in the file of ``--json`` are not
run again, so that a run can be stopped and gone on with.
"""

import argparse
import json
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from mapped_bodies import Array, Indices, slab
from robustness_cases import ELEMENT, USUAL, Asked, draw, problem_of

from limbfit.fe import History, Indenter, OgdenQLV, Problem, Result, solve
from limbfit.fe.result import find_slip
from limbfit.mesh import node_jacobians


@dataclass
class Outcome:
    """What came of a case; ``broken`` names the laws of `broken_laws` that a completed run breaks."""

    number: int
    outcome: str
    reason: str = ""
    broken: list[str] = field(default_factory=list)
    seconds_cpu: float = 0.0
    facts: dict[str, float] = field(default_factory=dict)
    case: dict[str, Any] = field(default_factory=dict)


def broken_laws(result: Result) -> list[str]:
    """What a completed simulation does that no body does (store="all").

    Force finite, and not negative, and not lost while the indenter advances; none after unloading;
    penetration under 1 % of the depth; no element folded at a quadrature point (the solver sees to it) or in
    its straight corners; no node inside an element that it does not belong to.  Tissue cannot enter a bone
    without one of the last two.
    """
    force, depth = result.force, float(result.displacement.max())
    broken = []
    if not np.isfinite(force).all():
        broken.append("force not finite")
    if force.min() < -1e-9 * max(force.max(), 1e-12):
        broken.append("negative force")
    if not result.problem.history.forced and find_slip(result.times, result.displacement, force):
        broken.append("force falls in loading")
    if force[-1] > 0.01 * force.max():
        broken.append("force after unloading")
    # Under a force the depth is known afterwards: the run has a rule of its own.
    sunk = result.statistics["sunk_steps"] > 0 if result.problem.history.forced else False
    if sunk or (not result.problem.history.forced and result.penetration.max() > 0.01 * depth):
        broken.append("penetration above 1 %")
    mesh = result.problem.mesh
    for state in result.states:
        points = mesh.points + state.u
        if (_corner_volumes(points, mesh.corners) <= 0.0).any():
            broken.append("folded element")
            break
    peak = max(result.states, key=lambda state: state.displacement)
    if _self_penetrating(mesh.points + peak.u, mesh.corners):
        broken.append("tissue inside tissue")
    return broken


def _corner_volumes(points: Array, corners: Indices) -> Array:
    """Six times the volumes (m,) of the straight tetrahedra."""
    at = points[corners]
    return np.linalg.det(at[:, 1:] - at[:, :1])


def _self_penetrating(points: Array, corners: Indices, tolerance: float = 0.05) -> int:
    """How many corner nodes lie inside (by ``tolerance`` in barycentric terms) a tetrahedron not theirs."""
    at = points[corners]
    low, high = at.min(axis=1), at.max(axis=1)
    inverse = np.linalg.pinv((at[:, 1:] - at[:, :1]).transpose(0, 2, 1))
    count = 0
    for node in np.unique(corners):
        boxes = np.flatnonzero(((points[node] > low) & (points[node] < high)).all(axis=1))
        boxes = boxes[(corners[boxes] != node).all(axis=1)]
        inside = np.einsum("mij,mj->mi", inverse[boxes], points[node] - at[boxes, 0])
        shares = np.column_stack([1.0 - inside.sum(axis=1), inside])
        count += bool((shares.min(axis=1) > tolerance).any())
    return count


def run_case(seed: int, number: int, asked: Asked = USUAL) -> Outcome:
    """Draw, build and solve one case; an exception is a crash with its last line as the reason."""
    started = time.process_time()
    case = draw(seed, number)
    try:
        problem = problem_of(case, seed, asked)
        result = solve(problem, store="all")
    except Exception:
        reason = traceback.format_exc().strip().splitlines()
        spent = time.process_time() - started
        return Outcome(number, "crash", f"{reason[-1]} ({reason[-3].strip()})", [], spent, {}, asdict(case))
    spent = time.process_time() - started
    done = result.completed
    outcome = Outcome(number, "completed" if done else "partial", result.reason, [], spent, case=asdict(case))
    outcome.broken = broken_laws(result) if done else []
    outcome.facts = _facts(result)
    return outcome


def _facts(result: Result) -> dict[str, float]:
    names = ("steps", "newton_iterations", "factorisations", "solves", "cuts", "unknowns")
    folded = 0
    for state in result.states:
        shape = result.problem.mesh.with_points(result.problem.mesh.points + state.u)
        folded = max(folded, int((node_jacobians(shape) <= 0).any(axis=1).sum()))
    return {name: float(result.statistics[name]) for name in names} | {
        "depth_mm": float(np.max(result.displacement)),
        "reached_mm": float(result.displacement.max()),
        "reached_share": float(result.times[-1] / result.problem.history.times[-1]),
        "peak_force_N": result.peak_force,
        "penetration_share": float(result.penetration.max() / result.displacement.max())
        if result.displacement.max() > 0
        else 0.0,
        "cells_folded_at_nodes": float(folded),
    }


class Worker:
    """A process that runs cases; replaced when a case takes too long or takes it down.

    The limit is of the process's own time (its profiling timer ends it), so that a busy machine makes no
    hang; ten times as long on the clock is the limit for a process that only waits.
    """

    def __init__(self, seed: int, limit_s: float, asked: Asked = USUAL) -> None:
        self.seed, self.limit_s, self.asked = seed, limit_s, asked
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, far = context.Pipe()
        arguments = (far, self.seed, self.limit_s, self.asked)
        self.process = context.Process(target=_serve, args=arguments, daemon=True)
        self.process.start()
        far.close()
        self.pipe.recv()  # ready: kernels are compiled

    def run(self, number: int) -> Outcome:
        case = asdict(draw(self.seed, number))
        try:
            self.pipe.send(number)
            if self.pipe.poll(10.0 * self.limit_s):
                return self.pipe.recv()
            found = Outcome(number, "hang", f"waits for more than {10.0 * self.limit_s:g} s", case=case)
        except (EOFError, OSError):  # the other end is gone
            self.process.join()
            found = Outcome(number, "crash", f"the process died (exit {self.process.exitcode})", case=case)
            if self.process.exitcode == -signal.SIGPROF:
                reason = f"not done after {self.limit_s:g} s of processor time"
                found = Outcome(number, "hang", reason, [], self.limit_s, case=case)
        self.stop()
        self._start()
        return found

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Connection, seed: int, limit_s: float, asked: Asked) -> None:
    """Warm up, then run the cases that are asked for."""
    body = slab(10.0, 2.0, 5.0, 20.0, 0.0, 0.0, 1)
    tool = Indenter(centre=body.site, axis=body.inward, width=8.0)
    materials = {"skin": OgdenQLV(0.009, 6.0, 2.0, 0.5), "muscle": OgdenQLV(0.004, 4.0, 3.0, 0.3)}
    history = History(np.array([0.0, 0.5]), np.array([0.0, 0.5]))
    solve(Problem(body.mesh, materials, body.held, body.mesh.face_sets["skin"], tool, history))
    pipe.send("ready")
    while True:
        number = pipe.recv()
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        outcome = run_case(seed, number, asked)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        pipe.send(outcome)


def run_all(
    seed: int, numbers: list[int], limit_s: float, workers: int, asked: Asked = USUAL
) -> Iterator[Outcome]:
    """Outcomes as they come, in order, from a number of workers."""
    made = [Worker(seed, limit_s, asked) for _ in range(workers)]
    idle = list(made)

    def one(number: int) -> Outcome:
        worker = idle.pop()
        try:
            return worker.run(number)
        finally:
            idle.append(worker)

    try:
        with ThreadPoolExecutor(workers) as pool:
            yield from pool.map(one, numbers)
    finally:
        for worker in made:
            worker.stop()


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Rates, and the 50th, 90th and 100th percentile of what the cases cost."""
    counts = Counter(outcome.outcome for outcome in outcomes)
    lawful = sum(o.outcome == "completed" and not o.broken for o in outcomes)
    costs = {}
    for name in ("newton_iterations", "factorisations", "cuts"):
        costs[name] = _spread([o.facts[name] for o in outcomes if name in o.facts])
    costs["seconds_cpu"] = _spread([o.seconds_cpu for o in outcomes])
    return {
        "cases": len(outcomes),
        "outcomes": dict(counts),
        "completed_percent": 100.0 * counts["completed"] / max(len(outcomes), 1),
        "completed_and_lawful_percent": 100.0 * lawful / max(len(outcomes), 1),
        "broken": dict(Counter(law for o in outcomes for law in o.broken)),
        "costs": costs,
    }


def _spread(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    p50, p90, p100 = np.percentile(values, [50, 90, 100])
    return {"median": float(p50), "p90": float(p90), "max": float(p100), "sum": float(np.sum(values))}


def _line(outcome: Outcome) -> str:
    facts, case = outcome.facts, outcome.case
    cost = " ".join(
        f"{short} {facts[name]:.0f}"
        for short, name in (("it", "newton_iterations"), ("fact", "factorisations"), ("cuts", "cuts"))
        if name in facts
    )
    depth = f"{facts['depth_mm']:.1f} mm ({100 * case['depth_share']:.0f} %)" if facts else ""
    tail = "; ".join(filter(None, [outcome.reason, *outcome.broken]))
    head = f"{outcome.number:4d} {outcome.outcome:9s} {case['site']:12s} {case['tool']:14s} {depth:17s}"
    return f"{head} {cost}  {outcome.seconds_cpu:.1f} s  {tail}".rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200, help="how many cases (default 200)")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another set of cases")
    parser.add_argument("--only", type=int, nargs="+", help="run these cases alone")
    parser.add_argument("--workers", type=int, default=1, help="processes side by side")
    parser.add_argument(
        "--limit", type=float, default=900.0, help="processor seconds until a case counts as hanging"
    )
    parser.add_argument("--element", default=ELEMENT, help=f"name in the element table (default {ELEMENT})")
    parser.add_argument("--driven", action="store_true", help="with friction, forces and second bodies")
    parser.add_argument(
        "--json", type=Path, help="write every case and the summary here; cases found there are kept"
    )
    options = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    numbers = options.only or list(range(options.first, options.first + options.cases))
    asked = Asked(options.element, options.driven)
    kind = {"seed": options.seed, **asdict(asked)}
    outcomes = [] if options.json is None else _earlier(options.json, kind)
    wanted = [number for number in numbers if number not in {outcome.number for outcome in outcomes}]
    for outcome in run_all(options.seed, wanted, options.limit, options.workers, asked):
        outcomes = sorted([*outcomes, outcome], key=lambda o: o.number)
        print(_line(outcome), flush=True)
        if options.json is not None:
            content = {**kind, "summary": summary(outcomes), "cases": [asdict(o) for o in outcomes]}
            options.json.write_text(json.dumps(content, indent=1))
    _report(outcomes, options.seed, options.driven)


def _earlier(path: Path, kind: dict[str, Any]) -> list[Outcome]:
    """The outcomes in the file of an earlier run, if there is one and it was of the same kind."""
    if not path.exists():
        return []
    content = json.loads(path.read_text())
    if {name: content.get(name, False) for name in kind} != kind:
        sys.exit(f"{path} holds cases of another seed, element or kind; name another file")
    return [Outcome(**case) for case in content["cases"]]


def _report(outcomes: list[Outcome], seed: int, driven: bool) -> None:
    print(json.dumps(summary(outcomes), indent=1))
    wrong = [o for o in outcomes if o.outcome != "completed" or o.broken]
    for outcome in wrong:
        why = "; ".join(filter(None, [outcome.reason, *outcome.broken]))
        command = (
            f"python benchmarks/robustness.py --seed {seed} --only {outcome.number}{' --driven' * driven}"
        )
        print(f"{outcome.outcome}: {why}\n    {command}")
    sys.exit(0 if not wrong else 1)


if __name__ == "__main__":
    main()
