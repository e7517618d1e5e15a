"""The front server: the one public port. Its own pages and HTTP API; everything else is viser's, on loopback.

    browser --> FrontServer: Door --> make_app: own routes, ViserProxy --> viser on 127.0.0.1

Nothing heavy runs here: a request reads what others have published, or passes bytes on.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import httpx
import rich
import uvicorn
from fastapi import FastAPI
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

# viser's own library: it stops reading where we do, and knows no limit of size where told so. Another one,
# such as httpx-ws, would be a second implementation of the protocol with a queue to bound.
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.frames import EXTERNAL_CLOSE_CODES, CloseCode
from websockets.typing import Subprotocol

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
PORT = 8080
WEB_ASSETS = Path(__file__).parent.parent / "web_assets"

STALL_TIMEOUT = 10.0  # [s] a browser that takes no byte for so long is dropped; viser's page reconnects
UNSENT_LIMIT = 32 * 1024  # [bytes] that may wait in each place: a slow browser gets fewer poses, not old ones
MESSAGE_LIMIT = 50 * 1024 * 1024  # [bytes] of a browser's message: viser's own limit
PONG_TIMEOUT = 60.0  # [s] a pong waits behind the scene: 3 MB over 1 Mbit/s take 24 s
VISER_TIMEOUT = 10.0  # [s] to connect to viser, and between two parts of its answer
GRACE = 1  # [s] for open connections to end when we stop

SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
PAGE_HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'self'",  # nobody's page frames ours and steals clicks
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}
# Of one connection, not of what is sent over it (RFC 9110, 7.6.1); Host and Date each server gives its own.
OF_CONNECTION = {"connection", "host", "date", "keep-alive", "te", "trailer", "transfer-encoding", "upgrade"}

Check = Callable[[HTTPConnection], str | None]
logger = logging.getLogger(__name__)


def start_viser(label: str | None = None) -> viser.ViserServer:
    """viser on a free loopback port (`get_port()`), for our proxy only, without a way to make it public."""
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
        # Any web page may find this port. Browsers always name the page, and our proxy leaves that out.
        if connection.request and "Origin" in connection.request.headers:
            await connection.close(CloseCode.POLICY_VIOLATION, "Open the studio's own page.")
            with suppress(ConnectionClosed):
                async for _ in connection:  # what it sent meanwhile is heard by nobody
                    pass

    return server


def make_app(
    viser_port: int, health: Callable[[], Mapping[str, object]] = dict, assets: Path = WEB_ASSETS
) -> FastAPI:
    """The routes: `/api/v1/health`, `/assets/…`, whatever is included later, and viser for all the rest.

    What `health` returns is added to the answer of /api/v1/health; it is called on the server's loop and must
    not wait.
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

    proxy = ViserProxy(viser_port)

    async def otherwise(scope: Scope, receive: Receive, send: Send) -> None:
        ours = scope["path"].startswith("/api/")
        await (_refuse(404, "No such page.") if ours else proxy)(scope, receive, send)

    app.mount("/assets", _Assets(directory=assets))
    app.router.default = otherwise
    return app


class _Assets(StaticFiles):
    """web_assets as it lies there. Names carry no hash: a browser asks each time, and mostly gets a 304."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        files = super().__call__ if scope["type"] == "http" else _refuse(404, "No such page.")
        await files(scope, receive, send)

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response


class ViserProxy:
    """HTTP and WebSocket, byte for byte, to viser's port.

    A WebSocket has no queue here. Where a browser reads slowly we stop reading from viser, which then leaves
    out the poses that newer ones have replaced.
    """

    def __init__(self, port: int) -> None:
        self._address = (LOOPBACK, port)
        self._authority = f"{LOOPBACK}:{port}"
        # viser closes each connection after its answer, so none is kept, and there is nothing to close.
        limits = httpx.Limits(max_keepalive_connections=0)
        # verify=False: there is no TLS on loopback, and the certificates would take 0.1 s to load.
        self._client = httpx.AsyncClient(limits=limits, trust_env=False, verify=False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # "GET @elsewhere/ HTTP/1.1" would make a URL of another host.
        if not scope["raw_path"].startswith(b"/"):
            await _refuse(400, "No such page.")(scope, receive, send)
        elif scope["type"] == "http":
            await self._http(scope, receive, send)
        else:
            await self._websocket(scope, receive, send)

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope)
        if request.method not in ("GET", "HEAD"):
            await _refuse(405, "viser knows only GET.", {"Allow": "GET, HEAD"})(scope, receive, send)
            return
        passed_on = httpx.Request(
            "GET",  # of an answer to HEAD uvicorn sends no body
            f"http://{self._authority}",
            headers=_end_to_end(request.headers.raw),
            extensions={"target": _target(scope), "timeout": httpx.Timeout(VISER_TIMEOUT).as_dict()},
        )
        try:
            answer = await self._client.send(passed_on, stream=True)
        except httpx.TransportError as error:
            await _bad_gateway(error)(scope, receive, send)
            return
        try:
            response = StreamingResponse(answer.aiter_raw(), answer.status_code)
            response.raw_headers = _end_to_end(answer.headers.raw)
            await response(scope, receive, send)
        finally:
            await answer.aclose()

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        browser = WebSocket(scope, receive, send)
        try:
            viser = await connect(
                f"ws://{self._authority}{_target(scope).decode('latin-1')}",
                sock=await self._connect(),
                additional_headers=[
                    (name.decode("latin-1"), value.decode("latin-1"))
                    for name, value in _end_to_end(browser.headers.raw)
                    if not name.startswith((b"sec-websocket-", b"origin"))
                ],
                subprotocols=[Subprotocol(name) for name in scope["subprotocols"]] or None,
                user_agent_header=None,
                compression=None,  # on loopback, and viser has compressed already
                max_size=None,
                max_queue=1,
                ping_interval=None,
                open_timeout=VISER_TIMEOUT,
                close_timeout=GRACE,
                proxy=None,
            )
        except InvalidStatus as refusal:
            body, status = bytes(refusal.response.body or b""), refusal.response.status_code
            await _refuse(status, body.decode(errors="replace"))(scope, receive, send)
        except (OSError, WebSocketException) as error:
            await _bad_gateway(error)(scope, receive, send)
        else:
            async with viser:
                await browser.accept(viser.subprotocol)
                await _join(browser, viser)

    async def _connect(self) -> socket.socket:
        """With a receive buffer that does not grow by itself, up to megabytes of old poses."""
        connection = socket.socket()
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, UNSENT_LIMIT)
        try:
            await asyncio.get_running_loop().sock_connect(connection, self._address)
        except OSError:
            connection.close()
            raise
        return connection


async def _join(browser: WebSocket, viser: ClientConnection) -> None:
    """Pass messages both ways until one side closes; the other is closed with the same code and reason."""

    async def to_browser() -> None:
        with suppress(WebSocketDisconnect):
            with suppress(ConnectionClosed):
                async for message in viser:
                    if isinstance(message, str):
                        await browser.send_text(message)
                    else:
                        await browser.send_bytes(message)
            await browser.close(_sendable(viser.close_code), viser.close_reason)

    async with asyncio.TaskGroup() as group:
        sending = group.create_task(to_browser())
        event = await browser.receive()
        while event["type"] == "websocket.receive":
            text = event.get("text")
            with suppress(ConnectionClosed):  # then to_browser closes the browser, which ends this loop
                await viser.send(event["bytes"] if text is None else text)
            event = await browser.receive()
        sending.cancel()  # it may wait for a browser that takes nothing
    await viser.close(_sendable(event["code"]), event.get("reason") or "")


def _sendable(code: int | None) -> int:
    """The close code to pass on: 1005 (none was given) and 1006 (the connection broke) may not be sent."""
    if code == CloseCode.NO_STATUS_RCVD:
        return CloseCode.NORMAL_CLOSURE
    return code if code and (code in EXTERNAL_CLOSE_CODES or code >= 3000) else CloseCode.GOING_AWAY


def _target(scope: Scope) -> bytes:
    """Path and query as they were sent."""
    path: bytes = scope["raw_path"]
    query: bytes = scope["query_string"]
    return path + b"?" + query if query else path


def _end_to_end(headers: Iterable[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
    lower = [(name.lower(), value) for name, value in headers]
    named = b",".join(value for name, value in lower if name == b"connection").decode("latin-1").lower()
    left_out = OF_CONNECTION | {name.strip() for name in named.split(",")}
    return [(name, value) for name, value in lower if name.decode("latin-1") not in left_out]


def _bad_gateway(error: Exception) -> ASGIApp:
    logger.warning("viser does not answer: %s", error)
    return _refuse(502, "The 3-D view does not answer. Reload the page, or restart the studio.")


def _refuse(status: int, reason: str, headers: Mapping[str, str] | None = None) -> ASGIApp:
    """Answers a request, or the opening of a WebSocket, with a status and a sentence."""
    response = PlainTextResponse(reason, status, headers)

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await WebSocket(scope, receive, send).send_denial_response(response)
        else:
            await response(scope, receive, send)

    return answer


class Door:
    """Middleware around everything: each check says why a request may not come in, or None."""

    def __init__(self, app: ASGIApp, checks: Iterable[Check]) -> None:
        self._app = app
        self._checks = tuple(checks)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in PAGE_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        connection = HTTPConnection(scope)
        refusals = (check(connection) for check in self._checks)
        reason = next((reason for reason in refusals if reason), None)
        await (_refuse(403, reason) if reason else self._app)(scope, receive, send_with_headers)


def known_host(host: str) -> Check:
    """Only our own names, or a page elsewhere whose name is made to mean 127.0.0.1 could talk to us."""
    names = {"localhost", LOOPBACK, "[::1]", _in_url(host)}

    def check(connection: HTTPConnection) -> str | None:
        given = connection.headers.get("host", "")
        if re.sub(r":\d*$", "", given.lower()) in names:
            return None
        return f"Not served under the name {given!r}; open it as {' or '.join(sorted(names))}."

    return check


def same_origin(connection: HTTPConnection) -> str | None:
    """Only our own pages open WebSockets and change things. What is no browser sends no Origin."""
    if connection.scope["type"] == "http" and connection.scope["method"] in SAFE_METHODS:
        return None
    host = connection.headers.get("host", "").lower()
    for origin in connection.headers.getlist("origin"):
        _, separator, authority = origin.lower().partition("://")
        if not separator or authority != host:
            return f"Refused: the request comes from a page of {origin!r}, not from {host!r}."
    return None


class FrontServer:
    """Serves `app` behind its Door on a thread of its own. Use it with `with`, or start() and stop().

    Bound to loopback it answers only to loopback's names. Port 0 takes a free one; see `port`. On Linux a
    connection that takes no byte for `stall_timeout` seconds is dropped, and a WebSocket's end is logged.
    """

    def __init__(
        self,
        app: ASGIApp,
        host: str = LOOPBACK,
        port: int = PORT,
        stall_timeout: float = STALL_TIMEOUT,
    ) -> None:
        if not 0 <= port < 2**16:
            raise ValueError(f"Port {port} does not exist; ports go from 0 to {2**16 - 1}.")
        self._app = Door(app, [known_host(host), same_origin] if _is_loopback(host) else [same_origin])
        self._host, self._wanted_port = host, port
        self._stall_timeout = stall_timeout
        self.port = 0  # until it is started

    @property
    def url(self) -> str:
        """As a browser on this machine opens it."""
        host = "localhost" if self._host in ("0.0.0.0", "::") else _in_url(self._host)
        return f"http://{host}:{self.port}"

    def start(self) -> None:
        """Listen. Raises OSError, with a sentence for people, where the port cannot be had."""
        listener = _listen(self._host, self._wanted_port, self._stall_timeout)
        for name in ("uvicorn.access", "uvicorn.error", "websockets.client"):
            logging.getLogger(name).addFilter(_without_queries)
        config = uvicorn.Config(
            self._app,
            log_config=None,
            server_header=False,
            proxy_headers=False,
            ws=_Connection,
            ws_per_message_deflate=False,
            ws_max_size=MESSAGE_LIMIT,
            ws_ping_timeout=PONG_TIMEOUT,
            timeout_graceful_shutdown=3 * GRACE,
        )
        self._server = _Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([listener],), name="front server", daemon=True
        )
        self.port = listener.getsockname()[1]
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
    # Every connection inherits these. They bound what waits for a slow browser and how long it may wait.
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(stall_timeout * 1e3))
    _limit_unsent(listener)
    return listener


def _limit_unsent(connection: socket.socket) -> None:
    """Bound what the kernel takes beyond what is on its way; by itself it takes megabytes."""
    if hasattr(socket, "TCP_NOTSENT_LOWAT"):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_LIMIT)


def _without_queries(record: logging.LogRecord) -> bool:
    """A log filter: a query may hold a token, so no line tells it."""
    if isinstance(record.args, tuple):
        record.args = tuple(arg.split("?")[0] if isinstance(arg, str) else arg for arg in record.args)
    return True


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host.lower()
