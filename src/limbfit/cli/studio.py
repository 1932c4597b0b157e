"""The verb of the studio."""

from __future__ import annotations

from typing import Annotated

import typer

import limbfit

from .commands import StudyPath
from .console import STDOUT


def studio(
    study: StudyPath,
    port: Annotated[int, typer.Option(help="port to listen on; 0: a free one", min=0, max=65535)] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="print the address, open no browser")
    ] = False,
    host: Annotated[str, typer.Option(help="the address to listen on")] = "127.0.0.1",
    expose: Annotated[
        bool,
        typer.Option("--expose", help="allow a --host that other machines reach: they can change the study"),
    ] = False,
) -> None:
    """View and correct the limb, and watch its identification, in a browser on this machine."""

    def tell(address: str) -> None:
        STDOUT.print(f"studio of {study}; Ctrl-C ends it, runs go on", soft_wrap=True)
        STDOUT.print(address, soft_wrap=True)

    limbfit.serve_studio(study, port=port, host=host, expose=expose, browser=not no_browser, tell=tell)


VERBS = (studio,)
