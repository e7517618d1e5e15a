"""What a person elsewhere needs to come in: a link with the token of this installation, and its QR code."""

from __future__ import annotations

import io
import os
import secrets
from pathlib import Path

import segno

from studio.cert import write_secret

# Typed by hand on a headset: no letters that look like others, and 80 bits are not guessed.
ALPHABET = "23456789abcdefghjkmnpqrstuvwxyz"
LENGTH = 16


def folder() -> Path:
    """Where this installation keeps its certificate and its token; no other user may look."""
    root = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "compact-studio"
    root.mkdir(mode=0o700, parents=True, exist_ok=True)
    return root


def token(renew: bool = False) -> str:
    """The same at every start, so that who came in once can come again; `renew` shuts them all out."""
    path = folder() / "token"
    if renew or not path.exists():
        write_secret(path, "".join(secrets.choice(ALPHABET) for _ in range(LENGTH)).encode())
    return path.read_text().strip()


def link(url: str, token: str) -> str:
    return f"{url}/?token={token}"


def qr_text(link: str) -> str:
    """For a terminal."""
    out = io.StringIO()
    segno.make(link, error="l").terminal(out, compact=True)
    return out.getvalue()


def qr_svg(link: str) -> str:
    """For a page, 200 pixels wide or so."""
    return str(segno.make(link, error="m").svg_inline(scale=5, dark="#000", light="#fff", border=3))
