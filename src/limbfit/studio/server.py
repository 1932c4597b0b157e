"""The studio's server: a socket on this machine, the application behind it, a browser that opens its page."""

import logging
import os
import socket
import webbrowser
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from threading import Timer

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from ..errors import InputError, LimbfitError, RunError
from ..web import STATIC as SHARED
from .folder import StudyFolder
from .guard import AccessGuard, GuardMiddleware, TooLargeError, is_loopback

STATIC = Path(__file__).parent / "static"
ERRORS = (LimbfitError, FileNotFoundError, TooLargeError, HTTPException, RequestValidationError, Exception)
# Of every view: the modules beside this one whose names end in _routes.
ROUTES = tuple(
    import_module(f".{module.name}", __package__)
    for module in iter_modules([str(Path(__file__).parent)])
    if module.name.endswith("_routes")
)


def serve_studio(
    study: str | Path,
    *,
    port: int = 0,
    host: str = "127.0.0.1",
    expose: bool = False,
    browser: bool = True,
    tell: Callable[[str], None],
) -> None:
    """Serve the page of a study until interrupted.

    Raises `InputError` for a study that cannot be read, or an address that others reach, without ``expose``;
    and `RunError` where the port is taken.

    Parameters
    ----------
    study : the study file or its folder; in a folder without one the page makes a study.
    port : 0 takes a free one.
    host : the one address to listen on; another than this machine's own (127.0.0.1, ::1) needs ``expose``.
    expose : the study may be seen and changed by whoever reaches ``host`` and has the page's address.
    browser : open the page.
    tell : is given the page's address.
    """
    path = Path(study).absolute()
    folder = StudyFolder(path / "study.toml" if path.is_dir() else path)
    if not (path.is_dir() and folder.is_new):
        folder.load()
    if not is_loopback(host) and not expose:
        remedy = "leave out --host, or say --expose to give the study to whoever has its address"
        raise InputError(f"{host} can be reached from other machines", remedy=remedy)
    if host in ("0.0.0.0", "::", ""):
        raise InputError("name one address of this machine to listen on, not all of them", place="--host")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        reason = error.strerror or str(error)
        raise RunError(f"cannot listen on {host} port {port}: {reason}; give another --port") from None
    guard = AccessGuard(host, listener.getsockname()[1])
    tell(guard.address)
    config = uvicorn.Config(
        create_app(folder, guard),
        log_level=logging.WARNING if os.environ.get("LIMBFIT_TRACEBACK") else logging.CRITICAL,
        access_log=False,  # addresses hold the token
        server_header=False,
        timeout_graceful_shutdown=2,
        lifespan="off",
        ws="none",
    )
    if browser:
        opener = Timer(0.5, webbrowser.open, (guard.address,))
        opener.daemon = True
        opener.start()
    with listener:
        uvicorn.Server(config).run(sockets=[listener])


def create_app(folder: StudyFolder, guard: AccessGuard) -> FastAPI:
    """The application over one study, protected by its guard."""
    app = FastAPI(title="limbfit studio", docs_url=None, redoc_url=None, openapi_url=None)
    app.state.folder = folder

    def respond_error(request: Request, error: Exception) -> JSONResponse:
        status, text = _describe_error(error)
        return JSONResponse({"error": text}, status)

    for routes in ROUTES:
        app.include_router(routes.router)
    for kind in ERRORS:
        app.add_exception_handler(kind, respond_error)
    app.add_api_route("/", lambda: FileResponse(STATIC / "index.html"))
    app.mount("/static", StaticFiles(directory=STATIC))
    app.mount("/web", StaticFiles(directory=SHARED))
    app.add_middleware(GuardMiddleware, guard=guard)
    return app


def _describe_error(error: Exception) -> tuple[int, str]:
    """Status and text of the answer to a request that failed."""
    match error:
        case LimbfitError():
            return (422 if isinstance(error, InputError) else 409), str(error)
        case FileNotFoundError():
            return 404, f"not there (yet): {error.args[0] if len(error.args) == 1 else 'a file of the study'}"
        case OSError() if error.strerror:
            return 409, f"a file of the study: {error.strerror}; check the folder's owner, mode and disk"
        case TooLargeError():
            return 413, "the request is too large"
        case HTTPException():
            return error.status_code, error.detail
        case RequestValidationError():
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"][1:])
            return 422, f"{place}: {first['msg']}" if place else first["msg"]
    name = type(error).__name__
    return 500, f"internal error: {name}; set LIMBFIT_TRACEBACK=1 to see where, and please report it"
