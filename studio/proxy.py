"""The way to viser: HTTP and WebSocket passed on to its port on loopback, and nothing a browser may not say.

What viser sends passes byte for byte. What a browser sends is heard by a `Visit` first, where there is one.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Protocol

import httpx
from starlette.requests import Request
from starlette.responses import StreamingResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

# viser's own library: it stops reading where we do, and knows no limit of size where told so. Another one,
# such as httpx-ws, would be a second implementation of the protocol with a queue to bound.
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.frames import EXTERNAL_CLOSE_CODES, CloseCode
from websockets.typing import Subprotocol

from studio.door import refuse

LOOPBACK = "127.0.0.1"
VISIT = "studio-visit"  # the header that tells viser's side whose connection it is
UNSENT_LIMIT = 32 * 1024  # [bytes] that may wait in each place: a slow browser gets fewer poses, not old ones
VISER_TIMEOUT = 10.0  # [s] to connect to viser, and between two parts of its answer
GRACE = 1  # [s] for open connections to end when we stop
# Of one connection, not of what is sent over it (RFC 9110, 7.6.1); Host and Date each server gives its own.
OF_CONNECTION = {"connection", "host", "date", "keep-alive", "te", "trailer", "transfer-encoding", "upgrade"}
OURS = {"cookie", "authorization", "origin", VISIT}  # of no concern to viser

logger = logging.getLogger(__name__)


class Unheard(ValueError):
    """A browser said what none of our pages says; the text says what."""


class Visit(Protocol):
    """One browser's connection to viser, as long as it lasts."""

    key: str  # sent to viser with the connection: none but the proxy knows it

    def hear(self, message: bytes | str) -> bytes | None:
        """What viser is to be told for what the browser said, or None. Raises `Unheard`."""

    def end(self) -> None:
        """The connection is closed."""


Reception = Callable[[WebSocket], Visit]


class ViserProxy:
    """HTTP and WebSocket to viser's port.

    A WebSocket has no queue here. Where a browser reads slowly we stop reading from viser, which then leaves
    out the poses that newer ones have replaced.
    """

    def __init__(self, port: int, receive: Reception | None = None) -> None:
        """`receive` makes the visit of each browser."""
        self._receive = receive
        self._address = (LOOPBACK, port)
        self._authority = f"{LOOPBACK}:{port}"
        # viser closes each connection after its answer, so none is kept, and there is nothing to close.
        limits = httpx.Limits(max_keepalive_connections=0)
        # verify=False: there is no TLS on loopback, and the certificates would take 0.1 s to load.
        self._client = httpx.AsyncClient(limits=limits, trust_env=False, verify=False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # "GET @elsewhere/ HTTP/1.1" would make a URL of another host.
        if not scope["raw_path"].startswith(b"/"):
            await refuse(400, "No such page.")(scope, receive, send)
        elif scope["type"] == "http":
            await self._http(scope, receive, send)
        else:
            await self._websocket(scope, receive, send)

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope)
        if request.method not in ("GET", "HEAD"):
            await refuse(405, "viser knows only GET.", {"Allow": "GET, HEAD"})(scope, receive, send)
            return
        passed_on = httpx.Request(
            "GET",  # of an answer to HEAD uvicorn sends no body
            f"http://{self._authority}",
            headers=_of_concern(request.headers.raw),
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
        visit = self._receive(browser) if self._receive else None
        try:
            viser = await self._open(browser, visit)
        except InvalidStatus as refusal:
            body, status = bytes(refusal.response.body or b""), refusal.response.status_code
            await refuse(status, body.decode(errors="replace"))(scope, receive, send)
        except (OSError, WebSocketException) as error:
            await _bad_gateway(error)(scope, receive, send)
        else:
            async with viser:
                await browser.accept(viser.subprotocol)
                await _join(browser, viser, visit)
        finally:
            if visit is not None:
                visit.end()

    async def _open(self, browser: WebSocket, visit: Visit | None) -> ClientConnection:
        headers = [
            (name.decode("latin-1"), value.decode("latin-1"))
            for name, value in _of_concern(browser.headers.raw)
            if not name.startswith(b"sec-websocket-")
        ]
        return await connect(
            f"ws://{self._authority}{_target(browser.scope).decode('latin-1')}",
            sock=await self._connect(),
            additional_headers=headers + ([(VISIT, visit.key)] if visit else []),
            subprotocols=[Subprotocol(name) for name in browser.scope["subprotocols"]] or None,
            user_agent_header=None,
            compression=None,  # on loopback, and viser has compressed already
            max_size=None,
            max_queue=1,
            ping_interval=None,
            open_timeout=VISER_TIMEOUT,
            close_timeout=GRACE,
            proxy=None,
        )

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


async def _join(browser: WebSocket, viser: ClientConnection, visit: Visit | None) -> None:
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
        code, reason = await _listen(browser, viser, visit)
        sending.cancel()  # it may wait for a browser that takes nothing
    await viser.close(code, reason)


async def _listen(browser: WebSocket, viser: ClientConnection, visit: Visit | None) -> tuple[int, str]:
    """Pass on what the browser says until it closes; with which code and reason."""
    while (event := await browser.receive())["type"] == "websocket.receive":
        text = event.get("text")
        said: bytes | str = event["bytes"] if text is None else text
        try:
            heard = visit.hear(said) if visit else said
        except Unheard as error:
            told = str(error).encode("unicode_escape").decode()  # a log is no place for line breaks of others
            logger.warning("Closed a browser's connection: %.200s", told)
            with suppress(WebSocketDisconnect):
                await browser.close(CloseCode.POLICY_VIOLATION, "This is no message of our page; reload it.")
            return CloseCode.POLICY_VIOLATION, ""
        if heard is not None:
            with suppress(ConnectionClosed):  # then the browser is closed, which ends this loop
                await viser.send(heard)
    return _sendable(event["code"]), event.get("reason") or ""


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


def _of_concern(headers: Iterable[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
    """What viser is told of a request."""
    return [(name, value) for name, value in _end_to_end(headers) if name.decode("latin-1") not in OURS]


def _bad_gateway(error: Exception) -> ASGIApp:
    logger.warning("viser does not answer: %s", error)
    return refuse(502, "The 3-D view does not answer. Reload the page, or restart the studio.")
