"""Store of results over years: immutable Parquet files, one per batch of a bridge's crossings.

They are `crossings/realm=R/bridge=B/HASH.parquet` below the history's folder, are named by their
content and never change: writers add files, there is no database. Each row has a crossing's columns
of a table and its input of a fusion. A crossing added again with the same content is not written
again; of two results of one crossing the newer one counts. Many small files of a bridge are packed
into one: it is written first, then its sources are removed. A crash between the two steps leaves
duplicate rows, which are read once.
"""

import hashlib
import itertools
import logging
import math
import struct
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import zstandard

from schemas.fusion import FusionLikelihood
from schemas.results import CrossingResult, ElementState, ResultHeader, Results
from schemas.topics import check_identifier, check_realm
from services.common.errors import InputError
from services.common.files import check_readable_below, make_folder, write_atomically
from services.common.naming import first_of
from services.common.parquet_files import FILES, arrow, decoded, encoded
from services.history.add_summary import AddSummary, CrossingKey

if TYPE_CHECKING:
    # Kernels are slow to import, and reading a table needs none.
    import pyarrow as pa

    from pre_core.monitoring.observation import Observation
    from services.identification.usable import FusableCrossing

_log = logging.getLogger(__name__)
FORMAT_VERSION: Final = "1"
KEY: Final = "driveby.history"
CROSSINGS: Final = "crossings"
_SIZES = struct.Struct("<HH")
_MAX_FILES = 12
"""Maximum number of files of one bridge; more are packed when a crossing is added."""
_ELEMENT: Final = ("mean", "std", "q025", "q975")
_PLAIN: Final = (
    *("crossing_id", "vehicle", "direction", "entry_s", "exit_s", "speed_m_per_s", "method"),
    *("verdict", "reasons", "chi2_per_dof", "temperature_deg_c", "created_s", "site_hash"),
    *("search_hash", "version", "content"),
)
_OF_ELEMENTS: Final = tuple(f"ei_{name}_nm2" for name in _ELEMENT)
_LATEST_S: Final = 2e11
"""Latest valid time of a crossing, in the year 8300: such times have a date."""


class HistoryRow(NamedTuple):
    """A crossing of the history."""

    crossing_id: str
    vehicle: str
    direction: str
    entry_s: float
    """Entry in s since 1970 UTC, as for `exit_s`."""
    exit_s: float
    speed_m_per_s: float
    method: str
    verdict: str
    reasons: tuple[str, ...]
    chi2_per_dof: float | None
    temperature_deg_c: float | None
    created_s: float
    """Time of the result."""
    site_hash: str
    search_hash: str
    """Hash of method, settings, seed and site file."""
    version: str
    """Version of the program that computed the result."""
    content: str
    """Hash of the result."""
    elements: tuple[tuple[float, ...], ...]
    """EI of each element: mean, std, q025, q975 in N·m²; empty for a rejected crossing."""
    likelihood: bytes | None
    """Input of a fusion, JSON compressed by zstd; None where the columns were not requested."""
    observation: bytes | None
    """Input of the monitoring (`packed_observation`)."""


class BridgeRows(NamedTuple):
    """Stored crossings of one bridge."""

    crossings: tuple[HistoryRow, ...]
    """Crossings in order of their entries, each once."""
    problems: tuple[str, ...]
    """Files that are unreadable, or in part, one line each."""


def add_results(
    folder: Path, results: Results, temperatures: "Mapping[str, float] | None" = None
) -> AddSummary:
    """Add the crossings that are not stored yet; temperatures in °C by crossing id.

    Raise InputError if the folder is not writable, or a name of realm or bridge is invalid.
    """
    by_bridge: defaultdict[tuple[str, str], list[CrossingResult]] = defaultdict(list)
    for crossing in results.crossings:
        try:
            check_realm(crossing.realm)
            check_identifier(crossing.bridge)
            _check_time(crossing.entry_time)
            _check_time(crossing.exit_time)
        except ValueError as error:
            raise InputError(f"{crossing.crossing_id}: {error}") from None
        by_bridge[(crossing.realm, crossing.bridge)].append(crossing)
    header = ResultHeader(
        results.version, results.created, results.site_hash, results.settings, results.seed
    )
    added, replaced = set[CrossingKey](), set[CrossingKey]()
    for (realm, bridge), some in sorted(by_bridge.items()):
        where = partition(folder, realm, bridge)
        there, newest = _stored(where)
        new = [history_row(one, header, (temperatures or {}).get(one.crossing_id)) for one in some]
        new = [one for one in new if one.content not in there]
        if new:
            write_batch(where, new)
        for one in new:
            before = newest.get(one.crossing_id)
            if before is None or before < _rank(one):
                (added if before is None else replaced).add((realm, bridge, one.crossing_id))
                newest[one.crossing_id] = _rank(one)
    known = {(one.realm, one.bridge, one.crossing_id) for one in results.crossings}
    replaced -= added
    return AddSummary(frozenset(added), frozenset(replaced), frozenset(known - added - replaced))


def partition(folder: Path, realm: str, bridge: str) -> Path:
    """Return the folder of a bridge's crossings."""
    return folder / CROSSINGS / f"realm={realm}" / f"bridge={bridge}"


def bridges_of(folder: Path) -> dict[tuple[str, str], Path]:
    """Return all bridges of a history by realm and name; InputError without such a folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; driveby history add RESULTS creates a history")
    check_readable_below(folder)
    found = {}
    for path in sorted((folder / CROSSINGS).glob("realm=*/bridge=*")):
        realm = path.parent.name.removeprefix("realm=")
        found[(realm, path.name.removeprefix("bridge="))] = path
    return found


def realm_of(folder: Path, bridge: str, realm: str | None) -> str:
    """Return the realm of a bridge; InputError if it has no such bridge, or in several realms."""
    everywhere = [r for r, b in bridges_of(folder) if b == bridge]
    realms = [r for r in everywhere if realm in (None, r)]
    if len(realms) == 1:
        return realms[0]
    if realms:
        raise InputError(f"{folder}: {bridge} is in {', '.join(realms)}; choose with --realm")
    if everywhere:
        raise InputError(f"{folder}: {bridge} is in {', '.join(everywhere)}, not in {realm}")
    known = sorted({b for _, b in bridges_of(folder)})
    some = first_of(known, 8) or "none"
    raise InputError(f"{folder}: has no bridge {bridge}; there are {some}")


def read_partition(where: Path, columns: Iterable[str] = ()) -> BridgeRows:
    """Return the crossings of one bridge by their newest results; `columns` are extra ones."""
    rows: list[HistoryRow] = []
    problems: list[str] = []
    for path in sorted(where.glob(FILES)):
        some, wrong = _rows(path, [*_PLAIN, *_OF_ELEMENTS, *columns])
        rows += some
        problems += wrong
    newest: dict[str, HistoryRow] = {}
    for row in rows:
        before = newest.get(row.crossing_id)
        if before is None or _rank(before) < _rank(row):
            newest[row.crossing_id] = row
    ordered = sorted(newest.values(), key=lambda one: (one.entry_s, one.crossing_id))
    return BridgeRows(tuple(ordered), tuple(problems))


def _rank(row: HistoryRow) -> tuple[float, bool, str]:
    """Return a key by which the newer result counts, of equal ones the one with a temperature."""
    return row.created_s, row.temperature_deg_c is not None, row.content


def _stored(where: Path) -> tuple[set[str], dict[str, tuple[float, bool, str]]]:
    """Return the hashes of all readable results, and the rank of each crossing's newest one."""
    contents, newest = set[str](), dict[str, tuple[float, bool, str]]()
    for path in sorted(where.glob(FILES)):
        for row in _rows(path)[0]:
            contents.add(row.content)
            newest[row.crossing_id] = max(_rank(row), newest.get(row.crossing_id, _rank(row)))
    return contents, newest


def _rows(path: Path, columns: list[str] | None = None) -> tuple[list[HistoryRow], list[str]]:
    """Return the crossings of a file, and a line if it, or some of its rows, is unreadable."""
    try:
        table = decoded(path, KEY, FORMAT_VERSION, columns)
    except ValueError as error:
        return [], [f"{path}: left out: {error}"]
    rows: list[HistoryRow] = []
    wrong: list[str] = []
    for number, values in enumerate(table.to_pylist(), start=1):
        try:
            rows.append(_checked(_from_row(values)))
        except (ValueError, TypeError) as error:
            wrong.append(f"row {number}: {error}")
    if not wrong:
        return rows, []
    return rows, [f"{path}: {len(wrong)} of {table.num_rows} rows left out, first {wrong[0]}"]


def file_error(path: Path) -> str | None:
    """Return in a line why a file has no readable crossing; None if it has some."""
    rows, problems = _rows(path, [*_PLAIN, *_OF_ELEMENTS])
    return None if rows or not problems else problems[0]


def write_batch(where: Path, rows: Iterable[HistoryRow]) -> Path:
    """Write crossings of one bridge as one file, completely or not at all; pack if it has many."""
    path = _write(where, rows)
    files = sorted(where.glob(FILES))
    if len(files) > _MAX_FILES:
        _pack(where, files)
    return path


def _write(where: Path, rows: Iterable[HistoryRow]) -> Path:
    """Write a file named by its rows.

    A file of that name with other content is damaged and stays; the new one gets a number.
    """
    ordered = sorted(rows, key=lambda one: (one.entry_s, one.crossing_id, one.content))
    contents = [one.content for one in ordered]
    digest = hashlib.sha256("".join(contents).encode()).hexdigest()[:20]
    for number in itertools.count(1):
        path = where / f"{digest}{f'-{number}' if number > 1 else ''}.parquet"
        if not path.exists():
            make_folder(where)
            write_atomically(path, encoded(_table(ordered), KEY, FORMAT_VERSION))
            break
        if [one.content for one in _rows(path)[0]] == contents:
            break
    return path


def _pack(where: Path, files: list[Path]) -> None:
    """Merge several files into one; a file that is unreadable, or in part, stays."""
    rows: dict[str, HistoryRow] = {}
    read: list[Path] = []
    for path in files:
        some, problems = _rows(path)
        for problem in problems:
            _log.warning("%s", problem)
        if problems:
            continue
        rows |= {one.content: one for one in some}
        read.append(path)
    if len(read) > 1:
        packed = _write(where, rows.values())
        for path in read:
            if path != packed:
                path.unlink(missing_ok=True)


def history_row(
    crossing: CrossingResult, header: ResultHeader, temperature_deg_c: float | None
) -> HistoryRow:
    """Return the row of a crossing in the history."""
    from services.identification.known import search_hash
    from services.identification.observed import observation_of

    parameters = crossing.parameters or {}
    names = sorted(
        (name for name in parameters if name.startswith("EI_")), key=lambda n: int(n[3:])
    )
    likelihood = crossing.fusion_likelihood
    found = observation_of(crossing)
    search = search_hash(header)
    content = hashlib.sha256(
        f"{search} {temperature_deg_c} {crossing.model_dump_json()}".encode()
    ).hexdigest()[:32]
    return HistoryRow(
        crossing.crossing_id,
        crossing.vehicle,
        crossing.direction,
        crossing.entry_time,
        crossing.exit_time,
        crossing.speed_m_per_s,
        crossing.method,
        crossing.verdict,
        tuple(crossing.reasons),
        crossing.chi2_per_dof,
        temperature_deg_c,
        header.created,
        header.site_hash,
        search,
        header.version,
        content,
        tuple(tuple(getattr(parameters[n], field) for field in _ELEMENT) for n in names),
        None if likelihood is None else zstandard.compress(likelihood.model_dump_json().encode()),
        None if found is None else packed_observation(found),
    )


def fusable_of(row: HistoryRow) -> "FusableCrossing | None":
    """Return the input of a fusion of a crossing; None if it gave no parameters.

    Raise ValueError if the stored values are invalid.
    """
    if not row.elements:
        return None
    from services.identification.usable import FusableCrossing, Source

    elements = {
        f"EI_{n}": ElementState(**dict(zip(_ELEMENT, of, strict=True)))
        for n, of in enumerate(row.elements, start=1)
    }
    source = None
    if row.likelihood is not None:
        try:
            text = zstandard.decompress(row.likelihood)
        except zstandard.ZstdError as error:
            raise ValueError(f"its likelihood cannot be read: {error}") from None
        direction = 1 if row.direction == "start_to_end" else -1
        likelihood = FusionLikelihood.model_validate_json(text)
        source = Source(row.crossing_id, row.vehicle, direction, likelihood)
    verdict: Any = row.verdict
    return FusableCrossing(row.entry_s, row.exit_s, row.crossing_id, verdict, elements, source)


def packed_observation(observation: "Observation") -> bytes:
    """Return an observation as bytes: sizes and names, then numbers, the loadings in 32 bits."""
    n = observation.value.size
    head = [_SIZES.pack(n, len(observation.shared))]
    for one in observation.shared:
        name = one.name.encode()
        head += [_SIZES.pack(one.loading.shape[1], len(name)), name]
    numbers = np.concatenate([observation.value, observation.own[np.triu_indices(n)]]).astype("<f8")
    loadings = [np.ascontiguousarray(one.loading, "<f4").tobytes() for one in observation.shared]
    return b"".join([*head, numbers.tobytes(), *loadings])


def unpacked_observation(content: bytes) -> "Observation":
    """Return the observation of `packed_observation`; ValueError if the bytes are invalid."""
    from pre_core.monitoring.observation import Observation, SharedError

    try:
        n, count = _SIZES.unpack_from(content)
        at, names, widths = _SIZES.size, [], []
        for _ in range(count):
            width, length = _SIZES.unpack_from(content, at)
            at += _SIZES.size
            names.append(content[at : at + length].decode())
            widths.append(width)
            at += length
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from None
    upper = n * (n + 1) // 2
    if len(content) != at + 8 * (n + upper) + 4 * n * sum(widths):
        raise ValueError(f"{len(content)} bytes do not have the length that their head declares")
    value = np.frombuffer(content, "<f8", n, at)
    own = np.zeros((n, n))
    own[np.triu_indices(n)] = np.frombuffer(content, "<f8", upper, at + 8 * n)
    own += np.triu(own, 1).T
    at += 8 * (n + upper)
    shared = []
    for name, width in zip(names, widths, strict=True):
        loading = np.frombuffer(content, "<f4", n * width, at).reshape(n, width)
        shared.append(SharedError(name, loading.astype(np.float64)))
        at += 4 * n * width
    if not all(np.all(np.isfinite(x)) for x in (value, own, *(one.loading for one in shared))):
        raise ValueError("it has numbers that are not finite")
    return Observation(value, own, tuple(shared))


def _table(rows: list[HistoryRow]) -> "pa.Table":
    pa = arrow()

    columns: dict[str, Any] = {name: [getattr(row, name) for row in rows] for name in _PLAIN}
    columns["reasons"] = pa.array([list(row.reasons) for row in rows], pa.list_(pa.string()))
    for name in ("chi2_per_dof", "temperature_deg_c"):
        columns[name] = pa.array(columns[name], pa.float64())
    for k, name in enumerate(_OF_ELEMENTS):
        values = [[element[k] for element in row.elements] for row in rows]
        columns[name] = pa.array(values, pa.list_(pa.float64()))
    columns["likelihood"] = pa.array([row.likelihood for row in rows], pa.binary())
    columns["observation"] = pa.array([row.observation for row in rows], pa.binary())
    return pa.table(columns)


def _from_row(values: dict[str, Any]) -> HistoryRow:
    of_elements = [values.get(name) or () for name in _OF_ELEMENTS]
    plain: dict[str, Any] = {name: values.get(name) for name in _PLAIN}
    reasons = values.get("reasons") or []
    if not isinstance(reasons, list):
        raise TypeError(f"reasons are {reasons!r}, a list is expected")
    plain["reasons"] = tuple(reasons)
    return HistoryRow(
        **plain,
        elements=tuple(zip(*of_elements, strict=True)),
        likelihood=values.get("likelihood"),
        observation=values.get("observation"),
    )


def _checked(row: HistoryRow) -> HistoryRow:
    """Return a row whose fields are valid; ValueError or TypeError if they are not."""
    for name in ("crossing_id", "vehicle", "method", "site_hash", "search_hash", "version"):
        _check_text(name, getattr(row, name))
    _check_text("content", row.content)
    if row.direction not in ("start_to_end", "end_to_start"):
        raise ValueError(f"direction is {row.direction!r}")
    if row.verdict not in ("good", "suspect", "rejected"):
        raise ValueError(f"verdict is {row.verdict!r}")
    _check_time(row.entry_s)
    _check_time(row.exit_s)
    for name in ("speed_m_per_s", "created_s"):
        _check_number(name, getattr(row, name))
    for name in ("chi2_per_dof", "temperature_deg_c"):
        if getattr(row, name) is not None:
            _check_number(name, getattr(row, name))
    for element in row.elements:
        for value in element:
            _check_number("EI", value)
    for name in ("likelihood", "observation"):
        if not isinstance(getattr(row, name), bytes | None):
            raise TypeError(f"{name} is no bytes")
    return row


def _check_text(name: str, value: object) -> None:
    if not isinstance(value, str) or not value:
        raise TypeError(f"{name} is {value!r}, a text is expected")


def _check_number(name: str, value: object) -> None:
    if not isinstance(value, float | int) or not math.isfinite(value):
        raise TypeError(f"{name} is {value!r}, a number is expected")


def _check_time(value: object) -> None:
    if not isinstance(value, float | int) or not 0.0 <= value <= _LATEST_S:
        raise ValueError(f"{value!r} is no time of a crossing, seconds since 1970 are expected")
