"""The logger under load: python -m tests.benchmarks.logger_load [--trucks 100] [--seconds 300]

Every truck has a connection of its own and publishes 20 batches a second of 4 × 50 random samples
and 10 fixes, each as `gnss` and as `location`: 40 messages a second. All trucks are one process,
the logger is another, on the same machine over loopback. No truck has a spool: what is missed
must come from what publishers keep.

The time from publication to fsync is that from the put of a message to the return of the fsync
behind it, both by the same clock. Processor time is that of the logger's process with all of its
threads, Zenoh's too. What is lost is counted in the files, when all is over.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from schemas.proto import driveby_pb2 as pb
from schemas.signals import (
    CHANNELS,
    AccelBatch,
    AccelChannel,
    GnssFix,
    Identity,
    decode_identity,
    encode_accel,
)
from services.bus.session import open_session
from services.logger.open_files import RotationLimits
from services.logger.settings import LoggerSettings
from services.recordings.recording import read_identities, read_info
from services.truck.gateway import Gateway
from tests.parent import die_with_parent, parent_environment

BATCHES_PER_S = 20
MESSAGES_PER_S = 40
DEFAULT_MINUTES = RotationLimits().age_s / 60.0
_DRAIN_S = 5.0
_LONGEST_MS = 600_000
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_STREAMS = ("accel", "gnss", "location")
_LATE = "late_us"


class Usage(NamedTuple):
    """Of a process, with all of its threads."""

    at_s: float
    processor_s: float
    resident_bytes: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--trucks", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--folder", type=Path, help="on the disk to try (default: a new one)")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--rotate-minutes", type=float, default=DEFAULT_MINUTES)
    parser.add_argument("--freeze", type=float, default=0.0, help="the logger for so many seconds")
    parser.add_argument("--plain", action="store_true", help="try a recorder of 30 lines instead")
    parser.add_argument("--role", choices=("logger", "plain", "fleet"), help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role is not None:
        die_with_parent()
    if options.role == "logger":
        sys.exit(log(options.endpoint, options.folder, options.rotate_minutes))
    if options.role == "plain":
        sys.exit(log_plainly(options.endpoint, options.folder))
    if options.role == "fleet":
        drive(options.endpoint, options.trucks, options.seconds)
        return
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        figures = measure(
            Path(folder),
            options.trucks,
            options.seconds,
            options.rotate_minutes,
            recorder="plain" if options.plain else "logger",
            freeze_s=options.freeze,
        )
    for name, value in figures.items():
        print(f"{name:40} {value}", flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=1))


def measure(
    folder: Path,
    trucks: int,
    seconds: float,
    rotate_minutes: float = DEFAULT_MINUTES,
    warm_up_s: float = 10.0,
    recorder: str = "logger",
    freeze_s: float = 0.0,
) -> dict[str, float | str]:
    """Let the trucks drive for so long, and return what was measured.

    After two fifths of it the logger is frozen for `freeze_s`: what it leaves of a burst is seen in
    its memory.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with (folder / "logger.log").open("w") as log_file:
        common = ["--endpoint", endpoint, "--folder", str(folder)]
        logger = start(recorder, *common, "--rotate-minutes", str(rotate_minutes), err=log_file)
    assert logger.stdout is not None
    assert logger.stdout.readline() == "ready\n", (folder / "logger.log").read_text()
    fleet = start(
        "fleet", *common, "--trucks", str(trucks), "--seconds", str(seconds + warm_up_s), err=None
    )
    assert fleet.stdout is not None
    assert fleet.stdout.readline() == "driving\n"
    time.sleep(warm_up_s)
    logger.send_signal(signal.SIGUSR2)  # only from here on
    usages = [usage(logger.pid)]
    fleet_before = usage(fleet.pid)
    loads = []
    while fleet.poll() is None and usages[-1].at_s - usages[0].at_s < seconds:
        time.sleep(1.0)
        if freeze_s and usages[-1].at_s - usages[0].at_s > 0.4 * seconds:
            logger.send_signal(signal.SIGSTOP)
            time.sleep(freeze_s)
            logger.send_signal(signal.SIGCONT)
            freeze_s = 0.0
        usages.append(usage(logger.pid))
        loads.append(os.getloadavg()[0])
    fleet_after = usage(fleet.pid)
    sent = json.loads(fleet.stdout.readline())
    late_s = sent.pop(_LATE) * 1e-6
    time.sleep(_DRAIN_S)
    began = time.monotonic()
    logger.send_signal(signal.SIGTERM)
    outcome, _ = logger.communicate(timeout=120)
    stop_s = time.monotonic() - began
    fleet.kill()
    fleet.wait()
    fleet.stdout.close()
    if logger.returncode not in (0, 1):
        raise SystemExit((folder / "logger.log").read_text()[-2000:])
    latency = json.loads(outcome.splitlines()[-1])
    duration_s = usages[-1].at_s - usages[0].at_s
    processor_s = usages[-1].processor_s - usages[0].processor_s
    found, twice = recorded(folder)
    messages = MESSAGES_PER_S * trucks * duration_s
    memory = [u.resident_bytes / 1e6 for u in usages]
    return {
        "trucks": trucks,
        "seconds": round(duration_s, 1),
        "messages sent": sum(sent.values()),
        "not in the files": sum(max(0, n - found.get(name, 0)) for name, n in sent.items()),
        "twice in the files": twice,
        "dropped by the logger": dropped(folder),
        "logger, per cent of a core": round(100 * processor_s / duration_s, 1),
        "logger, us of processor per message": round(1e6 * processor_s / messages, 1),
        "trucks, per cent of a core": round(
            100
            * (fleet_after.processor_s - fleet_before.processor_s)
            / (fleet_after.at_s - fleet_before.at_s),
            1,
        ),
        "publication to fsync, p50 s": latency["p50"],
        "publication to fsync, p99 s": latency["p99"],
        "publication to fsync, max s": latency["max"],
        "trucks behind their timetable, most, s": round(late_s, 3),
        "logger's memory, first minute, MB": round(float(np.median(memory[:60])), 1),
        "logger's memory, last minute, MB": round(float(np.median(memory[-60:])), 1),
        "logger's memory, most, MB": round(max(memory), 1),
        "load average, mean": round(float(np.mean(loads)), 2),
        "SIGTERM to exit, s": round(stop_s, 2),
    }


def start(role: str, *arguments: str, err: object) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "tests.benchmarks.logger_load", "--role", role, *arguments],
        stdout=subprocess.PIPE,
        stderr=err,
        text=True,
        env=os.environ | parent_environment(),
    )


def usage(pid: int) -> Usage:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = int(fields[11]) + int(fields[12])
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return Usage(time.monotonic(), ticks / _TICKS_PER_S, pages * _PAGE)


def recorded(folder: Path) -> tuple[dict[str, int], int]:
    """Return how many different messages of each vehicle are in the files, and how many twice."""
    found: dict[str, int] = {}
    twice = 0
    for path in sorted(folder.glob("live/*/truck-*.mcap")):
        info = read_info(path)
        own = 0
        for (where, _), numbers in read_identities(path).items():
            if where.owner == "vehicle" and where.stream != "info":
                found[where.identifier] = found.get(where.identifier, 0) + numbers.size
                own += numbers.size
        written = sum(n for key, n in info.messages.items() if key.rsplit("/")[-1] in _STREAMS)
        twice += written - own
    return found, twice


def dropped(folder: Path) -> int:
    ends = [read_info(path).end or {} for path in folder.glob("live/*/*.mcap")]
    return max((int(end.get("dropped", 0)) for end in ends), default=-1)


# --- the logger's process


def log(endpoint: str, folder: Path, rotate_minutes: float) -> int:
    """Run the logger, and note when what was published was on the disk."""
    from services.logger import run as logger
    from services.logger import writer

    # How many messages took how many ms. A list of all would be most of what an hour adds.
    delays = np.zeros(_LONGEST_MS, np.int64)
    is_settled: list[bool] = []
    signal.signal(signal.SIGUSR2, lambda *_: is_settled.append(True))

    class Timed(writer.DurableStreams):
        def add(self, messages):  # type: ignore[no-untyped-def]
            synced = list(messages)
            now_ns = time.time_ns()
            super().add(synced)
            if is_settled:
                times = (m.log_time_ns for m in synced if m.key.owner == "vehicle")
                took_ms = (now_ns - np.fromiter(times, np.int64)) // 1_000_000
                np.add.at(delays, np.clip(took_ms, 0, _LONGEST_MS - 1), 1)

    writer.DurableStreams = Timed
    code = logger.run(
        LoggerSettings(
            listen=endpoint,
            folder=folder,
            file=None,
            realms=("*",),
            site=None,
            rotate_minutes=rotate_minutes,
        ),
        ready=lambda: print("ready", flush=True),
    )
    shares = {"p50": 0.5, "p99": 0.99, "max": 1.0}
    reached = np.cumsum(delays)
    print(
        json.dumps(
            {
                name: int(np.searchsorted(reached, share * reached[-1])) / 1000
                for name, share in shares.items()
            }
        )
    )
    return code


def log_plainly(endpoint: str, folder: Path) -> int:
    """Record as the documentation of the libraries shows it: a yardstick of what the rest costs.

    One file, what comes is written as it comes, and synced twice a second. Nothing is checked,
    nothing is requested again, and duplicates stay.
    """
    import zenoh
    from mcap.writer import Writer

    delays: list[int] = []
    waiting: list[int] = []
    is_settled: list[bool] = []
    signal.signal(signal.SIGUSR2, lambda *_: is_settled.append(True))
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    channels: dict[str, int] = {}
    lock = threading.Lock()
    day = folder / "live" / "day"
    day.mkdir(parents=True)
    with (day / "truck-all.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()

        def write(sample: zenoh.Sample) -> None:
            now_ns = time.time_ns()
            sent = sample.timestamp
            sent_ns = round(sent.get_time().timestamp() * 1e9) if sent is not None else now_ns
            attachment = sample.attachment
            boot_id, sequence = decode_identity(attachment and attachment.to_bytes())
            name = str(sample.key_expr)
            with lock:
                if name not in channels:
                    boot = {"boot_id": str(boot_id)}
                    channels[name] = writer.register_channel(name, "protobuf", 0, boot)
                writer.add_message(
                    channels[name], sent_ns, sample.payload.to_bytes(), now_ns, sequence
                )
                waiting.append(sent_ns // 1_000_000)

        with open_session(listen=endpoint) as session:
            session.declare_subscriber("driveby/v1/**", write)
            print("ready", flush=True)
            while not stop.wait(0.5):
                with lock:
                    writer.flush()
                    file.flush()
                    synced, waiting = waiting, []
                os.fsync(file.fileno())
                now_ms = round(time.time() * 1e3)
                if is_settled:
                    delays += [now_ms - at for at in synced]
        writer.finish()
    p50, p99, most = np.percentile(delays, [50, 99, 100]) / 1e3
    print(json.dumps({"p50": round(p50, 3), "p99": round(p99, 3), "max": round(most, 3)}))
    return 0


# --- the trucks' process


def drive(endpoint: str, trucks: int, seconds: float) -> None:
    """Publish at the rated load, each truck at moments of its own; say how much was sent."""
    rng = np.random.default_rng(1)
    batches = [made_up(rng) for _ in range(50)]
    sessions = [open_session(connect=endpoint, timeout_s=60) for _ in range(trucks)]
    gateways = [Gateway(session, "live", f"truck-{n}") for n, session in enumerate(sessions)]
    for n, gateway in enumerate(gateways):
        own = f'[vehicle]\nid = "truck-{n}"\n'
        gateway.info(own, device_time_ns=time.monotonic_ns(), wall_time_ns=time.time_ns())
        for stream in _STREAMS:
            gateway.publisher.declare("vehicle", gateway.vehicle, stream)
    time.sleep(2.0)
    print("driving", flush=True)
    late_s = 0.0
    began = time.monotonic()
    for tick in range(round(seconds * BATCHES_PER_S)):
        for n, gateway in enumerate(gateways):
            due = began + (tick + n / trucks) / BATCHES_PER_S
            wait_s = due - time.monotonic()
            late_s = max(late_s, -wait_s)
            if wait_s > 0:
                time.sleep(wait_s)
            publish(gateway, tick, batches[(tick + n) % len(batches)])
    sent = round(seconds * BATCHES_PER_S) * MESSAGES_PER_S // BATCHES_PER_S
    outcome = {f"truck-{n}": sent for n in range(trucks)} | {_LATE: round(late_s * 1e6)}
    print(json.dumps(outcome), flush=True)
    time.sleep(600)  # the connections stay, and with them what publishers keep


def made_up(rng: np.random.Generator) -> pb.AccelBatch:
    channels = {name: AccelChannel(1000.0, rng.standard_normal(50)) for name in CHANNELS}
    batch = AccelBatch(1, 0, 0, time.time_ns(), channels)
    return pb.AccelBatch.FromString(encode_accel(batch))


def publish(gateway: Gateway, tick: int, batch: pb.AccelBatch) -> None:
    device_ns, wall_ns = time.monotonic_ns(), time.time_ns()
    batch.boot_id, batch.sequence = gateway.boot_id, tick
    batch.device_time_ns, batch.wall_time_ns = device_ns, wall_ns
    gateway.put("accel", batch.SerializeToString(), Identity(gateway.boot_id, tick))
    if tick % 2 == 0:
        gateway.gnss(GnssFix(0, 0, device_ns, wall_ns, 50.0, 8.0, 100.0, 10.0, 90.0))


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
