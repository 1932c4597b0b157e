"""A study to stored artefacts, stage by stage: run, status, check, simulate, report, and the demo.

Names are loaded when first used: checking a study needs no solver, its status no graphics.
"""

from importlib import import_module
from typing import Any

from .shared.context import Listener, Progress

_HOME = {
    "acquire_site": "verbs.acquire",
    "check_recording": "verbs.acquire",
    "judge_recording": "verbs.acquire",
    "serve_fitsocket": "verbs.acquire",
    "virtual_fitsocket": "verbs.acquire",
    "waiting": "verbs.acquire",
    "STAGE_NAMES": "verbs.run",
    "bench_calibrate": "verbs.calibration_bench",
    "check_study": "verbs.check",
    "compare_site": "verbs.compare",
    "compress_cube": "experiments.cube",
    "design_study": "verbs.planning",
    "plan_protocol": "verbs.planning",
    "diagnose": "verbs.doctor",
    "export_study": "verbs.export",
    "make_phantom_study": "verbs.demo",
    "report_study": "verbs.run",
    "reproduce_study": "verbs.reproduce",
    "run_batch": "verbs.batch",
    "run_demo": "verbs.demo",
    "run_experiment": "verbs.run",
    "run_study": "verbs.run",
    "show_stage": "verbs.show",
    "simulate_feb": "verbs.febfile",
    "simulate_site": "verbs.simulate",
    "study_status": "verbs.run",
    "summarise": "verbs.run",
}
__all__ = ["Listener", "Progress", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
