"""The command line: one verb, one library call; the only place that prints and exits.

Exit codes: 0 done, 1 failed, 2 bad usage or bad input, 130 interrupted (the study can be resumed).
"""

from .app import app as app
from .app import main as main
