"""What stands in for viser where a test must see both ends, and a front server before it."""

from __future__ import annotations

import http.server
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import viser
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Subprotocol

from studio.server import FrontServer, make_app

VISER = Subprotocol(f"viser-v{viser.__version__}")
NOBODY = 9  # the discard port: nothing listens there


class Echo(http.server.BaseHTTPRequestHandler):
    """Answers with what it was asked, and with a body that is not what it is said to be."""

    body = os.urandom(1_000_000)

    def do_GET(self) -> None:
        self.send_response(418)
        for name, value in {"Set-Cookie": "a=1", "set-cookie": "b=2", "Content-Encoding": "br"}.items():
            self.send_header(name, value)
        self.send_header("Asked", repr((self.path, sorted(self.headers.items()))))
        self.send_header("Content-Length", str(len(self.body)))
        self.end_headers()
        self.wfile.write(self.body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def http_upstream(handler: type[http.server.BaseHTTPRequestHandler] = Echo) -> Iterator[int]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def websocket_upstream(
    handler: Callable[[ServerConnection], None],
    process_request: Callable[[ServerConnection, Request], Response | None] | None = None,
) -> Iterator[int]:
    with serve(
        handler,
        "127.0.0.1",
        0,
        select_subprotocol=lambda _, offered: offered[-1] if offered else None,
        process_request=process_request,
        compression=None,
        max_size=None,
    ) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.socket.getsockname()[1]
        finally:
            server.shutdown()
            thread.join()


def echo(connection: ServerConnection) -> None:
    for message in connection:
        connection.send(message)


class Endless(http.server.BaseHTTPRequestHandler):
    """Answers until nobody listens."""

    ended = threading.Event()

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        with suppress(OSError):
            while True:
                self.wfile.write(bytes(64 * 1024))
        self.ended.set()

    log_message = Echo.log_message


class Flood:
    """Sends a gigabyte as fast as it is taken."""

    def __init__(self) -> None:
        self.sent = 0
        self.ended = threading.Event()

    def __call__(self, connection: ServerConnection) -> None:
        message = os.urandom(64 * 1024)
        with suppress(ConnectionClosed):
            while self.sent < 1_000_000_000:
                connection.send(message)
                self.sent += len(message)
        self.ended.set()

    def is_stuck(self) -> bool:
        before = self.sent
        time.sleep(0.3)
        return self.sent == before > 0


def front_of(viser_port: int, stall_timeout: float = 10.0) -> FrontServer:
    return FrontServer(make_app(viser_port), port=0, stall_timeout=stall_timeout)


def open_socket(front: FrontServer, path: str = "/", **options: object) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{front.port}{path}", proxy=None, **options)
