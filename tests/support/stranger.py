"""What a stranger does to a service, by hand on a socket."""

from __future__ import annotations

import contextlib
import socket

from service_process import Service


def connect(service: Service, address: str = "127.0.0.1") -> socket.socket:
    """From an address of this machine: Linux has all of 127.0.0.0/8."""
    return socket.create_connection(service.http_address, timeout=20, source_address=(address, 0))


def is_closed(connection: socket.socket) -> bool:
    """Waits until the other side has closed it, the time-out of the socket at most."""
    try:
        while connection.recv(65536):
            pass
    except TimeoutError:
        return False
    except OSError:
        pass
    return True


def lives(service: Service) -> bool:
    """On a connection of its own."""
    with service.rest() as rest:
        return rest.get("/livez").status_code == 200


def send_until_closed(connection: socket.socket, piece: bytes, limit: int) -> int:
    """How many bytes were taken of `piece` again and again."""
    sent = 0
    with contextlib.suppress(OSError):
        while sent < limit:
            connection.sendall(piece)
            sent += len(piece)
    return sent
