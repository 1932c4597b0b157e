"""The studio: a local page over a study folder, in a browser.

The server holds no state: what it shows is read from the study's files when it is asked, what is changed is
written to them, and runs are processes of their own. So a reload, a second tab or a restart loses nothing.
"""

from importlib import import_module
from typing import Any


def serve_studio(study: Any, **options: Any) -> None:
    """Serve a study's page until interrupted; see :func:`limbfit.studio.server.serve`.

    The web framework is loaded by then only: other verbs start without it.
    """
    import_module("limbfit.studio.server").serve(study, **options)
