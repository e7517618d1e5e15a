"""What lies behind the front server: bytes pass unchanged, and a stuck browser harms nobody."""

from __future__ import annotations

import http.client
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import httpx
import msgspec
import numpy as np
import pytest
import viser
from upstream import (
    VISER,
    Echo,
    Endless,
    Flood,
    echo,
    front_of,
    http_upstream,
    open_socket,
    websocket_upstream,
)
from viser import _messages
from visitor import CAMERA, wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request, Response
from websockets.sync.client import connect
from websockets.sync.server import ServerConnection
from websockets.typing import Origin

from studio.server import FrontServer, start_viser


class Page(NamedTuple):
    """viser, a front server before it, and the log that it writes."""

    viser: viser.ViserServer
    front: FrontServer


@pytest.fixture
def page() -> Iterator[Page]:
    server = start_viser()
    with front_of(server.get_port(), stall_timeout=3.0) as front:
        yield Page(server, front)
    server.stop()


# Passing on


def test_http_passes_byte_for_byte() -> None:
    # Dots, doubled slashes, escapes and an empty value: none may be tidied up on the way.
    target = "/a/../b//%2e%2F%c3%a4?x=1&y=%20&z="
    with http_upstream() as port, front_of(port) as front:
        connection = http.client.HTTPConnection("127.0.0.1", front.port)
        for method, body in (("GET", Echo.body), ("HEAD", b"")):
            connection.request(method, target, headers={"X-Own": "1", "Accept-Encoding": "br"})
            answer = connection.getresponse()
            assert (answer.status, answer.read()) == (418, body)
            assert answer.headers.get_all("Set-Cookie") == ["a=1", "b=2"]
            assert answer.headers["Content-Encoding"] == "br"
            assert len(answer.headers.get_all("Date", [])) == 1
            path, headers = eval(answer.headers["Asked"])
            assert path == target
            assert {name.lower(): value for name, value in headers} == {
                "host": f"127.0.0.1:{port}",
                "x-own": "1",
                "accept-encoding": "br",
            }
        connection.close()


def test_viser_is_not_asked_what_it_does_not_know(page: Page, caplog: pytest.LogCaptureFixture) -> None:
    assert httpx.head(page.front.url).status_code == 200
    for method in ("POST", "OPTIONS", "BREW"):
        assert httpx.request(method, page.front.url).status_code == 405
    assert not [record for record in caplog.records if record.levelno > logging.INFO]


def test_messages_pass_byte_for_byte_both_ways() -> None:
    messages = ["", b"", "grüß\N{ROBOT FACE}", os.urandom(70_000), os.urandom(1_000_000)]
    big = os.urandom(20_000_000)

    def echo_and_more(connection: ServerConnection) -> None:
        connection.send(big)
        echo(connection)

    with (
        websocket_upstream(echo_and_more) as port,
        front_of(port) as front,
        open_socket(front, max_size=None, subprotocols=["first", "second"]) as browser,
    ):
        assert browser.subprotocol == "second"  # the one that the server behind chose
        assert browser.response is not None
        assert "Sec-WebSocket-Extensions" not in browser.response.headers  # offered, and declined
        assert browser.recv(timeout=10) == big
        for message in messages:
            browser.send(message)
            assert browser.recv(timeout=10) == message


def test_viser_takes_its_own_protocol_through_the_proxy(page: Page) -> None:
    with open_socket(page.front, subprotocols=[VISER], max_size=None) as browser:
        assert browser.subprotocol == VISER
        assert browser.recv(timeout=10)
    assert b"<html" in httpx.get(page.front.url).content


def test_path_query_and_headers_of_a_websocket_pass() -> None:
    def tell(connection: ServerConnection) -> None:
        assert connection.request
        connection.send(repr((connection.request.path, connection.request.headers.get_all("X-Own"))))

    with (
        websocket_upstream(tell) as port,
        front_of(port) as front,
        open_socket(front, "/a//b?c=%20", additional_headers={"X-Own": "1"}) as browser,
    ):
        assert eval(browser.recv(timeout=10)) == ("/a//b?c=%20", ["1"])


@pytest.mark.parametrize(("code", "reason"), [(1000, ""), (4001, "bye")])
def test_the_browser_closes_and_viser_hears_why(code: int, reason: str) -> None:
    heard: list[tuple[int | None, str | None]] = []

    def hear(connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            connection.recv()
        heard.append((connection.close_code, connection.close_reason))

    with websocket_upstream(hear) as port, front_of(port) as front:
        open_socket(front).close(code, reason)
        wait_for(lambda: heard)
    assert heard == [(code, reason)]


def test_viser_closes_and_the_browser_hears_all_and_why() -> None:
    def say_and_close(connection: ServerConnection) -> None:
        for n in range(100):
            connection.send(str(n))
        connection.close(4002, "enough")

    with websocket_upstream(say_and_close) as port, front_of(port) as front, open_socket(front) as browser:
        assert [browser.recv(timeout=10) for _ in range(100)] == [str(n) for n in range(100)]
        with pytest.raises(ConnectionClosed):
            browser.recv(timeout=10)
        assert (browser.close_code, browser.close_reason) == (4002, "enough")


def test_a_lost_connection_is_told_to_the_other_side() -> None:
    def break_off(connection: ServerConnection) -> None:
        connection.socket.shutdown(socket.SHUT_RDWR)

    with websocket_upstream(break_off) as port, front_of(port) as front, open_socket(front) as browser:
        with pytest.raises(ConnectionClosed):
            browser.recv(timeout=10)
        assert browser.close_code == 1001


def test_a_refusal_of_viser_passes() -> None:
    def refuse(connection: ServerConnection, request: Request) -> Response:
        return connection.respond(426, "not this version")

    with websocket_upstream(echo, refuse) as port, front_of(port) as front:
        with pytest.raises(InvalidStatus) as refused:
            open_socket(front)
        answer = refused.value.response
        assert (answer.status_code, answer.body) == (426, b"not this version")


def test_an_answer_ends_where_the_browser_leaves() -> None:
    with http_upstream(Endless) as port, front_of(port) as front:
        with httpx.stream("GET", front.url) as answer:
            next(answer.iter_raw())
        assert Endless.ended.wait(10)


# What only viser would hear


def test_a_message_of_ten_megabytes_ends_the_connection_and_goes_no_further() -> None:
    heard: list[object] = []

    def hear(connection: ServerConnection) -> None:
        try:
            heard.append(connection.recv())
        except ConnectionClosed:
            heard.append(connection.close_code)

    with websocket_upstream(hear) as port, front_of(port) as front, open_socket(front) as browser:
        with suppress(ConnectionClosed):
            browser.send(bytes(10_000_000))
        wait_for(lambda: heard == [1009])
        browser.recv_events_thread.join(10)
        assert not browser.recv_events_thread.is_alive()


def press(button: viser.GuiButtonHandle) -> bytes:
    """What viser's page sends for a click."""
    message = {"type": "GuiUpdateMessage", "uuid": button._impl.uuid, "updates": {"value": True}}
    return msgspec.msgpack.encode(message)


def test_a_raw_request_for_the_share_tunnel_does_nothing(page: Page) -> None:
    request = msgspec.msgpack.encode({"type": "ShareUrlRequest"})
    pressed, asked = threading.Event(), threading.Event()
    button = page.viser.gui.add_button("Press")
    button.on_click(lambda _: pressed.set())
    with open_socket(page.front, subprotocols=[VISER], max_size=None) as browser:
        browser.send(msgspec.msgpack.encode(CAMERA))
        wait_for(page.viser.get_clients)
        browser.send(request)
        browser.send(press(button))
        assert pressed.wait(10)  # so the request before it was handled
        assert page.viser._share_tunnel is None
        # The request was well formed: where there is a handler, it arrives.
        page.viser._websock_server.register_handler(_messages.ShareUrlRequest, lambda *_: asked.set())
        browser.send(request)
        assert asked.wait(10)


def test_a_web_page_that_found_visers_own_port_is_not_heard(page: Page) -> None:
    heard = threading.Event()
    page.viser._websock_server.register_handler(_messages.GuiUpdateMessage, lambda *_: heard.set())
    button = page.viser.gui.add_button("Press")
    url, origin = f"ws://127.0.0.1:{page.viser.get_port()}", Origin("http://evil.example")
    with connect(url, proxy=None, origin=origin, subprotocols=[VISER]) as evil:
        with suppress(ConnectionClosed):
            for _ in range(5):
                evil.send(press(button))
        evil.recv_events_thread.join()
        assert evil.close_code == 1008
    assert not heard.wait(0.2)
    with open_socket(page.front, origin=Origin(page.front.url), subprotocols=[VISER]) as ours:
        ours.send(press(button))
        assert heard.wait(10)


# Stuck browsers


def test_a_browser_that_reads_nothing_is_not_sent_to_and_then_dropped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    flood = Flood()
    with websocket_upstream(flood) as port, front_of(port, stall_timeout=1.0) as front:
        browser = open_socket(front, max_queue=1)
        assert flood.ended.wait(10)
        browser.socket.close()
    assert flood.sent < 20_000_000  # what the kernel's buffers hold, of a gigabyte
    assert "it took nothing of what was sent to it" in caplog.text


def test_a_browser_that_reads_nothing_does_not_disturb_another(
    page: Page, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    points = page.viser.scene.add_point_cloud("/points", np.zeros((20_000, 3), np.float32), (1, 2, 3))
    connections = page.viser._websock_server._live_connections
    stuck = open_socket(page.front, subprotocols=[VISER], max_size=None, max_queue=1)
    with open_socket(page.front, subprotocols=[VISER], max_size=None) as browser:
        wait_for(lambda: len(connections) == 2)
        begin, arrivals = time.monotonic(), []
        while len(connections) == 2:
            assert time.monotonic() < begin + 30, "the stuck one is not dropped"
            points.points = rng.normal(size=(20_000, 3)).astype(np.float32)  # 120 kB as they are sent
            page.viser.flush()
            browser.recv(timeout=30)
            arrivals.append(time.monotonic())
    assert len(arrivals) > 20
    assert max(b - a for a, b in pairwise(arrivals)) < 2.0  # not the 3 s that the stuck one is waited for
    assert "it took nothing of what was sent to it" in caplog.text
    stuck.socket.close()


def test_a_browser_that_paused_gets_the_newest_and_little_else(page: Page) -> None:
    rng = np.random.default_rng(0)
    points = page.viser.scene.add_point_cloud("/points", np.zeros((20_000, 3), np.float32), (1, 2, 3))
    messages: list[bytes] = []
    with (
        front_of(page.viser.get_port()) as front,  # more patient than the page's
        open_socket(front, subprotocols=[VISER], max_size=None, max_queue=1) as browser,
    ):
        for _ in range(100):
            points.points = newest = rng.normal(size=(20_000, 3)).astype(np.float32)
            page.viser.flush()
            time.sleep(0.02)
        with suppress(TimeoutError):
            while True:
                messages.append(browser.recv(timeout=1, decode=False))
    assert messages[-1].endswith(newest.astype(np.float16).tobytes())
    assert sum(map(len, messages)) < 4_000_000  # 12 MB where the kernel buffers as it likes
