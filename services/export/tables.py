"""Tables as CSV and Parquet files, with units in the columns' names."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import NS_PER_S
from services.common.files import replaced_atomically, write_atomically
from services.common.parquet_files import arrow

Format = Literal["csv", "parquet"]
Column = Sequence[Any] | NDArray[Any]


class NamedTable(NamedTuple):
    """Columns of one length, by name; None, and NaN of floating-point arrays, is an empty cell.

    A column `…_ns` of whole numbers is a time since 1970 UTC: in CSV seconds, exactly, named `…_s`;
    in Parquet a timestamp named without the unit.
    """

    name: str
    columns: Mapping[str, Column]


def write_table(folder: Path, table: NamedTable, form: Format) -> Path:
    """Write a table into a folder and return its file; an existing one is replaced."""
    path = folder / f"{table.name}.{form}"
    if form == "parquet":
        with replaced_atomically(path) as temporary:
            _write_parquet(temporary, table)
    else:
        write_atomically(path, _csv_text(table))
    return path


def _csv_text(table: NamedTable) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(f"{name[:-3]}_s" if name.endswith("_ns") else name for name in table.columns)
    cells = [_cells(name, column) for name, column in table.columns.items()]
    writer.writerows(zip(*cells, strict=True))
    return text.getvalue()


def _cells(name: str, column: Column) -> list[Any]:
    values = column.tolist() if isinstance(column, np.ndarray) else list(column)
    if name.endswith("_ns"):
        return [f"{ns // NS_PER_S}.{ns % NS_PER_S:09d}" for ns in values]
    if isinstance(column, np.ndarray) and column.dtype.kind == "f":
        return ["" if value != value else value for value in values]
    return ["" if value is None else value for value in values]


def _write_parquet(path: Path, table: NamedTable) -> None:
    import pyarrow.parquet as pq

    pa = arrow()
    columns = {}
    for name, column in table.columns.items():
        if name.endswith("_ns"):
            kind = pa.timestamp("ns", tz="UTC")
            columns[name[:-3]] = pa.array(np.asarray(column, np.int64)).cast(kind)
        elif isinstance(column, np.ndarray):
            columns[name] = pa.array(column, from_pandas=True)
        else:
            columns[name] = pa.array(list(column))
    pq.write_table(pa.table(columns), path, compression="zstd")
