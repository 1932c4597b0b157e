"""The studio's server: a socket on this machine only, and a browser that opens its page."""

from __future__ import annotations

import logging
import os
import socket
import webbrowser
from collections.abc import Callable
from pathlib import Path
from threading import Timer

import uvicorn

from ..errors import InputError, RunError
from .app import create_app
from .folder import StudyFolder
from .guard import Door, is_loopback


def serve(
    study: str | Path,
    *,
    port: int = 0,
    host: str = "127.0.0.1",
    expose: bool = False,
    browser: bool = True,
    tell: Callable[[str], None],
) -> None:
    """Serve the page of a study until interrupted.

    Parameters
    ----------
    study : the study file or its folder.
    port : 0 takes a free one.
    host : the one address to listen on; another than this machine's own (127.0.0.1, ::1) needs ``expose``.
    expose : the study may be seen and changed by whoever reaches ``host`` and has the page's address.
    browser : open the page.
    tell : is given the page's address.

    Raises
    ------
    InputError
        For a study that cannot be read, or an address that others reach, without ``expose``.
    RunError
        Where the port is taken.
    """
    folder = StudyFolder(_find_study_file(study))
    folder.load()
    if not is_loopback(host) and not expose:
        raise InputError(
            f"{host} can be reached from other machines",
            remedy="leave out --host, or say --expose to show and give the study to whoever has its address",
        )
    if host in ("0.0.0.0", "::", ""):
        raise InputError("name one address of this machine to listen on, not all of them", place="--host")
    listener = _open_socket(host, port)
    door = Door(host, listener.getsockname()[1])
    tell(door.address)
    config = uvicorn.Config(
        create_app(folder, door),
        log_level=logging.WARNING if os.environ.get("LIMBFIT_TRACEBACK") else logging.CRITICAL,
        access_log=False,  # addresses hold the token
        server_header=False,
        timeout_graceful_shutdown=2,
        lifespan="off",
        ws="none",
    )
    if browser:
        opener = Timer(0.5, webbrowser.open, (door.address,))
        opener.daemon = True
        opener.start()
    with listener:
        uvicorn.Server(config).run(sockets=[listener])


def _find_study_file(study: str | Path) -> Path:
    path = Path(study).absolute()
    return path / "study.toml" if path.is_dir() else path


def _open_socket(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        reason = error.strerror or str(error)
        raise RunError(f"cannot listen on {host} port {port}: {reason}; give another --port") from None
    listener.set_inheritable(False)
    return listener
