"""What a second speed, a second indenter and creep tell of known tissue beside one ramp."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from seen_blocks import TRUTH, estimate_at_truth

from layered import layered_block, store_blocks
from limbfit.execution import SerialExecutor
from limbfit.indentation import Parameters, SimulationJob, SiteModel, simulate
from limbfit.mesh import write_vtu
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import COARSE
from limbfit.pipeline.records.records import load_site_record, to_response
from limbfit.study import Record, Study, load_study

LAYERS = (3.0, 9.0)
STUDY = """
[study]
name = "one site"
[surfaces]
skin = "skin.stl"
[indenter]
width_mm = 10.0
edge_radius_mm = 1.5
[solver]
load_steps = 10
unload_steps = 10
penalty_per_mm = 100.0
[mesh.coarse]
edge_near_mm = 6.0
[[sites]]
name = "a"
fitted = true
trace = "a.csv"
position = [0.0, 0.0, 0.0]
"""
FURTHER = """
[indenters.ball]
shape = "sphere"
width_mm = 8.0
[[records]]
site = "a"
name = "fast"
trace = "a-fast.csv"
[[records]]
site = "a"
name = "ball"
trace = "a-ball.csv"
indenter = "ball"
[[records]]
site = "a"
name = "creep"
trace = "a-creep.csv"
control = "force"
"""
# times (s) and depths (mm), or forces (N) of the creep
HISTORIES = {
    "a": ((0.0, 3.1, 6.2), (0.0, 3.0, 0.0)),
    "a-fast": ((0.0, 0.3, 6.3, 6.6), (0.0, 3.0, 3.0, 0.0)),
    "a-ball": ((0.0, 3.1, 6.2), (0.0, 3.0, 0.0)),
    "a-creep": ((0.0, 0.5, 8.5, 9.0), (0.0, 1.2, 1.2, 0.0)),
}


def write_records(study: Study, block: SiteModel, truth: Parameters, random: np.random.Generator) -> None:
    """Those of a study whose block is meshed as its tissue is."""
    mesh = layered_block(LAYERS, study.tissues, 12.0, 6, 3.0)
    for place in (block.mesh, block.mesh.parent / COARSE / "a.vtu"):
        write_vtu(mesh, place)
    for i, record in enumerate(study.recorded):
        write_record(study, record, block, np.random.default_rng(i))


def write_record(study: Study, record: Record, base: SiteModel, random: np.random.Generator) -> None:
    """What a machine writes down of the true tissue: in finer steps, with noise."""
    times, stated = HISTORIES["a-creep" if record.forced else record.name]
    steps = study.solver.model_copy(update={"load_steps": 16, "unload_steps": 16})
    deep = tuple(3.0 * value / max(stated) for value in stated)
    force = stated if record.forced else ()
    model = replace(base, knots_s=times, knots_mm=deep, knots_N=force, steps=steps)
    model = replace(model, indenter=study.indenter_of(record))
    grid = np.unique(np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(times)]))
    found = simulate(SimulationJob(model, study.tissues, tuple(study.vector(TRUTH)), tuple(grid), False))
    assert found.completed, found.reason
    at = np.arange(-0.8, times[-1] + 0.3, 1 / 400)
    answer = np.interp(at, grid, found.force_N)
    if record.forced:
        moved, pressed = np.where(at < 0.0, 0.5 * at, answer), np.interp(at, times, stated)
    else:
        before, after = -0.4 * times[1] / stated[1], times[-1] + 0.1
        moved = np.interp(at, [before, *times, after], [-0.4, *stated, -0.3])
        pressed = np.where((at > 0.0) & (at < times[-1]), answer, 0.0)
    moved, pressed = moved + random.normal(0.0, 0.002, at.size), pressed + random.normal(0.0, 0.005, at.size)
    head = "time_s,displacement_mm,force_N"
    table = np.column_stack([at - at[0], moved + 0.4, pressed])
    np.savetxt(study.path(record.trace), table, delimiter=",", header=head, comments="")


def stored(folder: Path, text: str) -> Context:
    """A study of one block with records of known tissue, meshed."""
    for name in ("skin.stl", *(f"{name}.csv" for name in HISTORIES)):
        (folder / name).touch()
    (folder / "study.toml").write_text(text)
    study = load_study(folder)
    store = store_blocks(study, {"a": (LAYERS, 3.0, True)}, TRUTH, 4, coarse=4, write=write_records)
    return Context(study, store, SerialExecutor(), lambda event: None)


@pytest.mark.slow
def test_further_records_narrow_every_interval(tmp_path: Path) -> None:
    """At the true parameters: what the records determine of them, and no residual where nothing is wrong."""
    known = []
    for name, text in (("ramp", STUDY), ("all", STUDY + FURTHER)):
        (tmp_path / name).mkdir()
        context = stored(tmp_path / name, text)
        records, at, found = estimate_at_truth(context)
        for record, response in zip(records.own, at.responses, strict=True):
            assert np.abs(response.force_N - record.compared).mean() < 0.04 * record.compared.max()
        known.append(found)
    every = known[1]
    assert {noise.name: noise.unit for noise in every.residual_model.noise} == {
        name: "mm" if name == "a-creep" else "N" for name in HISTORIES
    }
    widths = [np.log(one.intervals_95[:, 1] / one.intervals_95[:, 0]) for one in known]
    assert (widths[1] < widths[0]).all()


@pytest.mark.slow
def test_depths_under_a_force_follow_the_parameters(tmp_path: Path) -> None:
    """The derivatives that a creep is fitted with, in the units of the study, beside differences."""
    text = STUDY.replace("load_steps = 10", "load_steps = 3").replace("unload_steps = 10", "unload_steps = 3")
    context = stored(tmp_path, text.replace('"a.csv"', '"a-creep.csv"\ncontrol = "force"'))
    (record,) = (load_site_record(context, record) for record in context.study.recorded)
    assert record.curve.unit == "mm"
    vector = context.study.vector(TRUTH)
    found = to_response(simulate(record.job(vector)))
    assert found.completed
    for i in (0, 6):  # the skin's modulus and the muscle's amplitude
        step = 1e-3 * vector[i] * np.eye(len(vector))[i]
        up, down = (simulate(record.job(vector + s, False)).force_N for s in (step, -step))
        slope = (up - down) / (2e-3 * vector[i])
        assert found.jacobian[:, i] == pytest.approx(slope, abs=5e-3 * np.abs(slope).max())
