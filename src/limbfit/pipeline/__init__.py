"""A study to stored artefacts, stage by stage: run, status, check, simulate, report, and the demo."""

from .check import check_study
from .context import Listener, Progress
from .demo import make_phantom_study, run_demo
from .run import STAGE_NAMES, report_study, run_study, study_status, summarise
from .simulate import simulate_site

__all__ = [
    "STAGE_NAMES",
    "Listener",
    "Progress",
    "check_study",
    "make_phantom_study",
    "report_study",
    "run_demo",
    "run_study",
    "simulate_site",
    "study_status",
    "summarise",
]
