"""A Zenoh router as a process of its own, between trucks and logger.

python router_process.py LISTEN LOGGER
"""

import json
import signal
import sys

import zenoh

from tests.parent import die_with_parent


def main(listen: str, logger: str) -> None:
    config = zenoh.Config()
    for name, value in {
        "mode": "router",
        "listen/endpoints": [listen],
        "connect/endpoints": [logger],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config):
        print("ready", flush=True)
        signal.sigwait({signal.SIGTERM, signal.SIGINT})


if __name__ == "__main__":
    die_with_parent()
    main(*sys.argv[1:])
