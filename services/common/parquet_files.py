"""Tables as Parquet bytes with their format version."""

import io
import sys
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    import pyarrow as pa

FILES: Final = "[!.]*.parquet"
"""Pattern of the files of a folder, for Python and DuckDB, without incomplete ones of running or
crashed writers."""


class _WithoutPandas(MetaPathFinder):
    """Finder that reports pandas as not installed."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def spare_pandas() -> None:
    """Keep pyarrow from importing pandas in order to convert a list: 0.3 s and 40 MB.

    For processes of our own: until pyarrow is asked for a frame of pandas, it takes pandas to be
    missing, which a notebook would notice.
    """
    global _is_pandas_spared
    _is_pandas_spared = True


_is_pandas_spared = False


def arrow() -> Any:
    """Return pyarrow, ready to convert lists."""
    import pyarrow as pa

    if _is_pandas_spared and "pandas" not in sys.modules:
        finder = _WithoutPandas()
        sys.meta_path.insert(0, finder)
        try:
            pa.array([])  # looks for pandas once
        finally:
            sys.meta_path.remove(finder)
    return pa


def encoded(table: "pa.Table", key: str, version: str, *, compression: str = "zstd") -> bytes:
    """Return the bytes of a Parquet file with a table, optimised for small size.

    Its metadata have the format `version` under `key`.
    """
    import pyarrow.parquet as pq

    out = io.BytesIO()
    # A file of few rows would consist mostly of statistics and dictionaries of one value.
    lean = {"use_dictionary": False, "write_statistics": False, "store_schema": False}
    with pq.ParquetWriter(out, table.schema, compression=compression, **lean) as writer:
        writer.add_key_value_metadata({key: version})
        writer.write_table(table)
    return out.getvalue()


class ReadLimits(NamedTuple):
    """Largest content of a file that is read."""

    rows: int
    bytes: int
    """Size after decompression."""


def decoded(
    source: "bytes | Path",
    key: str,
    version: str,
    columns: list[str] | None = None,
    most: ReadLimits | None = None,
) -> "pa.Table":
    """Return the table of a file; raise ValueError if invalid, of another version or too large."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(io.BytesIO(source) if isinstance(source, bytes) else source)
        metadata = file.metadata.metadata or {}
        theirs = metadata.get(key.encode(), b"").decode(errors="replace")
        if theirs != version:
            raise ValueError(
                f"is of format version {theirs[:20] or 'none'} of {key}, "
                f"this program knows {version}"
            )
        if most is not None:
            _check_size(file.metadata, most)
        found: Any = file.read(columns=columns, use_threads=False)  # many small files
        missing = set(columns or ()) - set(found.column_names)
        if missing:
            raise ValueError(f"lacks the column {min(missing)}")
        return found
    except (pa.ArrowException, OSError) as error:
        why = " ".join(str(error).split()).split(". ")[0][:100]
        raise ValueError(f"is not a file of {key} ({why})") from None


def _check_size(metadata: Any, most: ReadLimits) -> None:
    size = sum(metadata.row_group(n).total_byte_size for n in range(metadata.num_row_groups))
    if metadata.num_rows > most.rows or size > most.bytes:
        raise ValueError(
            f"holds {metadata.num_rows} rows of {size / 1e6:.0f} MB, at most {most.rows} of "
            f"{most.bytes / 1e6:.0f} MB are expected"
        )
