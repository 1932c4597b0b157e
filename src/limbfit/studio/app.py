"""The web application: the guard, the routes of every view, and the page's own files."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from ..errors import InputError, LimbfitError
from ..web.assets import STATIC as SHARED
from .folder import StudyFolder
from .guard import Door, GuardMiddleware, TooLargeError

STATIC = Path(__file__).parent / "static"
# Of every view: the modules beside this one whose names end in _routes.
ROUTES = tuple(
    import_module(f".{module.name}", __package__)
    for module in iter_modules([str(Path(__file__).parent)])
    if module.name.endswith("_routes")
)


def create_app(folder: StudyFolder, door: Door) -> FastAPI:
    """The application over one study, behind its door."""
    app = FastAPI(title="limbfit studio", docs_url=None, redoc_url=None, openapi_url=None)
    app.state.folder = folder
    for routes in ROUTES:
        app.include_router(routes.router)
    for kind, status in ((InputError, 422), (LimbfitError, 409), (FileNotFoundError, 404)):
        app.add_exception_handler(kind, _to_json(status))
    app.add_exception_handler(TooLargeError, _to_json(413))
    app.add_exception_handler(HTTPException, _respond_refused)
    app.add_exception_handler(Exception, _respond_internal)
    app.add_exception_handler(RequestValidationError, _respond_unusable)
    app.add_api_route("/", _page, include_in_schema=False)
    app.mount("/static", StaticFiles(directory=STATIC))
    app.mount("/web", StaticFiles(directory=SHARED))
    app.add_middleware(GuardMiddleware, door=door)
    return app


def _page() -> FileResponse:
    return FileResponse(STATIC / "index.html")


def _to_json(status: int) -> Any:
    def handler(request: Request, error: Exception) -> JSONResponse:
        text = str(error) or "the request is too large"
        if isinstance(error, FileNotFoundError):
            text = f"not there (yet): {error.args[0] if len(error.args) == 1 else 'a file of the study'}"
        return JSONResponse({"error": text}, status)

    return handler


def _respond_refused(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)


def _respond_internal(request: Request, error: Exception) -> JSONResponse:
    name = type(error).__name__
    text = f"internal error: {name}; set LIMBFIT_TRACEBACK=1 to see where, and please report it"
    return JSONResponse({"error": text}, 500)


def _respond_unusable(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"][1:])
    return JSONResponse({"error": f"{place}: {first['msg']}" if place else first["msg"]}, 422)
