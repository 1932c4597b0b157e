"""The studio served by a thread of the tests' own process, which need not be started."""

import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import pytest
import uvicorn

from limbfit.studio.folder import StudyFolder
from limbfit.studio.guard import AccessGuard
from limbfit.studio.server import create_app


@pytest.fixture
def serve_here() -> Iterator[Callable[[Path], str]]:
    """``serve_here(study)``: the address of its page, as of ``serve``; it ends with the test."""
    running = []

    def start(study: Path) -> str:
        listener = socket.create_server(("127.0.0.1", 0))
        guard = AccessGuard("127.0.0.1", listener.getsockname()[1])
        app = create_app(StudyFolder(study / "study.toml"), guard)
        config = uvicorn.Config(app, log_level="critical", lifespan="off", timeout_graceful_shutdown=2)
        server = uvicorn.Server(config)
        thread = Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        running.append((server, thread))
        return guard.address

    yield start
    for server, thread in running:
        server.should_exit = True
        thread.join(30)
