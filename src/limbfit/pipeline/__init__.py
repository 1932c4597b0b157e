"""A study to stored artefacts, stage by stage: run, status, check, simulate, report, and the demo.

Names are loaded when first used: checking a study needs no solver, its status no graphics.
"""

from importlib import import_module
from typing import Any

from .engine.context import Listener, Progress

_HOME = {
    "acquire_site": "commands.acquire",
    "check_recording": "commands.acquire",
    "judge_recording": "commands.acquire",
    "serve_fitsocket": "commands.acquire",
    "virtual_fitsocket": "commands.acquire",
    "waiting": "commands.acquire",
    "STAGE_NAMES": "commands.run",
    "bench_calibrate": "commands.calibration_bench",
    "check_study": "commands.check",
    "compare_site": "commands.compare",
    "compress_cube": "variants.cube",
    "design_study": "commands.planning",
    "plan_protocol": "commands.planning",
    "diagnose": "commands.doctor",
    "export_study": "commands.export",
    "make_phantom_study": "commands.demo",
    "report_study": "commands.run",
    "reproduce_study": "commands.reproduce",
    "run_batch": "commands.batch",
    "run_demo": "commands.demo",
    "run_experiment": "commands.run",
    "run_study": "commands.run",
    "show_stage": "commands.show",
    "simulate_feb": "commands.febfile",
    "simulate_site": "commands.simulate",
    "study_status": "commands.run",
    "summarise": "commands.run",
}
__all__ = ["Listener", "Progress", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
