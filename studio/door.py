"""The door of the front server: who may come in, under which name, from which page; and who that is.

On loopback everybody on this machine may come in. On any other address a token is needed: opening the link
with it gives the browser a cookie and takes the token off the address; a program sends it as `Authorization:
Bearer …`, and gets a cookie, too. Each route learns from `person_of(connection)` who asks, e.g. for
`studio.lease.Lease.sit`: who shows the same cookie again is the same person.
"""

from __future__ import annotations

import hmac
import re
import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from html import escape
from urllib.parse import parse_qsl, urlencode

from starlette.datastructures import URL, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from studio.lease import PersonId

SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
PAGE_HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'self'",  # nobody's page frames ours and steals clicks
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}
COOKIE_AGE = 30 * 24 * 3600  # [s] after its last use a browser must show the token again
PERSON = "studio.person"  # where the scope holds the person
BODY_LIMIT = 8 * 1024 * 1024  # [bytes] of a request; a collection of 100,000 takes has half of it

TOO_LARGE = f"A request may have {BODY_LIMIT // 2**20} MB."

Check = Callable[[HTTPConnection], str | None]


def person_of(connection: HTTPConnection) -> PersonId:
    """Who stands behind a request or a WebSocket that came through the door."""
    person: PersonId = connection.scope[PERSON]
    return person


def refuse(status: int, reason: str, headers: Mapping[str, str] | None = None) -> ASGIApp:
    """Answers a request, or the opening of a WebSocket, with a status and a sentence."""
    return answer_with(PlainTextResponse(reason, status, headers))


def answer_with(response: Response) -> ASGIApp:
    """Answers a request, or the opening of a WebSocket, with this."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await WebSocket(scope, receive, send).send_denial_response(response)
        else:
            await response(scope, receive, send)

    return answer


@dataclass(frozen=True, slots=True)
class Access:
    """Who may come in. Persons are known by a cookie that only this server can have signed."""

    secret: str  # signs cookies; where it `is_asked_for` it is the token, too
    is_asked_for: bool
    cookie: str = "studio"  # its name; browsers share cookies between the ports of a machine
    is_secure: bool = False  # whether the cookie is sent over TLS only

    @classmethod
    def of_everybody(cls, cookie: str = "studio", is_secure: bool = False) -> Access:
        """Without a token."""
        return cls(secrets.token_urlsafe(), False, cookie, is_secure)

    def person(self, connection: HTTPConnection) -> PersonId | None:
        """Who shows a cookie of ours; None otherwise."""
        person, _, signature = connection.cookies.get(self.cookie, "").partition(".")
        return PersonId(person) if person and _is_same(signature, self._sign(person)) else None

    def has_token(self, connection: HTTPConnection) -> bool:
        """Whether a program shows the token itself."""
        scheme, _, token = connection.headers.get("authorization", "").partition(" ")
        return scheme.lower() == "bearer" and self.is_token(token.strip())

    def is_token(self, text: str) -> bool:
        return self.is_asked_for and _is_same(text, self.secret)

    def cookie_for(self, person: PersonId) -> str:
        """The value of Set-Cookie. Lax, as Strict is not sent where the link stood in a chat or a mail."""
        flags = f"Path=/; Max-Age={COOKIE_AGE}; HttpOnly; SameSite=Lax" + "; Secure" * self.is_secure
        return f"{self.cookie}={person}.{self._sign(person)}; {flags}"

    def _sign(self, person: str) -> str:
        return hmac.new(self.secret.encode(), person.encode(), sha256).hexdigest()


class Door:
    """Middleware around everything: each check says why a request may not come in, or None."""

    def __init__(self, app: ASGIApp, checks: Iterable[Check], access: Access) -> None:
        self._app, self._checks, self._access = app, tuple(checks), access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        cookie: str | None = None

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in PAGE_HEADERS.items():
                    headers.setdefault(name, value)
                if cookie is not None:
                    headers.append("Set-Cookie", cookie)
            await send(message)

        connection, access = HTTPConnection(scope), self._access
        reason = next((reason for check in self._checks if (reason := check(connection))), None)
        person, is_program = access.person(connection), access.has_token(connection)
        app = self._app
        if reason is not None:
            app = refuse(403, reason)
        elif access.is_asked_for and scope["type"] == "http" and "token" in connection.query_params:
            if access.is_token(connection.query_params["token"]):
                app, cookie = _without_token(connection.url), access.cookie_for(person or _new_person())
            else:
                app = _unauthorized(connection, "This token is not, or no longer, valid.")
        elif person is None and access.is_asked_for and not is_program:
            app = _unauthorized(connection, "You need the link, or the token in it.")
        elif _declared_length(connection) > BODY_LIMIT:
            app = refuse(413, TOO_LARGE)
        else:
            scope[PERSON] = person or _new_person()
            # Also to a browser that has one, so that it does not grow old.
            if _wants_page(connection) or (is_program and person is None):
                cookie = access.cookie_for(scope[PERSON])
        await app(scope, _bounded(receive), send_with_headers)


def known_host(host: str) -> Check:
    """Only our own names, or a page elsewhere whose name is made to mean 127.0.0.1 could talk to us."""
    names = {"localhost", "127.0.0.1", "[::1]", in_url(host)}

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


def _declared_length(connection: HTTPConnection) -> int:
    """[bytes] of the body that a request says it has."""
    length = connection.headers.get("content-length", "")
    return int(length) if length.isascii() and length.isdigit() else 0


def _bounded(receive: Receive) -> Receive:
    """Ends a body that goes on beyond the limit without having said so."""
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        message = await receive()
        if message["type"] == "http.request":
            taken += len(message.get("body", b""))
            if taken > BODY_LIMIT:
                raise HTTPException(413, TOO_LARGE)
        return message

    return bounded


def in_url(host: str) -> str:
    """An address as a URL writes it."""
    return f"[{host}]" if ":" in host else host.lower()


def _new_person() -> PersonId:
    return PersonId(secrets.token_urlsafe(12))


def _is_same(given: str, right: str) -> bool:
    """In a time that tells nothing of where they differ."""
    return hmac.compare_digest(given.encode(), right.encode())


def _wants_page(connection: HTTPConnection) -> bool:
    return connection.scope["type"] == "http" and "text/html" in connection.headers.get("accept", "")


def _without_token(url: URL) -> ASGIApp:
    """To the same page; only the path is told, so that nothing leads elsewhere."""
    kept = [(name, value) for name, value in parse_qsl(url.query, True) if name != "token"]
    path = "/" + url.path.lstrip("/\\")  # "//elsewhere" would be another host
    response = RedirectResponse(path + ("?" + urlencode(kept) if kept else ""), 303)
    response.headers["Cache-Control"] = "no-store"
    return answer_with(response)


def _unauthorized(connection: HTTPConnection, why: str) -> ASGIApp:
    what = (
        "Ask whoever runs the studio for the link: it is shown in the terminal, and under System on the page."
    )
    headers = {"WWW-Authenticate": "Bearer", "Cache-Control": "no-store"}
    if not _wants_page(connection):
        return refuse(401, f"{why} {what}", headers)
    return answer_with(HTMLResponse(_PAGE.format(why=escape(why), what=escape(what)), 401, headers))


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Comp-ACT Studio</title>
<style>
  body {{ margin: 15vh auto; max-width: 30em; padding: 0 1em; font: 1.1em/1.5 system-ui, sans-serif;
    background: #14171c; color: #d8dce3 }}
  input, button {{ font: inherit; padding: 0.4em 0.7em; border-radius: 0.4em; border: 1px solid #4a515c;
    background: #262b33; color: inherit }}
  button {{ background: #355a94 }}
</style>
<h1>Comp-ACT Studio</h1>
<p>{why}</p>
<p>{what}</p>
<form action="/"><input name="token" placeholder="Token" autocomplete="off" autocapitalize="none" autofocus>
<button>Enter</button></form>
</html>
"""
