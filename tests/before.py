"""Files and messages as the program of a version wrote them, and what is essential in them.

    python -m tests.before tests/data/before/0.1.0

writes the corpus of today's program into a new folder. One that is there is never written again:
tests/contract/test_before.py reads it with the readers of its day and compares with what
`essentials` gave when it was written (essentials.json). A new version adds a folder of its own.

The drive is the paper's scenario 6 at 100 Hz; the history holds its crossing and eleven weeks of a
bridge that loses a fifth of element 4 in the ninth (tests/fleet.py).
"""

import contextlib
import gzip
import io
import itertools
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import Message as AnyMessage

from schemas.proto import driveby_pb2 as pb
from schemas.results import Results, load_results
from schemas.signals import decode_accel, decode_gnss, decode_info
from schemas.site_file import load_site, site_hash
from schemas.validation_records import load_validation, validation_json, validation_path
from services.cli import main as cli
from services.history.history_store import add_results
from services.recordings.recording import read_info, read_messages, read_site
from services.recordings.writer import write_recording
from tests.builders.certificates import certificate, tried
from tests.fleet import losses_of
from tests.same.parts import PROJECT, Run, worker

_DRIVE = (
    "--scenario",
    "6",
    "--rate",
    "100",
    "--noise",
    "25",
    "--gps-noise",
    "--seed",
    "7",
    "--speed",
    "20",
)
_MESSAGES = 40
"""Of the drive that are kept in a recording."""
_BEGIN_S = 1_735_689_600.0
_NOT_ESSENTIAL = frozenset(
    {
        *("version", "created", "created_ns", "seconds"),  # of the program and the moment
        *("text", "finding", "reason_texts"),  # sentences, whose words may become better
    }
)
"""Fields that a reader of a later day may give otherwise."""
Essentials = dict[str, Any]


def make(folder: Path) -> None:
    """Write the corpus into a folder that is not there yet."""
    if folder.exists():
        sys.exit(f"{folder}: exists, and what was written before stays as it is")
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as temporary:
        _make_files(Path(temporary), folder)
    _pack(folder / "messages.json", _messages())
    _make_certificate(folder)
    with tempfile.TemporaryDirectory() as temporary:
        copied = unpacked(folder, Path(temporary))
        _pack(folder / "essentials.json", essentials(copied))


def _pack(path: Path, value: Essentials) -> None:
    content = gzip.compress(json.dumps(value).encode(), mtime=0)
    path.with_name(f"{path.name}.gz").write_bytes(content)


def unpacked(folder: Path, to: Path) -> Path:
    """Copy the corpus, so that no reader can change it, and unpack what is compressed."""
    copied = to / "before"
    shutil.copytree(folder, copied)
    for path in copied.glob("*.gz"):
        path.with_suffix("").write_bytes(gzip.decompress(path.read_bytes()))
        path.unlink()
    return copied


def essentials(folder: Path) -> Essentials:
    """Read the whole corpus; return the numbers and names that must stay what they are."""
    return of_files(folder) | {"asked": _asked(folder)}


def of_files(folder: Path) -> Essentials:
    """Read the files of the corpus, without asking the commands about them."""
    certificate = load_validation(next(folder.glob("certificates/*.json")))
    return {
        "sites": {path.name: site_hash(load_site(path)) for path in folder.glob("*.toml")},
        "recording": _of_recording(folder / "drive.mcap"),
        "worker": _of_results_recording(folder / "results.mcap"),
        "results": {path.name: _of_results(load_results(path)) for path in _results(folder)},
        "kept": _rows(folder / "into", "crossing_id", "verdict"),
        "history": _rows(folder / "history/crossings", "crossing_id", "vehicle", "ei_mean_nm2"),
        "catalogue": _rows(folder / "drives", "path"),
        "certificate": certificate.model_dump(mode="json"),
    }


def _results(folder: Path) -> Iterator[Path]:
    yield from sorted(folder.glob("*-result*.json"))


def fields_of(name: str, payload: bytes) -> dict[str, Any]:
    """Decode a message of the wire by today's definition."""
    kind: type[AnyMessage] = getattr(pb, name)
    return MessageToDict(kind.FromString(payload), preserving_proto_field_name=True)


def _driveby(folder: Path, *words: str) -> str:
    """Run a command in this process and in the folder; return what it prints."""
    printed = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
        code = cli.main(words)
    assert code == 0, words
    return printed.getvalue()


def _make_files(scratch: Path, folder: Path) -> None:
    inputs, run = scratch / "inputs", Run(PROJECT, scratch / "worker", scratch / "kernels")
    inputs.mkdir()
    run.folder.mkdir()
    drive = inputs / "drive.mcap"
    _driveby(inputs, "simulate", *_DRIVE, "-o", "drive.mcap")
    start = list(itertools.islice(read_messages(drive), _MESSAGES))
    write_recording(folder / "drive.mcap", start, site_toml=read_site(drive), reason="simulation")
    worker("pre", "drive", 1)(run)
    shutil.copy(run.folder / "results.mcap", folder)
    shutil.copy(run.folder / "site.toml", folder / "paper.toml")
    shutil.copy(PROJECT / "docs/site.example.toml", folder / "example.toml")
    exact = str(PROJECT / "tests/data/noise_free.mcap")
    for name, path, method in (
        ("pre", str(drive), "pre"),
        ("exact", exact, "least-squares"),
        ("rejected", str(drive), "least-squares"),
    ):
        written = scratch / f"{name}-result.json"
        _driveby(scratch, "identify", path, "--method", method, "--json", str(written))
        packed = gzip.compress(written.read_bytes(), mtime=0)
        (folder / f"{written.name}.gz").write_bytes(packed)
    _driveby(folder, "identify", str(drive), "--into", "into")
    _driveby(folder, "history", "add", "into", "--history", "history")
    found = losses_of({"bridge-2": 8}, _BEGIN_S, 11)
    found = found.model_copy(update={"crossings": found.crossings[::2]})
    add_results(folder / "history", found, {one.crossing_id: 10.0 for one in found.crossings})
    _driveby(folder, "alarm", "check", "--history", "history")
    acknowledged = ("alarm", "ack", "bridge-2", "--by", "owner", "--note", "props were put in")
    _driveby(folder, *acknowledged, "--history", "history")
    (scratch / "drives").mkdir()
    shutil.copy(folder / "drive.mcap", scratch / "drives")
    _driveby(scratch, "catalog", "drives")
    (scratch / "drives/drive.mcap").unlink()
    shutil.copytree(scratch / "drives", folder / "drives")


def _make_certificate(folder: Path) -> None:
    """Write a certificate that vouches for nothing but its own form."""
    damaged = tried(
        1,
        ei_ratio=(1.0, 0.5),
        weak_element=2,
        ei_ratio_q025=(0.8, 0.4),
        ei_ratio_q50=(1.0, 0.5),
        ei_ratio_q975=(1.2, 0.6),
        evaluations=100,
    )
    figures = {
        "crossings": 1,
        "good": 1,
        "intervals": 2,
        "covered": 2,
        "rms_z": 0.5,
        "weak": 1,
        "weak_found": 1,
        "evaluations": 100,
    }
    site = load_site(folder / "paper.toml")
    made = certificate(site, version="0.1.0", crossings=(damaged,), figures=figures)
    path = validation_path(folder / "certificates", made.hash)
    path.parent.mkdir()
    path.write_text(validation_json(made))


def _messages() -> dict[str, Any]:
    """Fill every field of every message of the wire; return payload and fields by its name."""
    found = {}
    for name in sorted(pb.DESCRIPTOR.message_types_by_name):
        message = _filled(getattr(pb, name)())
        payload = message.SerializeToString(deterministic=True)
        found[name] = {"payload": payload.hex(), "fields": fields_of(name, payload)}
    return found


def _filled(message: AnyMessage) -> AnyMessage:
    for field in message.DESCRIPTOR.fields:
        is_map = field.message_type is not None and field.message_type.GetOptions().map_entry
        into = getattr(message, field.name)
        if is_map and field.message_type is not None:
            value = field.message_type.fields_by_name["value"]
            if value.message_type is None:
                into[field.name] = _value(value)
            else:
                _filled(into[field.name])
        elif field.message_type is not None:
            _filled(into.add() if field.is_repeated else into)
        elif field.is_repeated:
            into.append(_value(field))
        else:
            setattr(message, field.name, _value(field))
    return message


def _value(field: Any) -> Any:
    if field.enum_type is not None:
        return field.enum_type.values[-1].number
    match field.cpp_type:
        case FieldDescriptor.CPPTYPE_STRING:
            is_text = field.type == FieldDescriptor.TYPE_STRING
            return field.name if is_text else field.name.encode()
        case FieldDescriptor.CPPTYPE_BOOL:
            return True
        case FieldDescriptor.CPPTYPE_DOUBLE | FieldDescriptor.CPPTYPE_FLOAT:
            return field.number + 0.5
    return field.number


def _of_recording(path: Path) -> Essentials:
    messages = list(read_messages(path))
    batches = [decode_accel(m.payload) for m in messages if m.key.stream == "accel"]
    fixes = [decode_gnss(m.payload) for m in messages if m.key.stream == "gnss"]
    infos = [decode_info(m.payload) for m in messages if m.key.stream == "info"]
    info = read_info(path)
    return {
        "messages": len(messages),
        "times_ns": [info.first_time_ns, info.last_time_ns],
        "site": read_site(path),
        "sums_m_per_s2": {
            name: sum(float(abs(b.channels[name].samples).sum()) for b in batches)
            for name in sorted(batches[0].channels)
        },
        "rates_hz": {name: one.rate_hz for name, one in sorted(batches[0].channels.items())},
        "first_fix": list(fixes[0]),
        "last_fix": list(fixes[-1]),
        "vehicle": infos[0].vehicle_id,
    }


def _of_results_recording(path: Path) -> list[Essentials]:
    kinds = {"crossing": "Crossing", "estimate": "Estimate", "state": "BridgeState"}
    found = []
    for message in read_messages(path):
        name = kinds.get(message.key.stream)
        fields = {} if name is None else fields_of(name, message.payload)
        found.append({"key": "/".join(message.key), "fields": _short(fields)})
    return found


def _short(value: Any) -> Any:
    """Leave out what is long: of lists only their lengths and ends."""
    if isinstance(value, dict):
        return {k: _short(v) for k, v in sorted(value.items()) if k not in _NOT_ESSENTIAL}
    if isinstance(value, list):
        ends = value if len(value) < 8 else [value[0], value[-1]]
        return [len(value), *(_short(one) for one in ends)]
    if isinstance(value, str) and len(value) > 100:
        return [len(value), value[:50]]
    return value


def _of_results(found: Results) -> Essentials:
    read: Essentials = _short(found.model_dump(mode="json", exclude_none=True))
    return read


def _rows(folder: Path, *columns: str) -> list[list[Any]]:
    """Return columns of all Parquet files below a folder, sorted by their rows."""
    rows: list[list[Any]] = []
    for path in sorted(folder.rglob("*.parquet")):
        read = pq.ParquetFile(path).read(columns=list(columns)).to_pylist()
        rows += [[row[name] for name in columns] for row in read]
    return sorted(rows, key=str)


def _asked(folder: Path) -> Essentials:
    """Ask today's commands about the files; a bridge's past is fused again from its rows."""
    history = ("--history", "history")
    _driveby(folder, "history", "bridge-2", *history, "--json", "past.json", "--csv", "past.csv")
    _driveby(folder, "history", "add", "into", "--history", "other")
    _driveby(folder, "report", "pre-result.json", "--site", "paper.toml", "-o", "report.html")
    past = json.loads((folder / "past.json").read_text())
    rows = (folder / "past.csv").read_text().splitlines()
    return {
        "past": _short(past | {"watch": past["watch"]["record"]}),
        "table": [rows[0], rows[1], rows[-1]],
        "kept": _rows(folder / "other/crossings", "crossing_id", "ei_mean_nm2", "ei_std_nm2"),
        "crossings": json.loads(_driveby(folder, "info", "drive.mcap", "--json")),
    }


if __name__ == "__main__":
    make(Path(sys.argv[1]))
