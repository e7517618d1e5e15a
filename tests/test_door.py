"""The door on an address that others can reach: a token, its cookie, TLS, and a token that no log tells."""

from __future__ import annotations

import logging
import ssl
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Self

import httpx
import pytest
from fastapi import Request, WebSocket
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from studio import cert, invitation
from studio.door import person_of
from studio.server import FrontServer, make_app

NOBODY = 9  # the discard port: nothing listens there
TOKEN = "a-token-that-is-secret"
PAGE = {"Accept": "text/html"}


def make_front(**options: object) -> FrontServer:
    """A server that tells who asks."""
    app = make_app(NOBODY)

    @app.get("/who")
    async def who(request: Request) -> str:
        return person_of(request)

    @app.post("/who")
    async def change(request: Request) -> str:
        return person_of(request)

    @app.post("/size")
    async def size(request: Request) -> int:
        return len(await request.body())

    @app.websocket("/ws/who")
    async def socket(websocket: WebSocket) -> None:
        await websocket.accept()
        await websocket.send_text(person_of(websocket))
        await websocket.close()

    return FrontServer(app, port=0, **options)  # type: ignore[arg-type]


@pytest.fixture
def front() -> Iterator[FrontServer]:
    with make_front(host="0.0.0.0", token=TOKEN) as front:
        yield front


class Browser(httpx.Client):
    """One that has opened the link."""

    def __init__(self, front: FrontServer) -> None:
        super().__init__(base_url=front.url, headers=PAGE)

    def __enter__(self) -> Self:
        super().__enter__()
        assert self.get("/who", params={"token": TOKEN}).status_code == 303
        return self

    @property
    def cookie(self) -> dict[str, str]:
        """As a header."""
        return {"Cookie": "; ".join(f"{name}={value}" for name, value in self.cookies.items())}


def test_without_the_token_there_is_nothing_but_a_page_that_says_what_to_do(front: FrontServer) -> None:
    for path in ("/", "/who", "/api/v1/health", "/assets/page.js", "/xr"):
        answer = httpx.get(front.url + path, headers=PAGE)
        assert answer.status_code == 401
        assert "Ask whoever runs the studio for the link" in answer.text
        assert '<input name="token"' in answer.text
        assert "set-cookie" not in answer.headers
    assert httpx.post(f"{front.url}/who").status_code == 401
    with pytest.raises(InvalidStatus, match="401"):
        connect(f"ws://localhost:{front.port}/", proxy=None)


@pytest.mark.parametrize("token", ["", "x", TOKEN + "x", TOKEN[:-1], "ä"])
def test_a_wrong_token_is_refused(front: FrontServer, token: str) -> None:
    answer = httpx.get(f"{front.url}/", params={"token": token}, headers=PAGE)
    assert answer.status_code == 401
    assert "not, or no longer, valid" in answer.text
    bearer = {"Authorization": f"Bearer {token}.".encode()}
    assert httpx.get(f"{front.url}/who", headers=bearer).status_code == 401


def test_the_link_becomes_a_cookie_and_leaves_the_address(front: FrontServer) -> None:
    answer = httpx.get(f"{front.url}/who", params={"a": "1 2", "token": TOKEN, "b": ""})
    assert answer.status_code == 303
    assert answer.headers["Location"] == "/who?a=1+2&b="
    cookie = answer.headers["Set-Cookie"]
    assert cookie.startswith(f"studio_{front.port}=")
    assert "; HttpOnly; SameSite=Lax" in cookie
    assert TOKEN not in cookie
    with Browser(front) as ana, Browser(front) as ben:
        who = ana.get("/who").json()
        assert ana.post("/who", headers={"Origin": front.url}).json() == who
        assert ben.get("/who").json() != who
        url = f"ws://localhost:{front.port}/ws/who"
        with connect(url, additional_headers=ana.cookie, proxy=None) as socket:
            assert socket.recv(timeout=10) == who


def test_the_link_leads_nowhere_else(front: FrontServer) -> None:
    for path in ("//evil.example/", "/%5Cevil.example", "///evil.example"):
        location = httpx.get(f"{front.url}{path}?token={TOKEN}").headers["Location"]
        assert not location.startswith(("//", "/\\"))
        assert ":" not in location


def test_a_cookie_that_was_made_up_or_is_of_another_token_is_none(front: FrontServer) -> None:
    with Browser(front) as browser:
        (name, value), *_ = browser.cookies.items()
    person, _, signature = value.partition(".")
    with make_front(host="0.0.0.0", token="another") as other:
        renamed = {"Cookie": f"studio_{other.port}={value}"}
        assert httpx.get(f"{other.url}/who", headers=renamed).status_code == 401
    for made_up in (f"{person}x.{signature}", f"{person}.", f".{signature}", signature, TOKEN):
        headers = {"Cookie": f"{name}={made_up}"}
        assert httpx.get(f"{front.url}/who", headers=headers).status_code == 401


def test_a_program_shows_the_token_itself_and_is_known_again_by_its_cookie(front: FrontServer) -> None:
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx.Client(headers=headers) as one, httpx.Client(headers=headers) as other:
        who = one.get(f"{front.url}/who").json()
        assert one.get(f"{front.url}/who").json() == who
        assert other.get(f"{front.url}/who").json() != who  # or it would drive with the other's lease


def test_a_page_from_elsewhere_is_refused_whatever_cookie_its_browser_has(front: FrontServer) -> None:
    origin = {"Origin": "http://evil.example"}
    with Browser(front) as browser:
        assert browser.post("/who", headers=origin).status_code == 403
        url = f"ws://localhost:{front.port}/ws/who"
        with pytest.raises(InvalidStatus, match="403"):
            connect(url, additional_headers=browser.cookie | origin, proxy=None)


@pytest.mark.parametrize("is_declared", [True, False])
def test_a_body_of_ten_megabytes_is_refused_and_not_kept(is_declared: bool) -> None:
    def body(n: int) -> bytes | Iterator[bytes]:
        return bytes(n) if is_declared else iter([bytes(1_000_000)] * (n // 1_000_000))

    with make_front() as front:
        assert httpx.post(f"{front.url}/size", content=body(8_000_000)).json() == 8_000_000
        answer = httpx.post(f"{front.url}/size", content=body(10_000_000))
        assert answer.status_code == 413
        assert "8 MB" in answer.text


def test_on_loopback_each_browser_is_somebody_without_a_token() -> None:
    with make_front() as front, httpx.Client(base_url=front.url, headers=PAGE) as browser:
        assert front.token is None
        who = browser.get("/who").json()
        assert browser.get("/who").json() == who
        assert httpx.get(f"{front.url}/who").json() != who
        assert "set-cookie" not in httpx.get(f"{front.url}/who").headers  # no page, no cookie


def test_another_address_is_never_open() -> None:
    front = make_front(host="0.0.0.0")
    assert front.token
    assert len(front.token) > 20


def test_no_log_line_tells_the_token(front: FrontServer, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG):
        with Browser(front) as browser:
            browser.get("/who")
            url = f"ws://localhost:{front.port}/ws/who"
            headers = {"Authorization": f"Bearer {TOKEN}"}
            connect(url, additional_headers=headers, proxy=None).close()
        httpx.get(f"{front.url}/?token={TOKEN}x")
        with pytest.raises(InvalidStatus):
            connect(f"ws://localhost:{front.port}/?token={TOKEN}", proxy=None)
    lines = [record.getMessage() for record in caplog.records if record.name.startswith("uvicorn")]
    assert any("GET /who" in line for line in lines)
    assert not [line for line in lines if TOKEN in line]


# What this installation keeps


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return tmp_path / "compact-studio"


def test_the_token_stays_until_it_is_renewed_and_nobody_else_may_read_it(home: Path) -> None:
    token = invitation.token()
    assert invitation.token() == token
    assert (home / "token").stat().st_mode & 0o777 == 0o600
    assert home.stat().st_mode & 0o777 == 0o700
    assert invitation.token(renew=True) != token


def test_tls_with_the_certificate_of_this_installation(home: Path) -> None:
    certificate = cert.of_installation(invitation.folder())
    assert certificate.key.stat().st_mode & 0o777 == 0o600
    assert cert.of_installation(invitation.folder()) == certificate
    facts = cert.read(certificate)
    assert {"localhost", "127.0.0.1", "::1"} < set(facts.names)
    assert facts.expires > datetime.now(UTC) + timedelta(days=800)
    with make_front(host="0.0.0.0", token=TOKEN, certificate=certificate) as front:
        assert front.url.startswith("https://localhost:")
        trusting = ssl.create_default_context(cafile=str(certificate.path))
        with httpx.Client(base_url=front.url, verify=trusting) as browser:
            answer = browser.get("/who", params={"token": TOKEN})
            assert "; Secure" in answer.headers["Set-Cookie"]
            # Another name than without TLS, where browsers leave this one alone and would let nobody in.
            assert answer.headers["Set-Cookie"].startswith(f"__Host-studio_{front.port}=")
            who = browser.get("/who").json()
            headers = {
                "Cookie": "; ".join(f"{n}={v}" for n, v in browser.cookies.items()),
                "Origin": front.url,
            }
            url = f"wss://localhost:{front.port}/ws/who"
            with connect(url, additional_headers=headers, ssl=trusting, proxy=None) as socket:
                assert socket.recv(timeout=10) == who
        with pytest.raises(httpx.ConnectError):
            httpx.get(front.url)  # whom nobody vouches for


def test_a_certificate_that_has_expired_is_made_again(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cert, "DAYS", -1 / 24)
    old = cert.read(cert.of_installation(invitation.folder()))
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home.parent))
    new = cert.read(cert.of_installation(invitation.folder()))
    assert old.fingerprint != new.fingerprint
    assert new.expires > datetime.now(UTC)


def test_files_that_do_not_belong_together_are_told(tmp_path: Path) -> None:
    one, other = cert.make(tmp_path / "one", ["a.example"]), cert.make(tmp_path / "other", ["192.0.2.7"])
    assert cert.read(other).names == ("192.0.2.7",)
    with pytest.raises(ValueError, match="is not the key of"):
        cert.read(cert.Certificate(one.path, other.key))
    with pytest.raises(ValueError, match="hold no certificate"):
        cert.read(cert.Certificate(one.key, one.key))


def test_the_qr_code_is_of_the_link() -> None:
    link = invitation.link("https://192.0.2.1:8080", TOKEN)
    assert link == f"https://192.0.2.1:8080/?token={TOKEN}"
    svg, text = invitation.qr_svg(link), invitation.qr_text(link)
    assert svg.startswith("<svg")
    assert len({len(line) for line in text.splitlines() if line}) == 1
    assert svg != invitation.qr_svg(link + "x")
