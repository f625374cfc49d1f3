"""Results of years as immutable Parquet files, one for each batch of crossings of a bridge.

They lie in `crossings/realm=R/bridge=B/HASH.parquet` below the history's folder, are called by what
is in them and never change: writers write files, nobody writes a database. Each row has what a
table tells of a crossing and what fusing needs of it. A crossing that is added again with the same
content is not written again; of two results of one crossing the newer one counts. Where a bridge
has many small files they are packed into one: it is written first, then those are removed that it
was made of. Who is killed between the two leaves rows twice, which are read once.
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
from schemas.results import Crossing, ElementState, Header, Results
from schemas.topics import check_identifier, check_realm
from services.common.errors import InputError
from services.common.files import make_folder, write_atomically
from services.common.parquet_files import FILES, decoded, encoded

if TYPE_CHECKING:
    # Kernels are slow to import, and who reads a table needs none.
    import pyarrow as pa

    from pre_core.monitoring.observation import Observation
    from services.identification.bridge_state import Usable

_log = logging.getLogger(__name__)
EDITION: Final = "1"
KEY: Final = "driveby.history"
CROSSINGS: Final = "crossings"
_SIZES = struct.Struct("<HH")
_MOST_FILES = 12
"""Of one bridge; more are packed when a crossing is added."""
_ELEMENT: Final = ("mean", "std", "q025", "q975")
_PLAIN: Final = (
    *("crossing_id", "vehicle", "direction", "entry_s", "exit_s", "speed_m_per_s", "method"),
    *("verdict", "reasons", "chi2_per_dof", "temperature_deg_c", "created_s", "site_hash"),
    *("search_hash", "version", "content"),
)
_OF_ELEMENTS: Final = tuple(f"ei_{name}_nm2" for name in _ELEMENT)
_LATEST_S: Final = 2e11
"""Times of crossings are between 1970 and the year 8300: these have a date."""


class Kept(NamedTuple):
    """A crossing of the history."""

    crossing_id: str
    vehicle: str
    direction: str
    entry_s: float
    """Since 1970 UTC, as `exit_s`."""
    exit_s: float
    speed_m_per_s: float
    method: str
    verdict: str
    reasons: tuple[str, ...]
    chi2_per_dof: float | None
    temperature_deg_c: float | None
    created_s: float
    """When the result was made."""
    site_hash: str
    search_hash: str
    """Of method, settings, seed and site file."""
    version: str
    """Of the program that made the result."""
    content: str
    """Hash of the result."""
    elements: tuple[tuple[float, ...], ...]
    """Of each element mean, std, q025, q975 of EI in N·m²; empty of a rejected crossing."""
    likelihood: bytes | None
    """What fusing needs, JSON compressed by zstd; None where the columns were not asked for."""
    observation: bytes | None
    """What watching needs (`packed_observation`)."""


class Read(NamedTuple):
    """What is known of one bridge."""

    crossings: tuple[Kept, ...]
    """In order of their entries, each once."""
    problems: tuple[str, ...]
    """Files that cannot be read, or not whole, a line each."""


class Added(NamedTuple):
    """What came of adding results."""

    crossings: int
    known: int
    """That were there already."""
    bridges: tuple[str, ...]


def add_results(
    folder: Path, results: Results, temperatures: "Mapping[str, float] | None" = None
) -> Added:
    """Add all crossings of results that are not there yet; temperatures in °C by crossing id.

    InputError if nothing can be written there, or a name of realm or bridge is none.
    """
    by_bridge: defaultdict[tuple[str, str], list[Crossing]] = defaultdict(list)
    for crossing in results.crossings:
        try:
            check_realm(crossing.realm)
            check_identifier(crossing.bridge)
            _check_time(crossing.entry_time)
            _check_time(crossing.exit_time)
        except ValueError as error:
            raise InputError(f"{crossing.crossing_id}: {error}") from None
        by_bridge[(crossing.realm, crossing.bridge)].append(crossing)
    header = Header(
        results.version, results.created, results.site_hash, results.settings, results.seed
    )
    added, bridges = 0, []
    for (realm, bridge), some in sorted(by_bridge.items()):
        where = partition(folder, realm, bridge)
        there = _contents(where)
        new = [kept_of(one, header, (temperatures or {}).get(one.crossing_id)) for one in some]
        new = [one for one in new if one.content not in there]
        if new:
            write_batch(where, new)
            added += len(new)
            bridges.append(bridge)
    return Added(added, len(results.crossings) - added, tuple(bridges))


def partition(folder: Path, realm: str, bridge: str) -> Path:
    """Where the crossings of a bridge lie."""
    return folder / CROSSINGS / f"realm={realm}" / f"bridge={bridge}"


def bridges_of(folder: Path) -> dict[tuple[str, str], Path]:
    """All bridges of a history by realm and name; InputError if there is no such folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; driveby history add RESULTS makes a history")
    found = {}
    for path in sorted((folder / CROSSINGS).glob("realm=*/bridge=*")):
        realm = path.parent.name.removeprefix("realm=")
        found[(realm, path.name.removeprefix("bridge="))] = path
    return found


def realm_of(folder: Path, bridge: str, realm: str | None) -> str:
    """The realm meant; InputError if the history has no such bridge, or in several realms."""
    realms = [r for r, b in bridges_of(folder) if b == bridge and realm in (None, r)]
    if len(realms) == 1:
        return realms[0]
    if realms:
        raise InputError(f"{folder}: {bridge} is in {', '.join(realms)}; choose with --realm")
    known = sorted({b for _, b in bridges_of(folder)})
    some = ", ".join(known[:8]) + (" …" if len(known) > 8 else "")
    inside = f" in realm {realm}" if realm else ""
    raise InputError(f"{folder}: has no bridge {bridge}{inside}; there are {some or 'none'}")


def read_partition(where: Path, columns: Iterable[str] = ()) -> Read:
    """The crossings of one bridge, each by its newest result; `columns` beyond those of a table."""
    rows: list[Kept] = []
    problems: list[str] = []
    for path in sorted(where.glob(FILES)):
        some, wrong = _rows(path, [*_PLAIN, *_OF_ELEMENTS, *columns])
        rows += some
        problems += wrong
    newest: dict[str, Kept] = {}
    for row in rows:
        before = newest.get(row.crossing_id)
        if before is None or _rank(before) < _rank(row):
            newest[row.crossing_id] = row
    ordered = sorted(newest.values(), key=lambda one: (one.entry_s, one.crossing_id))
    return Read(tuple(ordered), tuple(problems))


def _rank(row: Kept) -> tuple[float, bool, str]:
    """The newer result counts; of the same one that was added twice, where a temperature is."""
    return row.created_s, row.temperature_deg_c is not None, row.content


def _contents(where: Path) -> set[str]:
    """Of all results of a bridge that can be read, also older ones."""
    return {row.content for path in sorted(where.glob(FILES)) for row in _rows(path)[0]}


def _rows(path: Path, columns: list[str] | None = None) -> tuple[list[Kept], list[str]]:
    """The crossings of a file; and a line if it, or some of its rows, cannot be read."""
    try:
        table = decoded(path, KEY, EDITION, columns)
    except ValueError as error:
        return [], [f"{path}: left out: {error}"]
    rows: list[Kept] = []
    wrong: list[str] = []
    for number, told in enumerate(table.to_pylist(), start=1):
        try:
            rows.append(_checked(_from_row(told)))
        except (ValueError, TypeError) as error:
            wrong.append(f"row {number}: {error}")
    if not wrong:
        return rows, []
    return rows, [f"{path}: {len(wrong)} of {table.num_rows} rows left out, first {wrong[0]}"]


def wrong_of_file(path: Path) -> str | None:
    """Why a file holds no crossing that can be read, in a line; None if it holds some."""
    rows, problems = _rows(path, [*_PLAIN, *_OF_ELEMENTS])
    return None if rows or not problems else problems[0]


def write_batch(where: Path, rows: Iterable[Kept]) -> Path:
    """Write crossings of one bridge as one file, whole or not at all; pack if there are many."""
    path = _write(where, rows)
    files = sorted(where.glob(FILES))
    if len(files) > _MOST_FILES:
        _pack(where, files)
    return path


def _write(where: Path, rows: Iterable[Kept]) -> Path:
    """Write a file called by its rows. One of that name that does not hold them is damaged, and
    stays: then the file gets a number."""
    ordered = sorted(rows, key=lambda one: (one.entry_s, one.crossing_id, one.content))
    contents = [one.content for one in ordered]
    digest = hashlib.sha256("".join(contents).encode()).hexdigest()[:20]
    for number in itertools.count(1):
        path = where / f"{digest}{f'-{number}' if number > 1 else ''}.parquet"
        if not path.exists():
            make_folder(where)
            write_atomically(path, encoded(_table(ordered), KEY, EDITION))
            break
        if [one.content for one in _rows(path)[0]] == contents:
            break
    return path


def _pack(where: Path, files: list[Path]) -> None:
    """Put what is in several files into one; one that cannot be read, or not whole, stays."""
    rows: dict[str, Kept] = {}
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


def kept_of(crossing: Crossing, header: Header, temperature_deg_c: float | None) -> Kept:
    """A crossing as the history keeps it."""
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
    return Kept(
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


def usable_of(kept: Kept) -> "Usable | None":
    """What the state of a bridge needs of a crossing; None if it gave no parameters.

    ValueError if what is stored of it does not hold.
    """
    if not kept.elements:
        return None
    from services.identification.bridge_state import Usable
    from services.identification.fusing import Source

    elements = {
        f"EI_{n}": ElementState(**dict(zip(_ELEMENT, of, strict=True)))
        for n, of in enumerate(kept.elements, start=1)
    }
    source = None
    if kept.likelihood is not None:
        try:
            text = zstandard.decompress(kept.likelihood)
        except zstandard.ZstdError as error:
            raise ValueError(f"its likelihood cannot be read: {error}") from None
        direction = 1 if kept.direction == "start_to_end" else -1
        likelihood = FusionLikelihood.model_validate_json(text)
        source = Source(kept.crossing_id, kept.vehicle, direction, likelihood)
    verdict: Any = kept.verdict
    return Usable(kept.entry_s, kept.exit_s, kept.crossing_id, verdict, elements, source)


def packed_observation(of: "Observation") -> bytes:
    """An observation as bytes: sizes and names, then its numbers, the loadings in 32 bits."""
    n = of.value.size
    head = [_SIZES.pack(n, len(of.shared))]
    for one in of.shared:
        name = one.name.encode()
        head += [_SIZES.pack(one.loading.shape[1], len(name)), name]
    numbers = np.concatenate([of.value, of.own[np.triu_indices(n)]]).astype("<f8")
    loadings = [np.ascontiguousarray(one.loading, "<f4").tobytes() for one in of.shared]
    return b"".join([*head, numbers.tobytes(), *loadings])


def unpacked_observation(content: bytes) -> "Observation":
    """The observation of `packed_observation`; ValueError if the bytes are none."""
    from pre_core.monitoring.observation import Observation, Shared

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
        raise ValueError(f"{len(content)} bytes do not hold what they say they do")
    value = np.frombuffer(content, "<f8", n, at)
    own = np.zeros((n, n))
    own[np.triu_indices(n)] = np.frombuffer(content, "<f8", upper, at + 8 * n)
    own += np.triu(own, 1).T
    at += 8 * (n + upper)
    shared = []
    for name, width in zip(names, widths, strict=True):
        loading = np.frombuffer(content, "<f4", n * width, at).reshape(n, width)
        shared.append(Shared(name, loading.astype(np.float64)))
        at += 4 * n * width
    if not all(np.all(np.isfinite(x)) for x in (value, own, *(one.loading for one in shared))):
        raise ValueError("it has numbers that are not finite")
    return Observation(value, own, tuple(shared))


def _table(rows: list[Kept]) -> "pa.Table":
    import pyarrow as pa

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


def _from_row(told: dict[str, Any]) -> Kept:
    of_elements = [told.get(name) or () for name in _OF_ELEMENTS]
    plain: dict[str, Any] = {name: told.get(name) for name in _PLAIN}
    reasons = told.get("reasons") or []
    if not isinstance(reasons, list):
        raise TypeError(f"reasons are {reasons!r}, a list is expected")
    plain["reasons"] = tuple(reasons)
    return Kept(
        **plain,
        elements=tuple(zip(*of_elements, strict=True)),
        likelihood=told.get("likelihood"),
        observation=told.get("observation"),
    )


def _checked(kept: Kept) -> Kept:
    """A row of which all that others rely on is there; ValueError or TypeError if it is not."""
    for name in ("crossing_id", "vehicle", "method", "site_hash", "search_hash", "version"):
        _check_text(name, getattr(kept, name))
    _check_text("content", kept.content)
    if kept.direction not in ("start_to_end", "end_to_start"):
        raise ValueError(f"direction is {kept.direction!r}")
    if kept.verdict not in ("good", "suspect", "rejected"):
        raise ValueError(f"verdict is {kept.verdict!r}")
    _check_time(kept.entry_s)
    _check_time(kept.exit_s)
    for name in ("speed_m_per_s", "created_s"):
        _check_number(name, getattr(kept, name))
    for name in ("chi2_per_dof", "temperature_deg_c"):
        if getattr(kept, name) is not None:
            _check_number(name, getattr(kept, name))
    for element in kept.elements:
        for value in element:
            _check_number("EI", value)
    for name in ("likelihood", "observation"):
        if not isinstance(getattr(kept, name), bytes | None):
            raise TypeError(f"{name} is no bytes")
    return kept


def _check_text(name: str, value: object) -> None:
    if not isinstance(value, str) or not value:
        raise TypeError(f"{name} is {value!r}, a text is expected")


def _check_number(name: str, value: object) -> None:
    if not isinstance(value, float | int) or not math.isfinite(value):
        raise TypeError(f"{name} is {value!r}, a number is expected")


def _check_time(value: object) -> None:
    if not isinstance(value, float | int) or not 0.0 <= value <= _LATEST_S:
        raise ValueError(f"{value!r} is no time of a crossing, seconds since 1970 are expected")
