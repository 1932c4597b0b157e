"""A study to stored artefacts, stage by stage: run, status, check, simulate, report, and the demo.

Names are loaded when first used: checking a study needs no solver, its status no graphics.
"""

from importlib import import_module
from typing import Any

from .context import Listener, Progress

_HOME = {
    "acquire_site": "acquire",
    "judge_recording": "acquire",
    "serve_fitsocket": "acquire",
    "virtual_fitsocket": "acquire",
    "waiting_sites": "acquire",
    "STAGE_NAMES": "run",
    "bench_calibrate": "calibration_bench",
    "check_study": "check",
    "compare_site": "compare",
    "compress_cube": "experiments.cube",
    "design_study": "planning",
    "diagnose": "doctor",
    "export_study": "export",
    "make_phantom_study": "demo",
    "report_study": "run",
    "reproduce_study": "reproduce",
    "run_batch": "batch",
    "run_demo": "demo",
    "run_experiment": "run",
    "run_study": "run",
    "show_stage": "show",
    "simulate_feb": "febfile",
    "simulate_site": "simulate",
    "study_status": "run",
    "summarise": "run",
}
__all__ = ["Listener", "Progress", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
