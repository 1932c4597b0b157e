"""The study file: one ``study.toml`` beside its data, typed and checked, units in the names.

Relative paths are relative to the study file and must stay inside its folder's reach; results go to
``results/`` beside it.
"""

from .loading import load_study
from .material import MaterialTable
from .records import Indentation, Record, Site
from .study import Study
from .tables import AcquireTable, ClampsTable, IndenterTable, SolverTable, TracesTable, Vector
