"""The viewer's server: on this machine alone, for its own page alone.

A browser runs scripts of every page it has open, and those can reach this machine's own ports. So
a request is answered only if it was made for this machine's own name (not through a foreign name
that is made to point here: DNS rebinding), by this server's own page or by no page at all.
"""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import rich
import viser
from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from tumortrack.core.errors import InputError
from tumortrack_devices.network import is_loopback

HOST = "127.0.0.1"
_SILENT = logging.getLogger("tumortrack.viewer.websockets")  # it logs what clients do as errors
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False
_starting = threading.Lock()


class LocalServer(viser.ViserServer):
    """With an empty scene, on this very port; 0: any free one. Raises InputError: it is taken."""

    def __init__(self, port: int) -> None:
        taken = InputError(
            f"the viewer cannot listen on port {port}: another program does, or it may not be "
            f"used. Close that, or choose another port: viewer:{port + 1}."
        )
        try:  # if the port is taken, viser silently uses another
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will
                probe.bind((HOST, port))
        except OSError as error:
            raise taken from error
        with _quiet(), _checking_requests() as checked:
            super().__init__(host=HOST, port=port, label="tumortrack", verbose=False)
        if checked and port in (0, self.get_port()):
            return
        self.stop()
        if checked:
            raise taken
        raise InputError(f"viser {viser.__version__} lets every page in. Install viser 1.1.1.")

    def request_share_url(self, verbose: bool = True) -> None:
        """Never: it would publish the page on the internet, and whoever connects may ask for it."""

    def stop(self) -> None:
        """Also its threads and connections; browsers have up to 6 s to close."""
        with _quiet():
            super().stop()


@contextmanager
def _quiet() -> Iterator[None]:
    """viser prints through rich's shared console when it starts and stops."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


@contextmanager
def _checking_requests() -> Iterator[list[str]]:
    """viser has no hook for requests: the server that it starts inside gets ours, and says so."""
    theirs, checked = websockets_server.serve, list[str]()

    def serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def answer(connection: ServerConnection, request: Request) -> Response | None:
            if why := refusal(request):
                return connection.respond(HTTPStatus.FORBIDDEN, why)
            response: Response | None = process_request(connection, request)
            if response is not None:  # the page is in no other page's frame
                response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
            return response

        checked.append("all")
        return theirs(*arguments, process_request=answer, **options, logger=_SILENT)

    with _starting:
        websockets_server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield checked
        finally:
            websockets_server.serve = theirs  # type: ignore[misc]


def refusal(request: Request) -> str:
    """Why a request is not answered; empty: it is."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    try:
        names = [urlsplit(f"//{host}").hostname or "" for host in hosts]
        foreign = any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins)
    except (ValueError, IndexError):
        names, foreign = [], True
    if len(names) != 1 or not is_loopback(names[0]):
        return (
            "This is not the viewer's address: it is http://127.0.0.1 or localhost, and a port.\n"
        )
    return "Another site's page may not use the viewer.\n" if foreign else ""
