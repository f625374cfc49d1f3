"""The files of `driveby certs`: what they say, who may read them, what is never overwritten."""

import contextlib
import errno
import ipaddress
import json
import logging
import os
import socket
import time
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path

import pytest
import zenoh
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from cryptography.x509.verification import PolicyBuilder, Store

from schemas.topics import TOPICS
from services.bus import credentials
from services.bus.access_control import access_control
from services.bus.credentials import (
    AUTHORITY,
    CERTIFICATE,
    CONFIGURATION,
    KEY,
    Subject,
    check_credentials,
    check_speaks_for,
    hosts_of,
    read_certificate,
)
from services.bus.session import open_session
from services.common.errors import FailureError, InputError
from services.security import certs
from services.security.certs import certs_command
from services.security.settings import CertsSettings

EVERYBODY = ("logger", "replay", "router", "truck-1", "viewer", "worker")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "certs"
    certs_command(
        CertsSettings(folder=made, trucks=["truck-1"], host=["logger.example.org", "10.0.0.5"])
    )
    return made


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def names_allowed(configuration: Path) -> set[str]:
    access = json.loads(zenoh.Config.from_file(configuration).get_json("access_control"))
    assert access["enabled"]
    assert access["default_permission"] == "deny"
    return {name for subject in access["subjects"] for name in subject["cert_common_names"]}


def test_everybody_gets_what_they_need(folder: Path) -> None:
    for name in EVERYBODY:
        assert sorted(p.name for p in (folder / name).iterdir()) == sorted(
            [AUTHORITY, CERTIFICATE, CONFIGURATION, KEY]
        )
        assert check_credentials(folder / name).name == name
    assert check_credentials(folder / "truck-1") == Subject("truck", "truck-1")
    for name in ("router", "logger"):
        assert names_allowed(folder / name / CONFIGURATION) == {
            *("logger/logger", "replay/replay", "router/router"),
            *("truck/truck-1", "viewer/viewer", "worker/worker"),
        }


def test_full_disk_is_named_with_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A write that fails has no file name in its error."""

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(certs, "_write_access_control", fail)
    settings = CertsSettings(folder=tmp_path / "certs", add=["truck/truck-1"])
    with pytest.raises(FailureError, match=r"certs: cannot be written: No space left on device$"):
        certs_command(settings)


def test_private_keys_are_private(folder: Path) -> None:
    keys = [*folder.glob(f"*/{KEY}"), folder / "authority" / "ca-key.pem"]
    assert len(keys) == len(EVERYBODY) + 1
    assert {key.stat().st_mode & 0o777 for key in keys} == {0o600}
    assert {p.stat().st_mode & 0o777 for p in [folder, *folder.iterdir()]} == {0o700}
    with_keys = {path for path, content in contents(folder).items() if b"PRIVATE" in content}
    assert with_keys == set(keys)


def test_private_keys_are_never_readable_by_others_while_they_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file that is opened for writing, with the most generous umask."""
    opened: list[tuple[str, int]] = []
    real = os.open

    def spy(path: object, flags: int, *arguments: int) -> int:
        descriptor = real(path, flags, *arguments)  # type: ignore[arg-type]
        opened.append((Path(str(path)).name, os.fstat(descriptor).st_mode & 0o777))
        return descriptor

    monkeypatch.setattr(os, "open", spy)
    before = os.umask(0)
    try:
        certs_command(CertsSettings(folder=tmp_path / "certs", trucks=["truck-1"]))
    finally:
        os.umask(before)
    keys = [mode for name, mode in opened if name in (KEY, "ca-key.pem")]
    assert keys == [0o600] * (len(EVERYBODY) + 1)
    assert (tmp_path / "certs" / "truck-1").stat().st_mode & 0o777 == 0o700


def test_certificates_name_subject_and_purpose(folder: Path) -> None:
    authority = read_certificate(folder / "authority" / AUTHORITY)
    basic = authority.extensions.get_extension_for_class(x509.BasicConstraints)
    assert basic.critical
    assert basic.value == x509.BasicConstraints(ca=True, path_length=0)
    for name in EVERYBODY:
        one = read_certificate(folder / name / CERTIFICATE)
        usage = one.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        listens = name in ("router", "logger")
        assert (ExtendedKeyUsageOID.SERVER_AUTH in usage) == listens
        assert ExtendedKeyUsageOID.CLIENT_AUTH in usage
        assert not one.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        assert one.not_valid_after_utc - datetime.now(UTC) <= timedelta(days=365)


@pytest.mark.parametrize(
    ("host", "is_named"),
    [
        ("logger.example.org", True),
        ("10.0.0.5", True),
        ("localhost", True),
        ("127.0.0.1", True),
        ("evil.org", False),
        ("10.0.0.6", False),
    ],
)
def test_an_independent_verifier_believes_a_logger_at_its_hosts(
    folder: Path, host: str, is_named: bool
) -> None:
    """The verifier of `cryptography` is strict about extensions, as rustls is not."""
    try:
        subject: x509.GeneralName = x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        subject = x509.DNSName(host)
    store = Store([read_certificate(folder / "authority" / AUTHORITY)])
    verifier = PolicyBuilder().store(store).build_server_verifier(subject)  # type: ignore[arg-type]
    logger = read_certificate(folder / "logger" / CERTIFICATE)
    if is_named:
        assert len(verifier.verify(logger, [])) == 2
    else:
        with pytest.raises(x509.verification.VerificationError):
            verifier.verify(logger, [])


def test_a_truck_more_changes_nothing_but_the_lists(folder: Path) -> None:
    before = contents(folder)
    certs_command(CertsSettings(folder=folder, trucks=["truck-2"], add=["viewer/anna"]))
    after = contents(folder)
    lists = {folder / name / CONFIGURATION for name in ("router", "logger")}
    assert {path for path in before if after[path] != before[path]} == lists
    for path in lists:
        assert {"truck/truck-2", "viewer/anna", "truck/truck-1"} <= names_allowed(path)
    assert check_credentials(folder / "anna") == Subject("viewer", "anna")


def test_without_the_authoritys_key_nothing_is_made_but_somebody_can_be_revoked(
    folder: Path,
) -> None:
    (folder / "authority" / "ca-key.pem").unlink()
    before = contents(folder)
    with pytest.raises(InputError, match="the authority's private key is not here"):
        certs_command(CertsSettings(folder=folder, trucks=["truck-2"]))
    assert contents(folder) == before
    certs_command(CertsSettings(folder=folder, revoke=["truck-1"]))
    assert "truck/truck-1" not in names_allowed(folder / "logger" / CONFIGURATION)


def test_renewal_replaces_one_key_and_keeps_the_hosts(folder: Path) -> None:
    before = contents(folder)
    certs_command(
        CertsSettings(folder=folder, renew=["logger"], host=["other.example.org"], days=30)
    )
    changed = {p for p, content in contents(folder).items() if before.get(p) != content}
    assert changed == {
        folder / "logger" / KEY,
        folder / "logger" / CERTIFICATE,
        folder / "authority" / "issued" / "logger.pem",
    }
    assert hosts_of(read_certificate(folder / "logger" / CERTIFICATE)) == [
        *certs.LOCAL_HOSTS,
        *("logger.example.org", "10.0.0.5", "other.example.org"),
    ]
    assert sorted(p.name for p in folder.iterdir()) == sorted([*EVERYBODY, "authority"])


def test_changes_are_printed_with_what_remains_to_be_done(folder: Path) -> None:
    lines = certs_command(CertsSettings(folder=folder, revoke=["truck-1"], renew=["worker"]))
    assert lines[0].startswith("truck/truck-1 is revoked: copy ")
    for name in ("router", "logger"):
        assert str(folder / name / "zenoh.json5") in lines[0]
    assert lines[0].endswith(" to their machines, restart logger and router")
    own = folder / "worker"
    assert lines[1] == f"worker/worker is renewed: copy {own} to its machine, restart what uses it"
    assert not any("revoked" in line for line in certs_command(CertsSettings(folder=folder)))


def test_a_revoked_name_is_not_issued_again(folder: Path) -> None:
    certs_command(CertsSettings(folder=folder, revoke=["truck-1"]))
    with pytest.raises(InputError, match="its old key would become valid again"):
        certs_command(CertsSettings(folder=folder, trucks=["truck-1"]))
    with pytest.raises(InputError, match="has no certificate here"):
        certs_command(CertsSettings(folder=folder, renew=["truck-1"]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"trucks": ["truck-1"]}, "exists and is not overwritten"),
        ({"trucks": ["logger"]}, "exists and is not overwritten"),
        ({"trucks": ["authority"]}, "exists and is not overwritten"),
        ({"trucks": ["a", "a"]}, "exists and is not overwritten"),
        ({"trucks": ["../x"]}, "--trucks: identifier '../x' must be"),
        ({"trucks": ["a/b"]}, "--trucks: identifier"),
        ({"trucks": ["*"]}, "--trucks: identifier"),
        ({"trucks": [""]}, "--trucks: identifier"),
        ({"trucks": ["x" * 10_000]}, "--trucks: identifier"),
        ({"add": ["captain/x"]}, "ROLE one of"),
        ({"add": ["viewer"]}, "--add: identifier ''"),
        ({"host": ["a b"], "renew": ["logger"]}, "the name or the address of a machine"),
        ({"host": ["-x"], "renew": ["logger"]}, "the name or the address of a machine"),
        ({"host": ["a" * 60 + "."] * 1, "renew": ["logger"]}, "the name or the address"),
        ({"host": ["x.org"], "trucks": ["t"]}, "--host concerns routers and loggers"),
        ({"renew": ["nobody"]}, "has no certificate here, only logger"),
        ({"revoke": ["nobody"]}, "has no certificate here"),
        ({"revoke": ["truck-1"], "renew": ["truck-1"]}, "either renew or revoke"),
    ],
)
def test_wrong_input_is_named_and_nothing_is_written(
    folder: Path, arguments: dict[str, list[str]], message: str
) -> None:
    before = contents(folder)
    with pytest.raises(InputError, match=message.replace("*", r"\*")):
        certs_command(CertsSettings(folder=folder, **arguments))  # type: ignore[arg-type]
    assert contents(folder) == before


def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(InputError, match="others may write there; chmod 700"):
        certs_command(CertsSettings(folder=tmp_path))
    with pytest.raises(InputError, match="does not exist"):
        certs_command(CertsSettings(folder=tmp_path / "a" / "b"))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        certs_command(CertsSettings(folder=tmp_path / "file"))


def test_bad_credentials_are_named_before_anybody_connects(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    certs_command(CertsSettings(folder=other, trucks=["truck-1"]))
    truck = folder / "truck-1"
    key, certificate, authority = (
        (truck / name).read_bytes() for name in (KEY, CERTIFICATE, AUTHORITY)
    )

    def refused(message: str) -> None:
        with pytest.raises(InputError, match=message):
            open_session(connect="tls/127.0.0.1:1", timeout_s=0.1, tls=truck)
        (truck / KEY).write_bytes(key)
        (truck / CERTIFICATE).write_bytes(certificate)
        (truck / AUTHORITY).write_bytes(authority)
        (truck / KEY).chmod(0o600)

    (truck / KEY).chmod(0o640)
    refused("others may read this private key; chmod 600")
    (truck / KEY).write_bytes((folder / "viewer" / KEY).read_bytes())
    refused(f"{KEY}: is not the key of {CERTIFICATE}")
    (truck / KEY).write_text("nonsense")
    refused("is not a private key in PEM format")
    (truck / CERTIFICATE).write_text("nonsense")
    refused("is not a certificate in PEM format")
    (truck / CERTIFICATE).unlink()
    refused("no such file")
    (truck / AUTHORITY).write_bytes((other / "truck-1" / AUTHORITY).read_bytes())
    refused("was not issued by the authority")
    certs_command(CertsSettings(folder=folder, renew=["truck-1"], days=0))
    refused(r"expired on \d{4}-\d\d-\d\d; renew it")


def test_validity_in_time_is_checked(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    now = datetime.now(UTC)
    with pytest.raises(InputError, match="is this machine's clock right"):
        check_credentials(folder / "truck-1", now - timedelta(days=2))
    with pytest.raises(InputError, match="expired on"):
        check_credentials(folder / "truck-1", now + timedelta(days=366))
    with caplog.at_level(logging.WARNING):
        check_credentials(folder / "truck-1", now + timedelta(days=300))
        assert not caplog.records
        check_credentials(folder / "truck-1", now + timedelta(days=340))
    assert "cert.pem expires on" in caplog.text
    assert "PRIVATE" not in caplog.text


def test_service_that_keeps_trying_warns_of_expiry_once_a_day(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    soon = datetime.now(UTC) + timedelta(days=340)
    with caplog.at_level(logging.WARNING):
        for hours in (0, 0, 23, 25):
            check_credentials(folder / "truck-1", soon + timedelta(hours=hours))
    assert caplog.text.count("cert.pem expires on") == 2


def test_running_router_logs_that_its_certificate_has_expired(
    folder: Path,
    tls_endpoint: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class NextYear(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> "NextYear":
            return super().now(tz) + timedelta(days=400)

    monkeypatch.setattr(credentials, "_CHECK_PERIOD_S", 0.05)
    with caplog.at_level(logging.ERROR), open_session(listen=tls_endpoint, tls=folder / "logger"):
        assert not caplog.records
        monkeypatch.setattr(credentials, "datetime", NextYear)
        deadline_s = time.monotonic() + 20.0
        while not caplog.records and time.monotonic() < deadline_s:
            time.sleep(0.02)
    assert "logger/cert.pem expired on" in caplog.text


def test_a_service_uses_its_own_credentials(folder: Path) -> None:
    check_speaks_for(None, "truck", "anything")
    check_speaks_for(folder / "truck-1", "truck", "truck-1")
    check_speaks_for(folder / "replay", "replay")
    with pytest.raises(InputError, match="is the certificate of truck/truck-1, not of truck/t-2"):
        check_speaks_for(folder / "truck-1", "truck", "t-2")
    with pytest.raises(InputError, match="is the certificate of viewer/viewer, not of worker/"):
        check_speaks_for(folder / "viewer", "worker", "viewer")


@pytest.mark.parametrize(
    "listen",
    ["tcp/0.0.0.0:0", "tcp/[::]:0", "tcp/192.0.2.1:7447", "tcp/somewhere:7447", "ws/0.0.0.0:0"],
)
def test_listening_beyond_loopback_needs_insecure(listen: str) -> None:
    with pytest.raises(InputError, match=r"add --insecure if that is intended"):
        open_session(listen=listen)


@pytest.mark.parametrize("listen", ["tcp/127.0.0.1:0", "tcp/localhost:0", "tcp/127.1.2.3:0"])
def test_this_machine_can_always_be_listened_to(listen: str) -> None:
    open_session(listen=listen).close()


def test_insecure_is_a_choice() -> None:
    open_session(listen="tcp/0.0.0.0:0", insecure=True).close()


def test_the_protocol_fits_the_credentials(folder: Path) -> None:
    with pytest.raises(InputError, match="with --tls it must begin with tls/"):
        open_session(connect="tcp/127.0.0.1:1", timeout_s=0.1, tls=folder / "truck-1")
    with pytest.raises(InputError, match="needs --tls FOLDER"):
        open_session(connect="tls/127.0.0.1:1", timeout_s=0.1)


def test_a_router_without_access_control_does_not_start(folder: Path) -> None:
    path = folder / "logger" / CONFIGURATION
    text = path.read_text()
    for wrong, message in (
        (
            text.replace('"enabled": true,\n    "default', '"enabled": false,\n    "default'),
            "permits e",
        ),
        (text.replace('"deny"', '"allow"'), "permits everything to everybody"),
        ("{}", "permits everything to everybody"),
        ("{", "zenoh.json5: "),
    ):
        assert wrong != text
        path.write_text(wrong)
        with pytest.raises(InputError, match=message):
            open_session(listen="tls/127.0.0.1:0", tls=folder / "logger")
    path.unlink()
    with pytest.raises(InputError, match="no such file"):
        open_session(listen="tls/127.0.0.1:0", tls=folder / "logger")
    with pytest.raises(InputError, match="only a logger's may listen"):
        open_session(listen="tls/127.0.0.1:0", tls=folder / "truck-1")


def datagram_sockets() -> int:
    """How many this process has open."""
    own = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            own.add(str(descriptor.readlink()))
    lines = Path("/proc/self/net/udp").read_text().splitlines()[1:]
    return sum(f"socket:[{line.split()[9]}]" in own for line in lines)


def test_nobody_looks_for_others_by_multicast(folder: Path) -> None:
    """Scouting would need a datagram socket."""
    before = datagram_sockets()
    with (
        open_session(listen="tls/127.0.0.1:0", tls=folder / "logger"),
        open_session(listen="tcp/127.0.0.1:0"),
    ):
        assert datagram_sockets() == before
    with socket.socket(type=socket.SOCK_DGRAM) as control:
        control.bind(("127.0.0.1", 0))
        assert datagram_sockets() == before + 1
    for path in folder.glob(f"*/{CONFIGURATION}"):
        assert zenoh.Config.from_file(path).get_json("scouting/multicast/enabled") == "false"


def test_every_topic_has_exactly_the_publishers_that_it_should() -> None:
    """A topic that is added to the table must be given to somebody, and not to a stranger."""
    roles = ("truck", "logger", "worker", "viewer", "replay")
    control = access_control(Subject(role, "x") for role in roles)
    for row in TOPICS:
        where = zenoh.KeyExpr(f"driveby/v1/live/{row.owner}/x/{row.stream}")
        may = {
            rule["id"].split("/")[0]
            for rule in control["rules"]
            if rule["flows"] == ["ingress"]
            and "put" in rule["messages"]
            and any(zenoh.KeyExpr(key).includes(where) for key in rule["key_exprs"])
        }
        if row.owner == "vehicle":
            assert may == {"truck"}
        elif row.owner == "bridge":
            assert may == {"worker"}
        else:
            assert may
            assert may <= {"logger", "worker"}
            assert row.stream != "durable" or may == {"logger"}


@pytest.fixture
def of_cluster(tmp_path: Path) -> Path:
    made = tmp_path / "cluster-certs"
    certs_command(CertsSettings(folder=made, cluster=True))
    return made


def test_a_cluster_has_an_authority_and_roles_of_its_own(of_cluster: Path) -> None:
    for role, listens in (("scheduler", True), ("cluster-worker", True), ("client", False)):
        assert check_credentials(of_cluster / role) == (role, role)
        assert not (of_cluster / role / "zenoh.json5").exists()
        usages = read_certificate(of_cluster / role / CERTIFICATE).extensions
        kinds = usages.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (ExtendedKeyUsageOID.SERVER_AUTH in kinds) == listens
    certs_command(CertsSettings(folder=of_cluster, add=["cluster-worker/two"], renew=["client"]))
    assert check_credentials(of_cluster / "two") == ("cluster-worker", "two")


def test_nobody_of_the_bus_is_of_a_cluster(of_cluster: Path, folder: Path) -> None:
    """Whoever has a certificate of a cluster's authority runs programs on it."""
    with pytest.raises(InputError, match=r"truck/truck-1: .* is an authority of a cluster"):
        certs_command(CertsSettings(folder=of_cluster, trucks=["truck-1"]))
    with pytest.raises(InputError, match=r"client/anna: .* is an authority of the bus"):
        certs_command(CertsSettings(folder=folder, add=["client/anna"]))
    with pytest.raises(InputError, match=r"--cluster needs another folder"):
        certs_command(CertsSettings(folder=folder, cluster=True))
    with pytest.raises(InputError, match=r"is an authority of a cluster"):
        certs_command(CertsSettings(folder=folder.parent / "new", trucks=["truck-1"], cluster=True))
    assert not (folder.parent / "new").exists()
    with pytest.raises(InputError, match=r"knows no revoked certificates"):
        certs_command(CertsSettings(folder=of_cluster, revoke=["client"]))
