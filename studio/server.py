"""The front server: the one public port. Its own pages and HTTP API; everything else is viser's, on loopback.

    browser --> FrontServer: Door --> make_app: own routes, ViserProxy --> viser on 127.0.0.1

Nothing heavy runs here: a request reads what others have published, or passes bytes on.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import rich
import uvicorn
from fastapi import FastAPI
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from studio import invitation
from studio.cert import Certificate, names_of_this_machine
from studio.door import Access, Door, in_url, known_host, refuse, same_origin
from studio.proxy import GRACE, LOOPBACK, UNSENT_LIMIT, VISIT, Reception, ViserProxy

if TYPE_CHECKING:
    import viser

PORT = 8080
WEB_ASSETS = Path(__file__).parent.parent / "web_assets"

STALL_TIMEOUT = 10.0  # [s] a browser that takes no byte for so long is dropped; viser's page reconnects
MESSAGE_LIMIT = 1024 * 1024  # [bytes] of a browser's message; what our pages say is far shorter
PONG_TIMEOUT = 60.0  # [s] a pong waits behind the scene: 3 MB over 1 Mbit/s take 24 s

SECRETIVE = {"authorization", "cookie", "set-cookie"}
logger = logging.getLogger(__name__)


def start_viser(
    label: str | None = None, arrive: Callable[[str, int], bool] | None = None
) -> viser.ViserServer:
    """viser on a free loopback port (`get_port()`), for our proxy only, without a way to make it public.

    `arrive` is called with each connection's visit and viser's number of it, and says whether it may stay.
    """
    import viser
    from viser import _messages

    console = rich.get_console()
    quiet, console.quiet = console.quiet, True  # its banner shows an address that is not for people
    try:
        server = viser.ViserServer(host=LOOPBACK, port=0, label=label, verbose=False)
    finally:
        console.quiet = quiet
    # Hiding the button is not enough: any client can send the message that opens a tunnel to the internet.
    server.gui.configure_theme(show_share_button=False)
    server._websock_server.unregister_handler(_messages.ShareUrlRequest)

    @server._websock_server.on_client_connect
    async def _(client: viser.infra.WebsockClientConnection) -> None:
        connection = server._websock_server._live_connections[client.client_id]
        _limit_unsent(connection.transport.get_extra_info("socket"))
        # Any web page may find this port. Browsers always name the page, and our proxy leaves that out. Other
        # programs of this machine may find it, too; they know no visit.
        headers = connection.request.headers if connection.request else {}
        is_known = arrive is None or arrive(headers.get(VISIT, ""), client.client_id)
        if "Origin" in headers or not is_known:
            await connection.close(CloseCode.POLICY_VIOLATION, "Open the studio's own page.")
            with suppress(ConnectionClosed):
                async for _ in connection:  # what it sent meanwhile is heard by nobody
                    pass

    return server


def make_app(
    viser_port: int,
    health: Callable[[], Mapping[str, object]] = dict,
    assets: Path = WEB_ASSETS,
    reception: Reception | None = None,
) -> FastAPI:
    """The routes: `/api/v1/health`, `/assets/…`, whatever is included later, and viser for all the rest.

    What `health` returns is added to the answer of /api/v1/health; it is called on the server's loop and must
    not wait. `reception` hears what browsers say to viser; without one it passes unheard.
    """
    app = FastAPI(
        title="Comp-ACT Studio",
        version=version("compact-studio"),
        openapi_url="/api/v1/openapi.json",
        docs_url=None,  # both load scripts from elsewhere
        redoc_url=None,
        redirect_slashes=False,
    )
    started = time.monotonic()

    @app.get("/api/v1/health")
    async def read_health() -> dict[str, Any]:
        uptime = round(time.monotonic() - started, 3)
        return {"status": "ok", "version": app.version, "uptime_s": uptime, **health()}

    proxy = ViserProxy(viser_port, reception)

    async def otherwise(scope: Scope, receive: Receive, send: Send) -> None:
        ours = scope["path"].startswith("/api/")
        await (refuse(404, "No such page.") if ours else proxy)(scope, receive, send)

    app.mount("/assets", _Assets(directory=assets))
    app.router.default = otherwise
    return app


class _Assets(StaticFiles):
    """web_assets as it lies there. Names carry no hash: a browser asks each time, and mostly gets a 304."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        files = super().__call__ if scope["type"] == "http" else refuse(404, "No such page.")
        await files(scope, receive, send)

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response


class FrontServer:
    """Serves `app` behind its Door on a thread of its own. Use it with `with`, or start() and stop().

    Bound to loopback it answers only to loopback's names; bound to any other address, only to who has the
    token. Port 0 takes a free one; see `port`. On Linux a connection that takes no byte for `stall_timeout`
    seconds is dropped, and a WebSocket's end is logged.
    """

    def __init__(
        self,
        app: ASGIApp,
        host: str = LOOPBACK,
        port: int = PORT,
        stall_timeout: float = STALL_TIMEOUT,
        token: str | None = None,
        certificate: Certificate | None = None,
    ) -> None:
        """`token` is made up where one is needed and none given. Without a `certificate` there is no TLS."""
        if not 0 <= port < 2**16:
            raise ValueError(f"Port {port} does not exist; ports go from 0 to {2**16 - 1}.")
        self._app = app
        self._host, self._wanted_port = host, port
        self._stall_timeout, self._certificate = stall_timeout, certificate
        self.token = None if is_loopback(host) else token or secrets.token_urlsafe()
        self.port = 0  # until it is started

    @property
    def url(self) -> str:
        """As a browser on this machine opens it."""
        return self.url_at("localhost" if self._host in ("0.0.0.0", "::") else self._host)

    @property
    def invitation(self) -> str:
        """The link by which a browser elsewhere comes in. Holds the token: show it, never log it."""
        name = names_of_this_machine()[0] if self._host in ("0.0.0.0", "::") else self._host
        return invitation.link(self.url_at(name), self.token) if self.token else self.url_at(name)

    def url_at(self, name: str) -> str:
        """As a browser opens it that knows this machine by that name or address."""
        return f"http{'s' if self._certificate else ''}://{in_url(name)}:{self.port}"

    def start(self) -> None:
        """Listen. Raises OSError, with a sentence for people, where the port cannot be had."""
        listener = _listen(self._host, self._wanted_port, self._stall_timeout)
        for name in ("uvicorn.access", "uvicorn.error", "websockets.client"):
            logging.getLogger(name).addFilter(_may_be_told)
        self.port = listener.getsockname()[1]
        config = uvicorn.Config(
            self._door(),
            log_config=None,
            server_header=False,
            proxy_headers=False,
            ws=_Connection,
            ws_per_message_deflate=False,
            ws_max_size=MESSAGE_LIMIT,
            ws_ping_timeout=PONG_TIMEOUT,
            timeout_graceful_shutdown=3 * GRACE,
            ssl_certfile=self._certificate.path if self._certificate else None,
            ssl_keyfile=self._certificate.key if self._certificate else None,
        )
        self._server = _Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([listener],), name="front server", daemon=True
        )
        self._thread.start()
        while not self._server.started:
            if not self._thread.is_alive():
                listener.close()
                raise RuntimeError("The front server did not start; the log says why.")
            time.sleep(0.01)

    def stop(self) -> None:
        """Close all connections and wait for the thread's end; safe to call twice."""
        self._server.should_exit = True
        self._thread.join()

    def _door(self) -> Door:
        is_secure = self._certificate is not None
        # Browsers hold "__Host-" to this host and TLS. Without TLS they would replace no cookie of that name.
        cookie = f"{'__Host-' * is_secure}studio_{self.port}"
        if self.token is None:
            checks = [known_host(self._host), same_origin]
            return Door(self._app, checks, Access.of_everybody(cookie, is_secure))
        return Door(self._app, [same_origin], Access(self.token, True, cookie, is_secure))

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class _Connection(WebSocketsSansIOProtocol):
    """Says which browser the kernel gave up, see `_listen`."""

    def connection_lost(self, exc: Exception | None) -> None:
        if isinstance(exc, TimeoutError):
            address = ":".join(map(str, self.client or ("a browser",)))
            logger.warning("Dropped %s: it took nothing of what was sent to it.", address)
        super().connection_lost(exc)


class _Server(uvicorn.Server):
    """Gives connections GRACE to end; uvicorn alone would wait for one whose last bytes nobody takes."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        timer = asyncio.get_running_loop().call_later(GRACE, self._abort)
        await super().shutdown(sockets)
        timer.cancel()

    def _abort(self) -> None:
        for connection in self.server_state.connections:
            connection.transport.abort()


def _listen(host: str, port: int, stall_timeout: float) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise OSError(
                f"Port {port} on {host} is in use. If that is another studio, open or stop it; "
                "else choose a free port with --port."
            ) from error
        raise OSError(f"Cannot listen on {host}, port {port}: {error}") from error
    # Every connection inherits these. What is sent goes at once: asyncio sees to it, but not for a socket of
    # protocol 0, and the end of an answer would wait 40 ms for a browser to acknowledge its beginning.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # These bound what waits for a slow browser and how long it may wait.
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(stall_timeout * 1e3))
    _limit_unsent(listener)
    return listener


def _limit_unsent(connection: socket.socket) -> None:
    """Bound what the kernel takes beyond what is on its way; by itself it takes megabytes."""
    if hasattr(socket, "TCP_NOTSENT_LOWAT"):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_LIMIT)


def _may_be_told(record: logging.LogRecord) -> bool:
    """A log filter: queries, cookies and other headers may hold a token, so no line tells them."""
    if record.getMessage().startswith("ASGI callable returned without completing handshake"):
        return False  # uvicorn says so wherever we refuse to open a WebSocket
    if isinstance(record.args, tuple):
        if any(str(arg).lower() in SECRETIVE for arg in record.args[:1]):
            return False
        record.args = tuple(arg.split("?")[0] if isinstance(arg, str) else arg for arg in record.args)
    return True


def is_loopback(host: str) -> bool:
    """Whether an address is heard by this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
