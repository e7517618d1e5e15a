"""The front server: bytes pass unchanged, strangers stay out, a stuck browser harms nobody."""

import gc
import http.client
import http.server
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import httpx
import msgspec
import numpy as np
import psutil
import pytest
import viser
from fastapi import APIRouter
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request, Response
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Origin, Subprotocol

from studio.server import FrontServer, make_app, start_viser

VISER = Subprotocol(f"viser-v{viser.__version__}")
NOBODY = 9  # the discard port: nothing listens there


def wait_for(condition: Callable[[], object], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


# What stands in for viser where a test must see both ends.


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


@pytest.fixture
def alone() -> Iterator[FrontServer]:
    """A front server whose viser does not answer."""
    with front_of(NOBODY) as front:
        yield front


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


def test_without_viser_the_page_says_so_and_our_own_routes_work(alone: FrontServer) -> None:
    answer = httpx.get(alone.url)
    assert answer.status_code == 502
    assert "does not answer" in answer.text
    with pytest.raises(InvalidStatus, match="502"):
        open_socket(alone)
    assert httpx.get(f"{alone.url}/api/v1/health").json()["status"] == "ok"


def test_a_target_of_another_host_is_not_followed(alone: FrontServer) -> None:
    with http_upstream() as elsewhere:
        for target in (f"@127.0.0.1:{elsewhere}/", f"http://127.0.0.1:{elsewhere}/", "*"):
            with socket.create_connection(("127.0.0.1", alone.port)) as raw:
                request = f"OPTIONS {target} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
                raw.sendall(request.encode())
                assert raw.makefile("rb").readline().split()[1] == b"400"


def test_an_answer_ends_where_the_browser_leaves() -> None:
    with http_upstream(Endless) as port, front_of(port) as front:
        with httpx.stream("GET", front.url) as answer:
            next(answer.iter_raw())
        assert Endless.ended.wait(10)


# Own routes


def test_health_tells_version_uptime_and_what_was_added() -> None:
    with FrontServer(make_app(NOBODY, health=lambda: {"late_ticks": 3}), port=0) as front:
        told = httpx.get(f"{front.url}/api/v1/health").json()
    assert told["version"]
    assert told["uptime_s"] >= 0
    assert told["late_ticks"] == 3


def test_routes_included_later_come_before_viser() -> None:
    app, router = make_app(NOBODY), APIRouter()

    @router.get("/review")
    async def review() -> str:
        return "ours"

    app.include_router(router)
    with FrontServer(app, port=0) as front:
        assert httpx.get(f"{front.url}/review").json() == "ours"
        assert httpx.post(f"{front.url}/review").status_code == 405
        assert httpx.get(f"{front.url}/other").status_code == 502  # asked of viser


def test_unknown_api_paths_are_not_asked_of_viser(alone: FrontServer) -> None:
    assert httpx.get(f"{alone.url}/api/v1/nothing").status_code == 404
    for path in ("/api/v1/nothing", "/assets/page.js"):
        with pytest.raises(InvalidStatus, match="404"):
            open_socket(alone, path)


def test_an_answer_does_not_wait_for_its_own_beginning_to_be_acknowledged(alone: FrontServer) -> None:
    with httpx.Client(base_url=alone.url) as client:
        waits = []
        for _ in range(30):
            begin = time.perf_counter()
            client.get("/api/v1/health")
            waits.append(time.perf_counter() - begin)
    assert sorted(waits)[10] < 0.03  # [s] it would be 0.04 for each but the first


def test_assets_come_typed_and_are_asked_for_again(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "secret.txt").write_text("secret")
    types = {"a.css": "text/css", "a.js": "javascript", "a.html": "text/html", "a.svg": "image/svg+xml"}
    for name in types:
        (tmp_path / "assets" / name).write_text(name)
    with FrontServer(make_app(NOBODY, assets=tmp_path / "assets"), port=0) as front:
        for name, kind in types.items():
            answer = httpx.get(f"{front.url}/assets/{name}")
            assert answer.text == name
            assert kind in answer.headers["Content-Type"]
            assert answer.headers["Cache-Control"] == "no-cache"
            again = httpx.get(str(answer.url), headers={"If-None-Match": answer.headers["ETag"]})
            assert (again.status_code, again.content) == (304, b"")
        connection = http.client.HTTPConnection("127.0.0.1", front.port)
        for target in ("/assets/../secret.txt", "/assets/%2e%2e/secret.txt", "/assets/", "/assets/none.js"):
            connection.request("GET", target)
            answer_to_target = connection.getresponse()
            assert answer_to_target.status == 404
            answer_to_target.read()
        connection.close()


# The door


def test_only_our_own_pages_open_websockets() -> None:
    with websocket_upstream(echo) as port, front_of(port) as front:
        ours = f"127.0.0.1:{front.port}"
        for origin in (None, f"http://{ours}", f"https://{ours}"):  # https: a TLS proxy stands before us
            open_socket(front, origin=origin and Origin(origin)).close()
        for origin in (
            "http://evil.example",
            "null",
            "http://127.0.0.1:1",
            f"http://{ours}.evil.example",
            "",
        ):
            with pytest.raises(InvalidStatus, match="403"):
                open_socket(front, origin=Origin(origin))


def test_only_our_own_pages_change_things() -> None:
    with http_upstream() as port, front_of(port) as front:
        for method in ("POST", "PUT", "PATCH", "DELETE"):
            answer = httpx.request(method, front.url, headers={"Origin": "http://evil.example"})
            assert answer.status_code == 403
            assert "evil.example" in answer.text
        assert httpx.post(front.url, headers={"Origin": front.url}).status_code == 405
        assert httpx.get(front.url, headers={"Origin": "http://evil.example"}).status_code == 418


@pytest.mark.parametrize(
    ("host", "status"),
    [("localhost", 200), ("LOCALHOST:1", 200), ("127.0.0.1:9", 200), ("[::1]:80", 200)]
    + [
        (name, 403)
        for name in ("evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "[::2]", "")
    ],
)
def test_a_name_that_was_made_to_mean_loopback_is_refused(alone: FrontServer, host: str, status: int) -> None:
    assert httpx.get(f"{alone.url}/api/v1/health", headers={"Host": host}).status_code == status


def test_other_addresses_may_have_other_names() -> None:
    with FrontServer(make_app(NOBODY), host="0.0.0.0", port=0, token="t") as front:
        headers = {"Host": "studio.lan", "Authorization": "Bearer t"}
        assert httpx.get(f"{front.url}/api/v1/health", headers=headers).status_code == 200


def test_no_other_page_may_frame_ours(alone: FrontServer) -> None:
    for path in ("/", "/api/v1/health"):
        assert "frame-ancestors 'self'" in httpx.get(alone.url + path).headers["Content-Security-Policy"]


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1, 0, 0, 0),
    "position": (0, 0, 1),
    "look_at": (0, 0, 0),
    "up_direction": (0, 0, 1),
    "fov": 1.0,
    "near": 0.1,
    "far": 9.0,
    "image_height": 9,
    "image_width": 9,
}


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


def test_no_log_line_tells_a_query(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), websocket_upstream(echo) as port, front_of(port) as front:
        httpx.get(f"{front.url}/api/v1/health?token=secret")
        httpx.get(f"{front.url}/page?token=secret")
        open_socket(front, "/socket?token=secret").close()
    lines = [r.getMessage() for r in caplog.records if r.name.startswith(("uvicorn", "websockets.client"))]
    assert any("/api/v1/health" in line for line in lines)
    assert any("/socket" in line for line in lines)
    assert not [line for line in lines if "secret" in line]


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


# Start and stop


def test_a_port_in_use_is_named_and_no_other_taken(alone: FrontServer) -> None:
    second = FrontServer(make_app(NOBODY), port=alone.port)
    with pytest.raises(OSError, match=f"Port {alone.port} on 127.0.0.1 is in use.*--port"):
        second.start()
    assert httpx.get(f"{alone.url}/api/v1/health").status_code == 200


def test_an_address_that_is_not_ours_is_named() -> None:
    for host in ("192.0.2.1", "no.such.host.invalid"):
        with pytest.raises(OSError, match=f"Cannot listen on {host}, port 0: "):
            FrontServer(make_app(NOBODY), host, 0).start()
    with pytest.raises(ValueError, match="Port 99999 does not exist"):
        FrontServer(make_app(NOBODY), port=99999)


def test_stopping_leaves_no_thread_and_no_socket() -> None:
    gc.collect()
    threads, process = set(threading.enumerate()), psutil.Process()
    files = process.num_fds()
    server = start_viser()
    front = front_of(server.get_port())
    front.start()
    httpx.get(front.url)
    browsers = [open_socket(front, subprotocols=[VISER], max_size=None) for _ in range(3)]
    stuck = open_socket(front, subprotocols=[VISER], max_queue=1)
    front.stop()
    front.stop()
    for browser in browsers:
        browser.recv_events_thread.join()  # until the connection ends
        assert browser.close_code == 1012  # the server restarts
    stuck.socket.close()
    server.stop()
    gc.collect()
    wait_for(lambda: set(threading.enumerate()) <= threads)
    assert process.num_fds() <= files


def test_a_stuck_browser_does_not_hold_up_the_stop() -> None:
    flood = Flood()
    with websocket_upstream(flood) as port:
        front = front_of(port)
        front.start()
        stuck = open_socket(front, max_queue=1)
        wait_for(flood.is_stuck)
        begin = time.monotonic()
        front.stop()
        assert time.monotonic() - begin < 3.0
        assert flood.ended.wait(10)
        stuck.socket.close()
