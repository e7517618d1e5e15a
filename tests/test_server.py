"""The front server: its own routes, strangers that stay out, and how it starts and stops."""

from __future__ import annotations

import gc
import http.client
import logging
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import psutil
import pytest
from fastapi import APIRouter
from upstream import NOBODY, VISER, Flood, echo, front_of, http_upstream, open_socket, websocket_upstream
from visitor import wait_for
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin

from studio.server import FrontServer, make_app, start_viser


@pytest.fixture
def alone() -> Iterator[FrontServer]:
    """A front server whose viser does not answer."""
    with front_of(NOBODY) as front:
        yield front


# Own routes


def test_without_viser_the_page_says_so_and_our_own_routes_work(alone: FrontServer) -> None:
    answer = httpx.get(alone.url)
    assert answer.status_code == 502
    assert "does not answer" in answer.text
    with pytest.raises(InvalidStatus, match="502"):
        open_socket(alone)
    assert httpx.get(f"{alone.url}/api/v1/health").json()["status"] == "ok"


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


def test_a_target_of_another_host_is_not_followed(alone: FrontServer) -> None:
    with http_upstream() as elsewhere:
        for target in (f"@127.0.0.1:{elsewhere}/", f"http://127.0.0.1:{elsewhere}/", "*"):
            with socket.create_connection(("127.0.0.1", alone.port)) as raw:
                request = f"OPTIONS {target} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
                raw.sendall(request.encode())
                assert raw.makefile("rb").readline().split()[1] == b"400"


def test_other_addresses_may_have_other_names() -> None:
    with FrontServer(make_app(NOBODY), host="0.0.0.0", port=0, token="t") as front:
        headers = {"Host": "studio.lan", "Authorization": "Bearer t"}
        assert httpx.get(f"{front.url}/api/v1/health", headers=headers).status_code == 200


def test_no_other_page_may_frame_ours(alone: FrontServer) -> None:
    for path in ("/", "/api/v1/health"):
        assert "frame-ancestors 'self'" in httpx.get(alone.url + path).headers["Content-Security-Policy"]


def test_no_log_line_tells_a_query(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), websocket_upstream(echo) as port, front_of(port) as front:
        httpx.get(f"{front.url}/api/v1/health?token=secret")
        httpx.get(f"{front.url}/page?token=secret")
        open_socket(front, "/socket?token=secret").close()
    lines = [r.getMessage() for r in caplog.records if r.name.startswith(("uvicorn", "websockets.client"))]
    assert any("/api/v1/health" in line for line in lines)
    assert any("/socket" in line for line in lines)
    assert not [line for line in lines if "secret" in line]


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
