"""Identity of a process on the bus: a folder with a certificate, its private key and the authority.

`driveby certs` makes one such folder for each router, service and truck, and without the last file
for each part of a Dask cluster:

    ca.pem        the authority's certificate, which verifies others
    cert.pem      the own certificate; its common name is ROLE/NAME, e.g. truck/truck-1
    key.pem       its private key, readable by its owner alone
    zenoh.json5   the same as a configuration of Zenoh; with access control for listeners

No key is ever written to a message or a log.
"""

import logging
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import NameOID

from schemas.topics import check_identifier
from services.common.errors import InputError
from services.common.files import read_bytes

BUS_ROLES = ("router", "logger", "worker", "viewer", "replay", "truck")
CLUSTER_ROLES = ("scheduler", "cluster-worker", "client")
"""Roles of a Dask cluster, which runs any code that it receives: they have an authority of their
own, which issues no certificate for the bus."""
ROLES = (*BUS_ROLES, *CLUSTER_ROLES)
LISTENERS = ("router", "logger")
"""Roles that accept connections: their certificates are valid for servers and name hosts."""
CLUSTER_LISTENERS = ("scheduler", "cluster-worker")
"""Roles with certificates for servers; Dask checks the authority and not the hosts."""
AUTHORITY, CERTIFICATE, KEY, CONFIGURATION = "ca.pem", "cert.pem", "key.pem", "zenoh.json5"

_log = logging.getLogger(__name__)
_WARN_BEFORE = timedelta(days=30)
_WARN_AGAIN = timedelta(days=1)
_CHECK_PERIOD_S = 3600.0
"""Longest sleep between two checks: a sleep does not count the time of a suspended machine."""
_CLOCK_TOLERANCE = timedelta(minutes=5)
_warned: dict[tuple[Path, datetime], datetime] = {}
"""Time of the last warning by file and expiry: a service without a router checks every second."""
_watched: set[tuple[Path, datetime]] = set()


class Subject(NamedTuple):
    """The subject of a certificate."""

    role: str
    name: str

    def __str__(self) -> str:
        """Return the common name of its certificate."""
        return f"{self.role}/{self.name}"


def parse_subject(text: str) -> Subject:
    """Return the parts of ROLE/NAME; raise ValueError if it is malformed."""
    role, _, name = text.partition("/")
    if role not in ROLES:
        raise ValueError(f"{text[:80]!r}: ROLE/NAME is expected, ROLE one of {', '.join(ROLES)}")
    return Subject(role, check_identifier(name))


def subject_of(certificate: x509.Certificate) -> Subject:
    """Return the subject of a certificate; raise ValueError if its common name is not ROLE/NAME."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    if len(names) != 1:
        raise ValueError("the certificate has no common name")
    return parse_subject(str(names[0].value))


def check_credentials(folder: Path, now: datetime | None = None) -> Subject:
    """Return the subject of the credentials in a folder, after all checks possible offline.

    A router answers a bad certificate with silence, so every detectable error is reported here: a
    missing file, a key that others may read or of another certificate, another authority, a
    certificate that has expired or is not valid yet. The InputError names the file.
    """
    now = now or datetime.now(UTC)
    certificate = read_certificate(folder / CERTIFICATE)
    authority = read_certificate(folder / AUTHORITY)
    _check_key(folder / KEY, certificate)
    try:
        subject = subject_of(certificate)
    except ValueError as error:
        raise InputError(f"{folder / CERTIFICATE}: {error}; see `driveby certs --help`") from None
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        where = folder / CERTIFICATE
        raise InputError(f"{where}: was not issued by the authority of {AUTHORITY}") from None
    for path, one in ((folder / CERTIFICATE, certificate), (folder / AUTHORITY, authority)):
        if now > one.not_valid_after_utc:
            day = one.not_valid_after_utc.date()
            raise InputError(f"{path}: expired on {day}; renew it with `driveby certs --renew`")
        if now < one.not_valid_before_utc - _CLOCK_TOLERANCE:
            day = one.not_valid_before_utc.date()
            raise InputError(f"{path}: valid from {day} only; is this machine's clock right?")
        _warn_of_expiry(path, one.not_valid_after_utc, now)
    return subject


def watch_expiry(folder: Path) -> None:
    """Log, while this process runs, that the credentials of a session expire or have expired.

    A service runs for months, and afterwards every connection ends without a cause.
    """
    paths = folder.absolute() / CERTIFICATE, folder.absolute() / AUTHORITY
    expires, path = min((read_certificate(path).not_valid_after_utc, path) for path in paths)
    if (path, expires) not in _watched:
        _watched.add((path, expires))
        arguments = (path, expires)
        threading.Thread(target=_log_expiry, args=arguments, name="expiry", daemon=True).start()


def _log_expiry(path: Path, expires: datetime) -> None:
    while True:
        now = datetime.now(UTC)
        _warn_of_expiry(path, expires, now)
        left_s = (expires - now).total_seconds()
        time.sleep(min(left_s + 0.1, _CHECK_PERIOD_S) if left_s > 0.0 else _CHECK_PERIOD_S)


def _warn_of_expiry(path: Path, expires: datetime, now: datetime) -> None:
    """Warn of a certificate that expires soon, once a day, and at once when it has expired."""
    name = (path.absolute(), expires)
    last = _warned.get(name)
    is_new = last is None or now > last + _WARN_AGAIN or last <= expires < now
    if now <= expires - _WARN_BEFORE or not is_new:
        return
    _warned[name] = now
    if now <= expires:
        _log.warning("%s expires on %s", path, expires.date())
    else:
        _log.error(
            "%s expired on %s, so every connection ends; renew it with `driveby certs --renew` "
            "and restart",
            path, expires.date(),
        )  # fmt: skip


def check_speaks_for(folder: Path | None, role: str, name: str | None = None) -> None:
    """Raise InputError if the credentials are not those of this role and name (None: any name).

    The access control of a router drops the messages of other roles silently: after a mistake in
    the folder nothing would show why they do not arrive. None, no credentials, passes.
    """
    if folder is None:
        return
    subject = check_credentials(folder)
    if subject.role != role or name not in (None, subject.name):
        raise InputError(f"{folder}: is the certificate of {subject}, not of {role}/{name or '…'}")


def read_certificate(path: Path) -> x509.Certificate:
    """Return the certificate of a PEM file; raise InputError if there is none."""
    content = read_bytes(path)
    try:
        return x509.load_pem_x509_certificate(content)
    except ValueError:
        raise InputError(f"{path}: is not a certificate in PEM format") from None


def hosts_of(certificate: x509.Certificate) -> list[str]:
    """Return the names and addresses of hosts in a certificate; none without the extension."""
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return []
    return [
        str(one.value) for one in found.value if not isinstance(one, x509.UniformResourceIdentifier)
    ]


def unlisted_hint(folder: Path) -> str:
    """Return why a router may send nothing to the holder of a folder's credentials."""
    return (
        f"the router's list of participants lacks {check_credentials(folder)}, which is new "
        "or revoked, see docs/security.md#changes"
    )


def link_settings(folder: Path | str) -> dict[str, Any]:
    """Return Zenoh's settings for mutual TLS, and TLS only, with a folder's credentials.

    The client authenticates itself and checks that the router's certificate names the intended
    host. A link ends when a certificate on it expires.
    """
    key, certificate = f"{folder}/{KEY}", f"{folder}/{CERTIFICATE}"
    return {
        "protocols": ["tls"],
        "tls": {
            "root_ca_certificate": f"{folder}/{AUTHORITY}",
            "listen_private_key": key,
            "listen_certificate": certificate,
            "connect_private_key": key,
            "connect_certificate": certificate,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def _check_key(path: Path, certificate: x509.Certificate) -> None:
    content = read_bytes(path)
    if path.stat().st_mode & 0o077:
        raise InputError(f"{path}: others may read this private key; chmod 600 {path}")
    try:
        key = load_pem_private_key(content, password=None)
    except (ValueError, TypeError):
        raise InputError(f"{path}: is not a private key in PEM format without a password") from None
    form = (Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if key.public_key().public_bytes(*form) != certificate.public_key().public_bytes(*form):
        raise InputError(f"{path}: is not the key of {CERTIFICATE} next to it")
