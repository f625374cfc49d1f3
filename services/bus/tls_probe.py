"""The likely cause of a failed connection to a router, from a TLS handshake of Python's own.

Zenoh reports a missing router, a wrong authority and a wrong host name alike. The probe connects
once, sends nothing but its handshake, and waits for the router's verdict on its certificate.
"""

import contextlib
import re
import socket
import ssl
from pathlib import Path
from typing import Final

from cryptography import x509

from services.bus.credentials import AUTHORITY, CERTIFICATE, KEY, hosts_of

_TIMEOUT_S: Final = 2.0
"""Longest wait for an answer to each step."""
_VERDICT_S: Final = 0.5
"""Longest wait for a refusal, which follows the handshake in TLS 1.3."""
_HOST, _ADDRESS = 62, 64
_VERDICTS: Final = {
    9: "its certificate is not valid yet; is this machine's clock right?",
    10: "its certificate has expired; renew it with `driveby certs --renew`",
    26: "its certificate is not that of a router or logger",
}
"""Verdicts on a router's certificate by OpenSSL's codes (X509_V_ERR_…)."""
_SILENT: Final = (
    "the program there does not answer the TLS handshake; was it started without --tls FOLDER?"
)
_FROZEN: Final = (
    "the program there accepts connections and answers none; is it stopped or overloaded?"
)
_REFUSALS: Final = {
    "UNKNOWN_CA": "of another authority than its own",
    "CERTIFICATE_EXPIRED": "expired",
    "CERTIFICATE_REQUIRED": "missing",
    "BAD_CERTIFICATE": "bad",
    "UNSUPPORTED_CERTIFICATE": "unsuitable",
    "CERTIFICATE_UNKNOWN": "unsuitable",
}
"""Alerts of TLS on the certificate of a client."""


def cause_of_failure(endpoint: str, tls: Path | None) -> str | None:
    """Return the cause of a failed connection as a clause; None if the probe does not show it.

    Only `tcp/` and `tls/` are probed. The probe waits for a few seconds at most.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = re.split(r"[?#]", address)[0].rpartition(":")
    host = host.strip("[]")
    if protocol not in ("tcp", "tls") or not port.isdecimal():
        return None
    try:
        with socket.create_connection((host, int(port)), _TIMEOUT_S) as link:
            return _without_credentials(link) if tls is None else _handshake(link, host, tls)
    except socket.gaierror:
        return f"the host {host} is unknown"
    except (OSError, OverflowError, ValueError):
        return None


def _without_credentials(link: socket.socket) -> str | None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with context.wrap_socket(link):
            return "the program there requires --tls FOLDER (and tls/ in the endpoint)"
    except TimeoutError:
        return _FROZEN
    except OSError:
        return None


def _handshake(link: socket.socket, host: str, tls: Path) -> str | None:
    address = link.getpeername()
    is_tls = False
    try:
        with _context(tls).wrap_socket(link, server_hostname=host) as secured:
            is_tls = True
            secured.settimeout(_VERDICT_S)
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return _verdict(error.verify_code, host, address, tls)
    except TimeoutError:
        return None if is_tls else _SILENT
    except ssl.SSLError as error:
        refusals = [text for name, text in _REFUSALS.items() if name in (error.reason or "")]
        return f"it refuses {tls / CERTIFICATE} as {refusals[0]}" if refusals else None
    return None


def _context(tls: Path) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=tls / AUTHORITY)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.load_cert_chain(tls / CERTIFICATE, tls / KEY)
    return context


def _verdict(code: int, host: str, address: tuple[str, int], tls: Path) -> str:
    """Return what is wrong with the router's certificate, by OpenSSL's code."""
    if code in (_HOST, _ADDRESS):
        names = ", ".join(_names(address, tls)) or "no host"
        return (
            f"its certificate names {names}, not {host}; "
            f"`driveby certs FOLDER --renew NAME --host {host}` adds it"
        )
    return _VERDICTS.get(code, f"its certificate is not issued by {tls / AUTHORITY}")


def _names(address: tuple[str, int], tls: Path) -> list[str]:
    """Return the hosts that the router's certificate names."""
    context = _context(tls)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with (
        contextlib.suppress(OSError),
        socket.create_connection(address[:2], _TIMEOUT_S) as link,
        context.wrap_socket(link) as secured,
    ):
        return hosts_of(
            x509.load_der_x509_certificate(secured.getpeercert(binary_form=True) or b"")
        )
    return []
