"""A certificate of this installation, so that browsers elsewhere get TLS, without which there is no WebXR.

Nobody else has its key and nobody vouches for it: a browser warns once, and `fingerprint` tells whether it is
the right one. Where a certificate that browsers trust is to be had, `studio serve --cert --key` takes it.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cryptography.x509 import GeneralName

DAYS = 825  # the longest that Apple's browsers take
FILES = ("cert.pem", "key.pem")


@dataclass(frozen=True, slots=True)
class Certificate:
    """Two PEM files."""

    path: Path
    key: Path


@dataclass(frozen=True, slots=True)
class Facts:
    """What a certificate says."""

    names: tuple[str, ...]  # host names and addresses
    expires: datetime
    fingerprint: str  # SHA-256, as browsers show it


def make(folder: Path, names: Iterable[str]) -> Certificate:
    """A new key, readable by nobody else, and a certificate for these host names and addresses."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

    names = tuple(dict.fromkeys(names))
    if not names:
        raise ValueError("A certificate needs a name.")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "Comp-ACT Studio")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))  # for clocks that are late
        .not_valid_after(now + timedelta(days=DAYS))
        .add_extension(x509.SubjectAlternativeName([_general(name) for name in names]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    made = Certificate(*(folder / name for name in FILES))
    pem = serialization.Encoding.PEM
    write_secret(
        made.key,
        key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()),
    )
    made.path.write_bytes(certificate.public_bytes(pem))
    return made


def of_installation(folder: Path) -> Certificate:
    """The one of this installation; made where there is none, and again where it has expired."""
    found = Certificate(*(folder / name for name in FILES))
    if not (found.path.exists() and found.key.exists()) or read(found).expires < datetime.now(UTC):
        return make(folder, names_of_this_machine())
    return found


def read(certificate: Certificate) -> Facts:
    """Raises ValueError where the files are no certificate and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization

    try:
        found = x509.load_pem_x509_certificate(certificate.path.read_bytes())
        key = serialization.load_pem_private_key(certificate.key.read_bytes(), None)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{certificate.path} and {certificate.key} hold no certificate and key.") from error
    if key.public_key() != found.public_key():
        raise ValueError(f"{certificate.key} is not the key of {certificate.path}.")
    names: tuple[str, ...] = ()
    with suppress(x509.ExtensionNotFound):
        general = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        names = tuple(str(name.value) for name in general)
    return Facts(names, found.not_valid_after_utc, found.fingerprint(hashes.SHA256()).hex(":").upper())


def names_of_this_machine() -> tuple[str, ...]:
    """Host names and addresses, the most useful to others first."""
    host = socket.gethostname()
    found = [*_addresses(), host, *([f"{host}.local"] if "." not in host else [])]
    return tuple(dict.fromkeys([*found, "localhost", "127.0.0.1", "::1"]))


def write_secret(path: Path, data: bytes) -> None:
    """Into a file that never was another user's to read."""
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)


def _addresses() -> list[str]:
    """Of this machine on its networks; the one that leads to the internet first."""
    found = []
    for family, elsewhere in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((elsewhere, 9))  # sends nothing; chooses the address that it would send from
            found.append(probe.getsockname()[0])
    with suppress(OSError):
        found += [info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None)]
    usable = [str(address).partition("%")[0] for address in found]
    return [a for a in dict.fromkeys(usable) if not ipaddress.ip_address(a).is_loopback]


def _general(name: str) -> GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)
