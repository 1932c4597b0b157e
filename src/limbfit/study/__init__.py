"""The study file: one ``study.toml`` beside its data, typed and checked, units in the names.

Relative paths are relative to the study file and must stay inside its folder's reach; results go to
``results/`` beside it.
"""

from .loading import load_study as load_study
from .material import MaterialTable as MaterialTable
from .records import Indentation as Indentation
from .records import Record as Record
from .records import Site as Site
from .study import Study as Study
from .tables import AcquireTable as AcquireTable
from .tables import ClampsTable as ClampsTable
from .tables import IndenterTable as IndenterTable
from .tables import SolverTable as SolverTable
from .tables import Vector as Vector
