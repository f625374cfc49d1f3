#!/usr/bin/env python3
"""Stands in for `zenohd` where none can be compiled: a session of Zenoh's Python library.

It takes the options that compose.yaml and the tests use, and loads no plugins.
"""

import argparse
import importlib.metadata
import signal

import zenoh


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--version",
        action="version",
        version=f"stand-in {importlib.metadata.version('eclipse-zenoh')}",
    )
    parser.add_argument("--config", required=True)
    for option in ("--listen", "--connect", "--cfg"):
        parser.add_argument(option, action="append", default=[])
    parser.add_argument("--no-multicast-scouting", action="store_true")
    asked = parser.parse_args()
    config = zenoh.Config.from_file(asked.config)
    settings = [("adminspace/enabled", ":", "true"), *(one.partition(":") for one in asked.cfg)]
    for name, endpoints in (("listen", asked.listen), ("connect", asked.connect)):
        listed = ",".join(f'"{endpoint}"' for endpoint in endpoints)
        settings.append((f"{name}/endpoints", ":", f"[{listed}]"))
    for name, _, value in settings:
        config.insert_json5(name, value)
    zenoh.init_log_from_env_or("info")
    with zenoh.open(config):
        signal.sigwait({signal.SIGTERM, signal.SIGINT})


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
    main()
