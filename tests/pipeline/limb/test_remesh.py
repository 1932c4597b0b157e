"""Sites on meshes of other edges than their own."""

from dataclasses import replace

import pytest

from conftest import COARSE
from limbfit import load_study, run_study
from limbfit.execution import SerialExecutor
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.limb.mesh import mesh_settings, plan_meshes, scale_edges
from limbfit.pipeline.limb.remesh import mesh_models, mesh_where_possible
from limbfit.pipeline.records.records import load_site_record


@pytest.mark.slow
def test_a_site_without_such_a_mesh_is_left_out_and_named(study):
    """The others keep theirs: here one was made, and no time is left for the other."""
    with (study / "study.toml").open("a") as stream:
        stream.write(COARSE)
    loaded, told = load_study(study), list[str]()
    run_study(loaded, until="mesh")
    context = Context(loaded, Store(loaded.results), SerialExecutor(), lambda event: None)
    models = [load_site_record(context, record).model for record in loaded.recorded]
    coarser, folder = scale_edges(mesh_settings(loaded), 1.3), study / "coarser"
    folder.mkdir()
    places = [(model.site, model.position, model.axis) for model in models]
    jobs = plan_meshes(context, folder, places[:1], coarser)
    mesh_models(jobs, models[:1], context.executor, told.append)
    hurried = replace(coarser, time_limit_s=0.01)
    jobs, lost = plan_meshes(context, folder, places, hurried), "its error is not counted"
    found = mesh_where_possible(jobs, models, context.executor, told.append, lost)
    assert found == [replace(models[0], mesh=folder / "1.vtu", mesh_digest=found[0].mesh_digest), None]
    assert found[0].mesh_digest != models[0].mesh_digest
    made, lost = told
    assert made == "mesh of site 1, coarser"
    assert lost.startswith("warning: mesh of site 2, coarser: ")
    assert lost.endswith("; its error is not counted")
