"""Subscriber that keeps the result of each crossing in SQLite, until Ctrl-C.

python results_to_sqlite.py tcp/127.0.0.1:7447 results.sqlite
python results_to_sqlite.py tls/logger.example.org:7447 results.sqlite certs/viewer
"""

import contextlib
import json
import sqlite3
import sys
from pathlib import Path

import zenoh

from schemas.proto import driveby_pb2 as pb

TABLES = """
CREATE TABLE IF NOT EXISTS crossing (
    realm TEXT, crossing_id TEXT, bridge TEXT, vehicle TEXT, entry_time TEXT,
    verdict TEXT, reasons TEXT, created_ns INTEGER, PRIMARY KEY (realm, crossing_id));
CREATE TABLE IF NOT EXISTS element (
    realm TEXT, crossing_id TEXT, element INTEGER, ei_nm2 REAL, ei_low_nm2 REAL, ei_high_nm2 REAL,
    PRIMARY KEY (realm, crossing_id, element));
"""
INSERT = """
INSERT INTO crossing VALUES (?, ?, ?, ?, datetime(? / 1000000000, 'unixepoch'), ?, ?, ?)
ON CONFLICT DO UPDATE SET verdict = excluded.verdict, reasons = excluded.reasons,
    created_ns = excluded.created_ns WHERE excluded.created_ns >= created_ns
"""


def store(database: sqlite3.Connection, found: pb.Estimate) -> None:
    """Insert a result, or replace an older one of the same crossing, in one transaction."""
    key = (found.realm, found.crossing_id)
    verdict = pb.Verdict.Name(found.verdict)
    reasons = " ".join(found.reasons)
    row = (*key, found.bridge, found.vehicle, found.entry_time_ns, verdict, reasons)
    with database:
        if database.execute(INSERT, (*row, found.created_ns)).rowcount == 0:
            return  # a newer result is there
        database.execute("DELETE FROM element WHERE (realm, crossing_id) = (?, ?)", key)
        for name, value in found.parameters.items():
            if name.startswith("EI_"):
                element = (*key, int(name[3:]), value.mean, value.q025, value.q975)
                database.execute("INSERT INTO element VALUES (?, ?, ?, ?, ?, ?)", element)


def config_of(endpoint: str, credentials: str | None) -> zenoh.Config:
    """Return the settings of a client, with a folder of `driveby certs` those of mutual TLS."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    if credentials is not None:
        folder = Path(credentials).absolute()
        tls = {
            "root_ca_certificate": str(folder / "ca.pem"),
            "connect_private_key": str(folder / "key.pem"),
            "connect_certificate": str(folder / "cert.pem"),
            "enable_mtls": True,
            "verify_name_on_connect": True,
        }
        config.insert_json5("transport/link/protocols", json.dumps(["tls"]))
        config.insert_json5("transport/link/tls", json.dumps(tls))
    return config


def main(endpoint: str, path: str, credentials: str | None = None) -> None:
    """Receive results, those from before the start too, and store each."""
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    topic = "driveby/v1/*/bridge/*/estimate"
    session = zenoh.open(config_of(endpoint, credentials))
    with session, contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(TABLES)
        received = zenoh.ext.declare_advanced_subscriber(session, topic, history=history)
        for sample in received:
            store(database, pb.Estimate.FromString(sample.payload.to_bytes()))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main(*sys.argv[1:])
