"""The public names and where they live: `__init__.py` finds them by this file, type checkers their types."""

from ._version import __version__ as __version__
from .anatomy.images.dicom import describe_series as describe_series
from .anatomy.images.formats import register_image_format as register_image_format
from .anatomy.surfaces.exchange import (
    compare_shapes as compare_shapes,
    convert_shape as convert_shape,
)
from .bench.parity import bench_febio_parity as bench_febio_parity
from .bench.timing import (
    bench_forward as bench_forward,
    bench_scaling as bench_scaling,
    bench_socket as bench_socket,
)
from .errors import (
    InputError as InputError,
    LimbfitError as LimbfitError,
)
from .fe import (
    History as History,
    Indenter as Indenter,
    MooneyRivlin as MooneyRivlin,
    Motion as Motion,
    NeoHookean as NeoHookean,
    Ogden as Ogden,
    FungQLV as FungQLV,
    OgdenPower as OgdenPower,
    OgdenQLV as OgdenQLV,
    OpenSurface as OpenSurface,
    Pressure as Pressure,
    Problem as Problem,
    RigidBody as RigidBody,
    RigidSurface as RigidSurface,
    SmoothSurface as SmoothSurface,
    StepControl as StepControl,
    Support as Support,
)
from .laws import (
    Parameter as Parameter,
    TissueLaw as TissueLaw,
    register_law as register_law,
)
from .mesh import (
    Mesh as Mesh,
    read_vtu as read_vtu,
    to_tet10 as to_tet10,
    write_vtu as write_vtu,
)
from .notebook import (
    Fit as Fit,
    Solution as Solution,
    calibrate as calibrate,
    solve as solve,
)
from .pipeline.commands.experiments import (
    Experiment as Experiment,
    register_experiment as register_experiment,
)
from .pipeline.variants.cube import compress_cube as compress_cube
from .pipeline.engine.context import Progress as Progress
from .pipeline.commands.acquire import (
    acquire_site as acquire_site,
    check_recording as check_recording,
    check_rig as check_rig,
    judge_recording as judge_recording,
    serve_fitsocket as serve_fitsocket,
    virtual_fitsocket as virtual_fitsocket,
    waiting as waiting,
)
from .pipeline.commands.check import check_study as check_study
from .pipeline.commands.other_solvers import compare_site as compare_site
from .pipeline.commands.demo import (
    bench_calibrate as bench_calibrate,
    make_phantom_study as make_phantom_study,
    run_demo as run_demo,
)
from .pipeline.commands.doctor import diagnose as diagnose
from .pipeline.commands.inputs import list_inputs as list_inputs
from .pipeline.commands.other_solvers import export_study as export_study
from .pipeline.commands.models import (
    compare_models as compare_models,
    fit_socket_of_models as fit_socket_of_models,
)
from .pipeline.commands.planning import (
    design_socket as design_socket,
    design_study as design_study,
    fit_socket as fit_socket,
    plan_protocol as plan_protocol,
)
from .pipeline.commands.reproduce import reproduce_study as reproduce_study
from .pipeline.commands.run import (
    STAGE_NAMES as STAGE_NAMES,
    report_study as report_study,
    run_batch as run_batch,
    run_experiment as run_experiment,
    run_study as run_study,
    study_status as study_status,
)
from .pipeline.commands.show import show_stage as show_stage
from .pipeline.commands.simulate import (
    simulate_feb as simulate_feb,
    simulate_site as simulate_site,
)
from .pipeline.commands.watch import watch_records as watch_records
from .population.shape_model import (
    ShapeModel as ShapeModel,
    build_shape_model as build_shape_model,
)
from .population.trials import (
    check_trial as check_trial,
    count_people as count_people,
    make_robust as make_robust,
    open_person as open_person,
    report_population as report_population,
    run_population as run_population,
    write_trial as write_trial,
)
from .results.study_results import (
    StudyResults as StudyResults,
    build_schema as build_schema,
    load_results as load_results,
)
from .shapes import (
    Measure as Measure,
    Shape as Shape,
    register_shape as register_shape,
)
from .studio.server import serve_studio as serve_studio
from .study.loading import load_study as load_study
from .study.study import Study as Study
from .study.writing import (
    NewStudy as NewStudy,
    create_study as create_study,
)
