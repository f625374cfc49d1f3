"""What a user reads about a connection that TLS refuses: the cause, and what would be right."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from services.bus.credentials import Subject
from services.bus.session import open_session
from services.bus.tls_probe import cause_of_failure
from services.common.errors import FailureError
from services.security import certs
from services.security.certs import certs_command
from services.security.settings import CertsSettings
from tests.intruders import raw_session


@contextmanager
def router(endpoint: str, folder: Path | None) -> Iterator[None]:
    with raw_session(endpoint, folder, listen=True):
        yield


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """Credentials of another authority."""
    certs_command(CertsSettings(folder=tmp_path / "foreign", trucks=["truck-1"]))
    return tmp_path / "foreign"


@pytest.fixture
def expired(credentials: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "expired"
    shutil.copytree(credentials, copy)
    authority = certs._existing(copy)
    assert authority is not None
    for subject in (Subject("truck", "truck-1"), Subject("logger", "logger")):
        hosts = certs.LOCAL_HOSTS if subject.role == "logger" else ()
        certs._issue(copy, authority, authority.key(), subject, hosts, days=-0.001)  # type: ignore[arg-type]
    return copy


def test_good_credentials_have_no_cause(credentials: Path, tls_endpoint: str) -> None:
    with router(tls_endpoint, credentials / "logger"):
        assert cause_of_failure(tls_endpoint, credentials / "truck-1") is None


def test_no_router_has_no_cause(credentials: Path, tls_endpoint: str) -> None:
    assert cause_of_failure(tls_endpoint, credentials / "truck-1") is None


def test_router_of_another_authority_is_named(
    credentials: Path, foreign: Path, tls_endpoint: str
) -> None:
    with router(tls_endpoint, foreign / "logger"):
        cause = cause_of_failure(tls_endpoint, credentials / "truck-1")
    assert cause == f"its certificate is not issued by {credentials}/truck-1/ca.pem"


def test_expired_router_is_named(credentials: Path, expired: Path, tls_endpoint: str) -> None:
    with router(tls_endpoint, expired / "logger"):
        cause = cause_of_failure(tls_endpoint, credentials / "truck-1")
    assert cause == "its certificate has expired; renew it with `driveby certs --renew`"


def test_router_of_another_host_is_named(credentials: Path, tls_endpoint: str) -> None:
    elsewhere = tls_endpoint.replace("127.0.0.1", "127.0.0.2")
    with router(elsewhere, credentials / "logger"):
        cause = cause_of_failure(elsewhere, credentials / "truck-1")
    assert cause == (
        f"its certificate names {', '.join(certs.LOCAL_HOSTS)}, not 127.0.0.2; "
        "`driveby certs FOLDER --renew NAME --host 127.0.0.2` adds it"
    )


def test_truck_that_poses_as_the_router_is_named(credentials: Path, tls_endpoint: str) -> None:
    with router(tls_endpoint, credentials / "truck-2"):
        cause = cause_of_failure(tls_endpoint, credentials / "truck-1")
    assert cause == "its certificate is not that of a router or logger"


def test_refused_certificates_are_named(
    credentials: Path, expired: Path, foreign: Path, tls_endpoint: str
) -> None:
    shutil.copy(credentials / "truck-1" / "ca.pem", foreign / "truck-1")  # it trusts our router
    with router(tls_endpoint, credentials / "logger"):
        causes = [cause_of_failure(tls_endpoint, one / "truck-1") for one in (expired, foreign)]
    assert causes == [
        f"it refuses {expired}/truck-1/cert.pem as expired",
        f"it refuses {foreign}/truck-1/cert.pem as of another authority than its own",
    ]


def test_router_that_requires_credentials_is_named(credentials: Path, tls_endpoint: str) -> None:
    with router(tls_endpoint, credentials / "logger"):
        cause = cause_of_failure(tls_endpoint.replace("tls/", "tcp/"), None)
    assert cause == "the program there requires --tls FOLDER (and tls/ in the endpoint)"


def test_router_without_credentials_is_named(credentials: Path, tls_endpoint: str) -> None:
    with router(tls_endpoint.replace("tls/", "tcp/"), None):
        cause = cause_of_failure(tls_endpoint, credentials / "truck-1")
    assert cause == (
        "the program there does not answer the TLS handshake; was it started without --tls FOLDER?"
    )


def test_unknown_host_is_named(credentials: Path) -> None:
    where = "tls/no-such-host.invalid:7447"
    cause = "the host no-such-host.invalid is unknown"
    assert cause_of_failure(where, credentials / "truck-1") == cause


def test_session_reports_the_cause(credentials: Path, foreign: Path, tls_endpoint: str) -> None:
    with (
        router(tls_endpoint, foreign / "logger"),
        pytest.raises(FailureError, match=rf"^no router answers at {tls_endpoint} .*not issued by"),
    ):
        open_session(connect=tls_endpoint, timeout_s=0.1, tls=credentials / "truck-1")
