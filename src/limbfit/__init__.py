"""limbfit: patient-specific viscoelastic finite-element models of residual limbs.

Everything the command line does is one call away:

========================  =========================================================
``limbfit demo``          ``run_demo(folder, seed=0, listener=print)``
``limbfit phantom``       ``make_phantom_study(folder, detail="coarse", seed=0, listener=print)``
``limbfit series``        ``describe_series(folder)``
``limbfit check``         ``check_study(load_study(path), listener=print)``
``limbfit run``           ``run_study(load_study(path), until=None, listener=print)``
``limbfit status``        ``study_status(load_study(path))``
``limbfit batch``         ``run_batch(paths, until=None, workers=0, listener=print)``
``limbfit reproduce``     ``reproduce_study(run_json, folder, tolerance=1e-6, listener=print)``
``limbfit doctor``        ``diagnose(folder)``
``limbfit surfaces``      ``show_stage(load_study(path), "surfaces", listener=print)``
``limbfit acquire``       ``acquire_site(load_study(path, recorded=False), site, address="tcp://..")``
``limbfit recording``     ``judge_recording(file)``
``limbfit virtual-fitsocket``  ``serve_fitsocket(virtual_fitsocket(load_study(path)), serving, tell=print)``
``limbfit simulate``      ``simulate_site(load_study(path), site, parameters=None, listener=print)``
``limbfit export``        ``export_study(load_study(path), "feb", site=None, listener=print)``
``limbfit compare``       ``compare_site(load_study(path), site, febio_log=None, listener=print)``
``limbfit febio``         ``simulate_feb(file, output=None, listener=print)``
``limbfit design``        ``design_study(load_study(path), sites=4, depths_mm=(), listener=print)``
``limbfit design --protocol``  ``plan_protocol(load_study(path), minutes=25, listener=print)``
``limbfit uncertainty --models``  ``compare_models(load_study(path), ["all"], listener=print)``
``limbfit socket``        ``fit_socket(load_study(path), listener=print)``
``limbfit socket design``  ``design_socket(load_study(path), optimise=(), simulations=6, listener=print)``
``limbfit cube``          ``compress_cube(folder)``, without a study
``limbfit studio``        ``serve_studio(study, port=0, browser=True, tell=print)``
``limbfit EXPERIMENT``    ``run_experiment(load_study(path), "regions", listener=print)``, and others
``limbfit schema``        ``build_schema("predict")``
``limbfit report``        ``report_study(load_study(path), listener=print)``
``limbfit bench``         ``bench_febio_parity(tell=print)``, ``bench_forward(..)``, ``bench_scaling(..)``
========================  =========================================================

Names are loaded when first used, so that a worker process that only solves does not load images and graphics.
`__init__.pyi` says where they live.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from ._version import __version__

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOME = {
    name.name: node.module
    for node in _STUB.body
    if isinstance(node, ast.ImportFrom) and node.module != "_version"
    for name in node.names
}
__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'limbfit' has no attribute {name!r}")
    return getattr(import_module(f"limbfit.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
