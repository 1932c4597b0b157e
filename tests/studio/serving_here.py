"""The studio in the tests' own process, which need not be started: asked itself, or served by a thread."""

import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import pytest
import uvicorn
from fastapi.testclient import TestClient

from limbfit.studio.folder import StudyFolder
from limbfit.studio.guard import AccessGuard
from limbfit.studio.server import create_app


def open_page(study: Path) -> TestClient:
    """The page of a study as its browser talks to the studio; an error of the studio is an answer to it."""
    guard = AccessGuard("127.0.0.1", 8123)
    origin = f"http://{guard.host}:{guard.port}"
    app = create_app(StudyFolder(study / "study.toml"), guard)
    client = TestClient(app, base_url=origin, headers={"Origin": origin}, raise_server_exceptions=False)
    assert client.get("/", params={"token": guard.token}).status_code == 200
    return client


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
