"""The study file: one ``study.toml`` beside its data, typed and checked, units in the names.

Relative paths are relative to the study file and must stay inside its folder's reach; results go to
``results/`` beside it.
"""

from .acquisition import AcquireTable
from .clamps import ClampsTable
from .loading import load_study
from .material import MaterialTable
from .records import Indentation, Record, Site
from .tables import IndenterTable, SolverTable, Vector
from .whole import Study

__all__ = [
    "AcquireTable",
    "ClampsTable",
    "Indentation",
    "IndenterTable",
    "MaterialTable",
    "Record",
    "Site",
    "SolverTable",
    "Study",
    "Vector",
    "load_study",
]
