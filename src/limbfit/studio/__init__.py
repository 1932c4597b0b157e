"""The studio: a local page over a study folder, in a browser.

The server holds no state: what it shows is read from the study's files when it is asked, what is changed is
written to them, and runs are processes of their own. So a reload, a second tab or a restart loses nothing.

FastAPI and uvicorn come with ``pip install 'limbfit[studio]'``; without them this room imports nothing else.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from ..errors import RunError

NEEDED = ("fastapi", "uvicorn", "tomlkit")


def serve_studio(study: Any, **options: Any) -> None:
    """Serve a study's page until interrupted; see :func:`limbfit.studio.server.serve`.

    Raises
    ------
    RunError
        Where what the studio needs is not installed.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise RunError(
            f"the studio needs {' and '.join(missing)}, which is not installed; pip install 'limbfit[studio]'"
        )
    import_module("limbfit.studio.server").serve(study, **options)
