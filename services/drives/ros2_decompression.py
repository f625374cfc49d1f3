"""Limits for the decompression by rosbags, which has none.

A recording may be of unknown origin, and a megabyte of zstd can hold a terabyte of zeros.
"""

import io
import shutil
import tempfile
from typing import BinaryIO, Final

import zstandard

from services.drives.ros2_messages import MAX_PAYLOAD_BYTES

MAX_CHUNK_BYTES: Final = 256 << 20
"""Maximum size of a decompressed chunk; rosbag2 writes 768 kB, others some megabytes."""


def limit_decompression() -> None:
    """Limit the decompression by rosbags from now on.

    It has no setting for that, so its own decompressors are replaced, those of the two modules that
    read. `test_what_unpacks_to_too_much_is_refused` fails where a version keeps them elsewhere.
    """
    from rosbags.rosbag2 import reader, storage_mcap

    storage_mcap.DECOMPRESSORS.update(zstd=_chunk_of_zstd, lz4=_chunk_of_lz4)
    vars(reader)["zstd"] = _Zstd


class _Zstd:
    """Replacement of the module zstd within rosbags."""

    @staticmethod
    def decompress(packed: bytes) -> bytes:
        """Return a message; of one that is too long just enough to detect that."""
        return _of_zstd(packed, MAX_PAYLOAD_BYTES + 1)

    @staticmethod
    def open(file: BinaryIO, _mode: str) -> "_DecompressedFile":
        """Open a file of a recording that is decompressed into the folder for temporary files."""
        return _DecompressedFile(file)


class _DecompressedFile(io.RawIOBase):
    """Decompressed content of a file; ValueError where it would fill half of the free space."""

    def __init__(self, file: BinaryIO) -> None:
        self._unpacked = _reader(file)
        self._left = shutil.disk_usage(tempfile.gettempdir()).free // 2

    def read(self, size: int = -1) -> bytes:
        found = self._unpacked.read(size)
        self._left -= len(found)
        if self._left < 0:
            folder = tempfile.gettempdir()
            raise ValueError(f"unpacked it is more than half of what is free in {folder}")
        return found


def _chunk_of_zstd(packed: bytes, size: int) -> bytes:
    return _of_zstd(packed, _checked(size) + 1)


def _chunk_of_lz4(packed: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    unpacked: bytes = LZ4FrameDecompressor().decompress(packed, max_length=_checked(size) + 1)
    return unpacked


def _checked(size: int) -> int:
    """Return a chunk's declared size, unless it is too large; rosbags compares the actual one."""
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, at most {MAX_CHUNK_BYTES} are expected")
    return size


def _of_zstd(packed: bytes, most: int) -> bytes:
    return _reader(io.BytesIO(packed)).read(most)


def _reader(file: BinaryIO) -> zstandard.ZstdDecompressionReader:
    return zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
