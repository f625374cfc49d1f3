"""SQL queries of a whole history, by DuckDB over its Parquet files, which it only reads."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from services.common.errors import InputError
from services.common.language import utc_day
from services.common.parquet_files import FILES
from services.history.history_store import (
    CROSSINGS,
    FORMAT_VERSION,
    KEY,
    bridges_of,
    file_error,
)

if TYPE_CHECKING:
    import duckdb


class QueryResult(NamedTuple):
    """Result of a query: a table."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    problems: tuple[str, ...]
    """Skipped files, one line each."""


_PARTITIONS: Final = "realm=*/bridge=*"
_OVERVIEW = """
SELECT realm, bridge, count(*) AS crossings,
       count(*) FILTER (verdict = 'good') AS good,
       count(DISTINCT vehicle) AS trucks,
       min(entry_s) AS first_s, max(entry_s) AS last_s
FROM crossings WHERE entry_s BETWEEN 0 AND 2e11 GROUP BY realm, bridge ORDER BY realm, bridge
"""
_NEWEST = """
SELECT * FROM results QUALIFY row_number() OVER (
    PARTITION BY realm, bridge, crossing_id
    ORDER BY created_s DESC NULLS LAST, temperature_deg_c IS NOT NULL DESC, content DESC NULLS LAST
) = 1
"""
"""Newest result of each crossing, by the rank that `read_partition` uses."""
_FORMAT_VERSIONS: Final = """
SELECT DISTINCT min(decode(value)) FILTER (decode(key) = $2)
FROM parquet_kv_metadata($1) GROUP BY file_name
"""


def overview(folder: Path) -> QueryResult:
    """Return a row for each bridge: number of crossings and trucks, first and last time."""
    found = query(folder, _OVERVIEW)
    rows = tuple((*row[:5], *(utc_day(time_s) for time_s in row[5:])) for row in found.rows)
    names = ("realm", "bridge", "crossings", "good", "trucks", "first", "last")
    return found._replace(columns=names, rows=rows)


def query(folder: Path, question: str) -> QueryResult:
    """Return the result of an SQL query on the tables `crossings` and `results`.

    `crossings` has the newest result of each crossing, `results` every stored one.
    Raise InputError if there is no history, or DuckDB rejects the query.
    """
    if not bridges_of(folder):
        raise InputError(f"{folder}: is not a history; driveby history add RESULTS creates one")
    files = f"{folder / CROSSINGS}/{_PARTITIONS}/{FILES}"
    try:
        return _run_query(question, files, ())
    except InputError:
        # One invalid file fails the whole query: only then is each one checked.
        good, problems = _files(folder)
        if not problems or not good:
            raise
        return _run_query(question, good, problems)


def _run_query(question: str, files: str | list[str], problems: tuple[str, ...]) -> QueryResult:
    import duckdb

    with duckdb.connect(":memory:") as connection:
        try:
            asked = connection.extract_statements(question)
            if [one.type for one in asked] != [duckdb.StatementType.SELECT]:
                raise InputError("--sql: one query that begins with SELECT … is expected")
            _check_format_versions(connection, files)
            results = connection.read_parquet(files, hive_partitioning=True, union_by_name=True)
            results.create_view("results")
            connection.sql(_NEWEST).create_view("crossings")
            found = connection.sql(question)
            return QueryResult(tuple(found.columns), tuple(found.fetchall()), problems)
        except duckdb.Error as error:
            raise InputError(f"--sql: {' '.join(str(error).split())[:300]}") from None


def _check_format_versions(connection: "duckdb.DuckDBPyConnection", files: str | list[str]) -> None:
    """Raise InputError for a file of another format version: its columns may differ in meaning."""
    found = connection.execute(_FORMAT_VERSIONS, [files, KEY]).fetchall()
    if any(version != FORMAT_VERSION for (version,) in found):
        raise InputError(f"a file is of another format version than {FORMAT_VERSION} of {KEY}")


def _files(folder: Path) -> tuple[list[str], tuple[str, ...]]:
    good, problems = [], []
    for path in sorted((folder / CROSSINGS).glob(f"{_PARTITIONS}/{FILES}")):
        wrong = file_error(path)
        if wrong is None:
            good.append(str(path))
        else:
            problems.append(wrong)
    return good, tuple(problems)
