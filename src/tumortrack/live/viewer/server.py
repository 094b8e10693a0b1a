"""viser's server, opened where it was asked for and without its greetings."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from viser import ViserServer


def open_server(host: str, port: int) -> ViserServer:
    """A running server with an empty scene; port 0: any free one.

    Raises:
        InputError: viser is not installed; the port is taken; this machine has no such address.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError("the viewer needs viser: pip install 'tumortrack[live]'.") from error
    _check_free(host, port)  # asked for a taken port, viser takes another and doesn't say so
    logging.getLogger("websockets.server").addFilter(_is_no_refusal)
    with _silence():
        server = viser.ViserServer(host=host, port=port, label="tumortrack", verbose=False)
    if port not in (0, server.get_port()):
        close_server(server)
        raise InputError(_taken(host, port))
    return server


def close_server(server: ViserServer) -> None:
    """Stop it, its threads and its connections; browsers have up to 6 s to say goodbye."""
    with _silence():
        server.stop()


def _is_no_refusal(record: logging.LogRecord) -> bool:
    """Browsers open connections in advance and drop them, which websockets logs as an error."""
    return record.getMessage() != "opening handshake failed"


def _check_free(host: str, port: int) -> None:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will
            probe.bind((host, port))
    except socket.gaierror as error:
        raise InputError(
            f"the viewer cannot listen at {host!r}: {error.strerror}. Give host=127.0.0.1 for this "
            "machine alone, host=0.0.0.0 for every machine that can reach it."
        ) from error
    except OSError as error:
        raise InputError(f"{_taken(host, port)} ({error.strerror})") from error


def _taken(host: str, port: int) -> str:
    return (
        f"the viewer cannot listen on port {port} of {host}: another program does, or it may not "
        f"be used. Close that, or choose another port: viewer:{port + 1}."
    )


@contextmanager
def _silence() -> Iterator[None]:
    """viser prints when it starts and stops, through rich's shared console."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
