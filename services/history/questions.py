"""Questions to a whole history, by DuckDB over its Parquet files: it reads, and writes nothing."""

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from services.common.errors import InputError
from services.common.parquet_files import FILES
from services.history.archive import (
    CROSSINGS,
    EDITION,
    KEY,
    bridges_of,
    wrong_of_file,
)

if TYPE_CHECKING:
    import duckdb


class Answer(NamedTuple):
    """A table."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    problems: tuple[str, ...]
    """Files that were left out, a line each."""


_PARTITIONS: Final = "realm=*/bridge=*"
_OVERVIEW = """
SELECT realm, bridge, count(DISTINCT crossing_id) AS crossings,
       count(DISTINCT crossing_id) FILTER (verdict = 'good') AS good,
       count(DISTINCT vehicle) AS trucks,
       min(entry_s) AS first_s, max(entry_s) AS last_s
FROM crossings WHERE entry_s BETWEEN 0 AND 2e11 GROUP BY realm, bridge ORDER BY realm, bridge
"""
_EDITIONS: Final = """
SELECT DISTINCT min(decode(value)) FILTER (decode(key) = $2)
FROM parquet_kv_metadata($1) GROUP BY file_name
"""


def overview(folder: Path) -> Answer:
    """A row for each bridge: how many crossings of how many trucks, and from when to when."""
    found = ask(folder, _OVERVIEW)
    rows = tuple((*row[:5], *(_day(time_s) for time_s in row[5:])) for row in found.rows)
    names = ("realm", "bridge", "crossings", "good", "trucks", "first", "last")
    return found._replace(columns=names, rows=rows)


def ask(folder: Path, question: str) -> Answer:
    """The answer to a question in SQL about the table `crossings`.

    InputError if there is no history, or DuckDB does not take the question.
    """
    if not bridges_of(folder):
        raise InputError(f"{folder}: is no history; driveby history add RESULTS makes one")
    files = f"{folder / CROSSINGS}/{_PARTITIONS}/{FILES}"
    try:
        return _asked(question, files, ())
    except InputError:
        # One file that is none fails them all: only then is each looked at.
        good, problems = _files(folder)
        if not problems or not good:
            raise
        return _asked(question, good, problems)


def _asked(question: str, files: str | list[str], problems: tuple[str, ...]) -> Answer:
    import duckdb

    with duckdb.connect(":memory:") as connection:
        try:
            asked = connection.extract_statements(question)
            if [one.type for one in asked] != [duckdb.StatementType.SELECT]:
                raise InputError("--sql: one question that begins with SELECT … is expected")
            _check_editions(connection, files)
            crossings = connection.read_parquet(files, hive_partitioning=True, union_by_name=True)
            crossings.create_view("crossings")
            found = connection.sql(question)
            return Answer(tuple(found.columns), tuple(found.fetchall()), problems)
        except duckdb.Error as error:
            raise InputError(f"--sql: {' '.join(str(error).split())[:300]}") from None


def _check_editions(connection: "duckdb.DuckDBPyConnection", files: str | list[str]) -> None:
    """InputError if one of the files is of another edition: its columns may mean something else."""
    found = connection.execute(_EDITIONS, [files, KEY]).fetchall()
    if any(edition != EDITION for (edition,) in found):
        raise InputError(f"a file is of another edition than {EDITION} of {KEY}")


def _files(folder: Path) -> tuple[list[str], tuple[str, ...]]:
    good, problems = [], []
    for path in sorted((folder / CROSSINGS).glob(f"{_PARTITIONS}/{FILES}")):
        wrong = wrong_of_file(path)
        if wrong is None:
            good.append(str(path))
        else:
            problems.append(wrong)
    return good, tuple(problems)


def _day(time_s: float) -> str:
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d}"
