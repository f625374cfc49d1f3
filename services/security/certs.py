"""Credentials of the bus by `driveby certs`: a private authority, and a folder per subject.

The folder then holds:

    authority/ca.pem       the certificate that every subject trusts
    authority/ca-key.pem   the key that signs certificates; may be kept elsewhere between two runs
    authority/issued/      a copy of every certificate, the list of subjects with access
    authority/revoked/     certificates of subjects without access
    NAME/                  the files for NAME's machine: see services.bus.credentials

Zenoh has no list of revoked certificates. A revoked subject is kept out by the access control of
the routers, which lists those with access; every run writes it again.

A Dask cluster runs whatever it receives from any holder of a certificate of its authority. So that
is another authority, in another folder (`--cluster`): a stolen truck must not gain access there.
"""

import ipaddress
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from schemas.topics import check_identifier
from services.bus.access_control import access_control
from services.bus.credentials import (
    AUTHORITY,
    BUS_ROLES,
    CERTIFICATE,
    CLUSTER_LISTENERS,
    CLUSTER_ROLES,
    CONFIGURATION,
    KEY,
    LISTENERS,
    Subject,
    hosts_of,
    link_settings,
    parse_subject,
    read_certificate,
    subject_of,
)
from services.common.errors import FailureError, InputError
from services.common.files import read_bytes, write_atomically
from services.security.settings import CertsSettings

AUTHORITY_DAYS = 3650
FIRST = tuple(Subject(role, role) for role in ("router", "logger", "worker", "viewer", "replay"))
"""Subjects created together with the authority."""
FIRST_OF_CLUSTER = tuple(Subject(role, role) for role in CLUSTER_ROLES)
"""Subjects created together with the authority of a cluster."""
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
PLACE = "/etc/driveby/tls"
"""Folder on its machine that the generated configurations expect."""

_AUTHORITY_KEY = "ca-key.pem"
_FOLDER, _ISSUED, _REVOKED = "authority", "issued", "revoked"
_PORT = 7447
_CLOCK_SLACK = timedelta(days=1)
"""Age of a new certificate's validity: a truck's clock may be slow."""
_HOST = re.compile(r"(?=.{1,253}\Z)(?!-)[A-Za-z0-9-]{1,63}(\.(?!-)[A-Za-z0-9-]{1,63})*")

_Key = ec.EllipticCurvePrivateKey


class _Authority(NamedTuple):
    folder: Path
    certificate: x509.Certificate

    def key(self) -> _Key:
        path = self.folder / _AUTHORITY_KEY
        if not path.exists():
            raise InputError(
                f"{path}: the authority's private key is not here; "
                "bring it back for as long as certificates are made"
            )
        try:
            key = load_pem_private_key(read_bytes(path), password=None)
        except (ValueError, TypeError):
            raise InputError(
                f"{path}: is not a private key in PEM format without a password"
            ) from None
        if not isinstance(key, _Key) or key.public_key() != self.certificate.public_key():
            raise InputError(f"{path}: is not the key of {AUTHORITY} next to it")
        return key

    def issued(self) -> dict[str, x509.Certificate]:
        """Return the certificates of the subjects with access, by name."""
        paths = sorted((self.folder / _ISSUED).glob("*.pem"))
        return {path.stem: read_certificate(path) for path in paths}

    def subjects(self) -> dict[str, Subject]:
        try:
            return {name: subject_of(one) for name, one in self.issued().items()}
        except ValueError as error:
            raise InputError(f"{self.folder / _ISSUED}: {error}") from None


def certs_command(asked: CertsSettings) -> list[str]:
    """Create credentials in a folder and return lines on its present contents.

    The first run creates the authority, `FIRST` and the named trucks, or with `cluster` the
    authority of a cluster and `FIRST_OF_CLUSTER`. A later one adds `trucks` and `add` (ROLE/NAME),
    gives the names in `renew` a new key and certificate, removes those in `revoke` from the list,
    and leaves everything else as it is. Certificates of routers and loggers name this machine and
    `host`.

    Raise InputError, and create nothing, for a malformed name, one that exists already or was
    revoked, an unknown name to renew or revoke, a role of a cluster in a folder of the bus or the
    other way round, and without the authority's key.
    """
    folder, hosts, is_cluster = asked.folder, asked.host, asked.cluster
    for host in hosts:
        _check_host(host)
    authority = _existing(folder)
    wanted = [_truck(name) for name in asked.trucks] + [_other(text) for text in asked.add]
    if authority is None:
        if asked.renew or asked.revoke:
            raise InputError(f"{folder}: has no authority yet, so there is nothing to change")
        wanted = [*(FIRST_OF_CLUSTER if is_cluster else FIRST), *wanted]
    _check_kind(folder, authority, wanted, is_cluster=is_cluster)
    _check_new(folder, authority, wanted)
    renewed = [] if authority is None else _existing_subjects(authority, asked.renew)
    revoked = [] if authority is None else _existing_subjects(authority, asked.revoke)
    if revoked and revoked[0].role in CLUSTER_ROLES:
        raise InputError("--revoke: Dask knows no revoked certificates; make a new authority")
    if both := set(renewed) & set(revoked):
        raise InputError(f"{min(both).name}: either renew or revoke it")
    if hosts and not any(subject.role in LISTENERS for subject in [*wanted, *renewed]):
        raise InputError("--host concerns routers and loggers; name one in --add or --renew")
    try:
        if authority is None:
            authority = _make_authority(folder)
        key = authority.key() if wanted or renewed else None
        for subject in revoked:
            _revoke(authority, subject)
        for subject in [*wanted, *renewed]:
            assert key is not None  # noqa: S101 - read above, before anything is changed
            _issue(folder, authority, key, subject, hosts, asked.days)
        _write_access_control(folder, authority)
    except OSError as error:
        where = folder if error.filename is None else error.filename
        raise FailureError(f"{where}: cannot be written: {error.strerror}") from None
    return [*_changes(folder, authority, renewed, revoked), *_summary(folder, authority)]


def _changes(
    folder: Path, authority: _Authority, renewed: Sequence[Subject], revoked: Sequence[Subject]
) -> Iterator[str]:
    """Yield a line on each renewed or revoked subject, with what remains to be done."""
    names = [one.name for one in authority.subjects().values() if one.role in LISTENERS]
    files = " and ".join(str(folder / name / CONFIGURATION) for name in names)
    todo = f"copy {files} to their machines, restart {' and '.join(names)}"
    yield from (f"{one} is revoked: {todo}" for one in revoked)
    todo = "to its machine, restart what uses it"
    yield from (f"{one} is renewed: copy {folder / one.name} {todo}" for one in renewed)


def _check_kind(
    folder: Path, authority: _Authority | None, wanted: Iterable[Subject], *, is_cluster: bool
) -> None:
    """Check that an authority is of the bus or of a cluster, never of both."""
    if authority is not None:
        is_of_cluster = any(one.role in CLUSTER_ROLES for one in authority.subjects().values())
        if is_cluster and not is_of_cluster:
            raise InputError(
                f"{folder}: is an authority of the bus; --cluster needs another folder"
            )
        is_cluster = is_of_cluster
    kind, roles = ("a cluster", CLUSTER_ROLES) if is_cluster else ("the bus", BUS_ROLES)
    for subject in wanted:
        if subject.role not in roles:
            raise InputError(
                f"{subject}: {folder} is an authority of {kind}, where every subject is one of "
                f"{', '.join(roles)}; a cluster has a folder of its own (--cluster)"
            )


def _truck(name: str) -> Subject:
    try:
        return Subject("truck", check_identifier(name))
    except ValueError as error:
        raise InputError(f"--trucks: {error}") from None


def _other(text: str) -> Subject:
    try:
        return parse_subject(text)
    except ValueError as error:
        raise InputError(f"--add: {error}") from None


def _check_host(host: str) -> None:
    if not (_is_address(host) or _HOST.fullmatch(host)):
        raise InputError(f"--host {host[:80]!r}: the name or the address of a machine is expected")


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _existing(folder: Path) -> _Authority | None:
    place = folder / _FOLDER
    if not place.exists():
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file, the name of a folder is expected")
        if not folder.absolute().parent.is_dir():
            raise InputError(f"{folder}: the folder {folder.absolute().parent} does not exist")
        if folder.exists() and folder.stat().st_mode & 0o022:
            raise InputError(f"{folder}: others may write there; chmod 700 {folder}")
        return None
    return _Authority(place, read_certificate(place / AUTHORITY))


def _check_new(folder: Path, authority: _Authority | None, wanted: Iterable[Subject]) -> None:
    """Check that nothing is overwritten, and that no name is given twice."""
    used = set() if authority is None else set(authority.issued())
    for subject in wanted:
        name = subject.name
        if authority is not None and (authority.folder / _REVOKED / f"{name}.pem").exists():
            raise InputError(
                f"{name}: was revoked, and its old key would become valid again; "
                "take another name or make a new authority in another folder"
            )
        if name in used or (folder / name).exists():
            raise InputError(f"{folder / name}: exists and is not overwritten; --renew replaces it")
        if name == _FOLDER:
            raise InputError(f"{name!r} is the name of the authority's folder, take another")
        used.add(name)


def _existing_subjects(authority: _Authority, names: Iterable[str]) -> list[Subject]:
    subjects = authority.subjects()
    for name in names:
        if name not in subjects:
            there = ", ".join(subjects)
            raise InputError(f"{name[:80]}: has no certificate here, only {there} have")
    return [subjects[name] for name in dict.fromkeys(names)]


def _make_authority(folder: Path) -> _Authority:
    folder.mkdir(mode=0o700, exist_ok=True)
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.now(UTC)
    # The number distinguishes an authority from one that replaces it.
    name = f"driveby {now:%Y-%m-%d} {secrets.token_hex(4)}"
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    certificate = (
        _builder(key, now, now + timedelta(days=AUTHORITY_DAYS))
        .subject_name(subject)
        .issuer_name(subject)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    with _new_folder(folder / _FOLDER) as new:
        (new / _ISSUED).mkdir(mode=0o700)
        (new / _REVOKED).mkdir(mode=0o700)
        _write_key(new / _AUTHORITY_KEY, key)
        (new / AUTHORITY).write_bytes(certificate.public_bytes(Encoding.PEM))
    return _Authority(folder / _FOLDER, certificate)


def _issue(
    folder: Path,
    authority: _Authority,
    authority_key: _Key,
    subject: Subject,
    hosts: Sequence[str],
    days: int,
) -> None:
    """Create a key and a certificate; one of the same name is replaced."""
    listens = subject.role in LISTENERS
    copy = authority.folder / _ISSUED / f"{subject.name}.pem"
    if listens:
        before = hosts_of(read_certificate(copy)) if copy.exists() else LOCAL_HOSTS
        hosts = tuple(dict.fromkeys([*before, *hosts]))
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.now(UTC)
    until = min(now + timedelta(days=days), authority.certificate.not_valid_after_utc)
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    # Otherwise a truck could pose as the router, and a client as the scheduler.
    if listens or subject.role in CLUSTER_LISTENERS:
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
    builder = (
        _builder(key, now, until)
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, str(subject))]))
        .issuer_name(authority.certificate.subject)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()),
            critical=False,
        )
        .add_extension(_alternative_names(subject, hosts if listens else ()), critical=False)
    )
    certificate = builder.sign(authority_key, hashes.SHA256()).public_bytes(Encoding.PEM)
    with _new_folder(folder / subject.name) as new:
        _write_key(new / KEY, key)
        (new / CERTIFICATE).write_bytes(certificate)
        public = authority.certificate.public_bytes(Encoding.PEM)
        (new / AUTHORITY).write_bytes(public)
        if not listens and subject.role in BUS_ROLES:
            (new / CONFIGURATION).write_text(_client_configuration(_router_host(authority)))
        # On the list before the folder exists: a listed name is never issued twice.
        write_atomically(copy, certificate)


def _builder(key: _Key, now: datetime, until: datetime) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_SLACK)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative_names(subject: Subject, hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    """Return the hosts of a listening subject; for others a name that no host can have."""
    if not hosts:
        return x509.SubjectAlternativeName([x509.UniformResourceIdentifier(f"driveby:{subject}")])
    return x509.SubjectAlternativeName(
        [
            x509.IPAddress(ipaddress.ip_address(host)) if _is_address(host) else x509.DNSName(host)
            for host in hosts
        ]
    )


def _router_host(authority: _Authority) -> str:
    """Return the router's likely address: the first host other than this machine's own name."""
    for name in ("router", "logger"):
        certificate = authority.issued().get(name)
        hosts = [] if certificate is None else hosts_of(certificate)
        for host in hosts:
            if host not in LOCAL_HOSTS:
                return f"[{host}]" if ":" in host else host
    return "127.0.0.1"


def _revoke(authority: _Authority, subject: Subject) -> None:
    name = f"{subject.name}.pem"
    (authority.folder / _ISSUED / name).rename(authority.folder / _REVOKED / name)


def _write_access_control(folder: Path, authority: _Authority) -> None:
    subjects = list(authority.subjects().values())
    settings = _common_settings("router") | {
        "listen": {"endpoints": [f"tls/127.0.0.1:{_PORT}"]},
        "access_control": access_control(subjects),
    }
    for subject in subjects:
        if subject.role in LISTENERS:
            place = folder / subject.name  # created again if its folder has moved to its machine
            place.mkdir(mode=0o700, exist_ok=True)
            write_atomically(place / CONFIGURATION, _json5(settings))


def _client_configuration(host: str) -> str:
    endpoints = {"endpoints": [f"tls/{host}:{_PORT}"]}
    return _json5(_common_settings("client") | {"connect": endpoints})


def _common_settings(mode: str) -> dict[str, Any]:
    return {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {"shared_memory": {"enabled": False}, "link": link_settings(PLACE)},
    }


def _json5(settings: dict[str, Any]) -> str:
    return (
        f"// Made by `driveby certs`, which overwrites it. Expects its folder at {PLACE}.\n"
        f"{json.dumps(settings, indent=2)}\n"
    )


def _write_key(path: Path, key: _Key) -> None:
    """Write a private key that is never readable by others, not even for an instant."""
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(pem)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _new_folder(target: Path) -> Iterator[Path]:
    """Create a folder completely or not at all, readable by its owner alone, by renaming it."""
    new = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    new.mkdir(mode=0o700)
    try:
        yield new
        if target.exists():
            target.rename(new.with_suffix(".old"))
        new.rename(target)
    finally:
        for left in (new, new.with_suffix(".old")):
            shutil.rmtree(left, ignore_errors=True)


def _summary(folder: Path, authority: _Authority) -> list[str]:
    lines = [f"{folder}/"]
    issued = authority.issued()
    for name, subject in authority.subjects().items():
        until = issued[name].not_valid_after_utc
        place = f"{name}/" if (folder / name / KEY).exists() else f"({name})"
        lines.append(f"  {place:<20} {subject!s:<28} until {until:%Y-%m-%d}")
    own = f"  {_FOLDER}/{_AUTHORITY_KEY} makes certificates: keep it on an unconnected medium. "
    return [*lines, f"{own}Each other folder goes to its machine; restart router and logger."]
