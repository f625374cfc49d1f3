"""Tables as bytes of Parquet that say of which edition they are."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    import pyarrow as pa

FILES: Final = "[!.]*.parquet"
"""The files of a folder, for Python and DuckDB; none that is being written, or was when its writer
died."""


def encoded(table: "pa.Table", key: str, edition: str, *, compression: str = "zstd") -> bytes:
    """The bytes of a file with a table in it, small as they are."""
    import pyarrow.parquet as pq

    out = io.BytesIO()
    # A file of few rows would be mostly statistics and dictionaries of one value.
    lean = {"use_dictionary": False, "write_statistics": False, "store_schema": False}
    with pq.ParquetWriter(out, table.schema, compression=compression, **lean) as writer:
        writer.add_key_value_metadata({key: edition})
        writer.write_table(table)
    return out.getvalue()


class Most(NamedTuple):
    """What a file may hold; one that says it holds more is not read."""

    rows: int
    bytes: int
    """When it is no longer compressed."""


def decoded(
    source: "bytes | Path",
    key: str,
    edition: str,
    columns: list[str] | None = None,
    most: Most | None = None,
) -> "pa.Table":
    """The table of a file; ValueError if it is none, of another edition, or larger than `most`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(io.BytesIO(source) if isinstance(source, bytes) else source)
        told = file.metadata.metadata or {}
        theirs = told.get(key.encode(), b"").decode(errors="replace")
        if theirs != edition:
            raise ValueError(
                f"is of edition {theirs[:20] or 'none'} of {key}, this program knows {edition}"
            )
        if most is not None:
            _check_size(file.metadata, most)
        found: Any = file.read(columns=columns, use_threads=False)  # small files, and many
        missing = set(columns or ()) - set(found.column_names)
        if missing:
            raise ValueError(f"lacks the column {min(missing)}")
        return found
    except (pa.ArrowException, OSError) as error:
        why = " ".join(str(error).split()).split(". ")[0][:100]
        raise ValueError(f"is no file of {key} ({why})") from None


def _check_size(metadata: Any, most: Most) -> None:
    size = sum(metadata.row_group(n).total_byte_size for n in range(metadata.num_row_groups))
    if metadata.num_rows > most.rows or size > most.bytes:
        raise ValueError(
            f"holds {metadata.num_rows} rows of {size / 1e6:.0f} MB, at most {most.rows} of "
            f"{most.bytes / 1e6:.0f} MB are expected"
        )
