"""Files are whole or absent."""

import errno
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from services.common.errors import FailureError, InputError
from services.common.files import (
    check_writable,
    lock_folder,
    make_folder,
    read_bytes,
    read_text,
    replaced_atomically,
    write_atomically,
)
from services.common.stores import files_below, folder_at
from services.history.history_store import bridges_of
from services.recordings.merge import recordings_in


def _half(path: Path, error: Exception) -> None:
    """Write half a file, then fail."""
    with replaced_atomically(path) as temporary:
        assert temporary.parent == path.parent
        assert temporary.suffix == path.suffix
        temporary.write_text("half")
        raise error


def test_text_and_bytes_replace_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    write_atomically(path, "Brücke")
    assert path.read_text(encoding="utf-8") == "Brücke"
    write_atomically(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert list(tmp_path.iterdir()) == [path]


def test_a_block_that_raises_leaves_everything_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "out.npz"
    path.write_text("before")
    with pytest.raises(ZeroDivisionError):
        _half(path, ZeroDivisionError())
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_a_failure_with_one_line(tmp_path: Path) -> None:
    path = tmp_path / "out.bin"
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(FailureError, match="could not be written: No space left on device"):
        _half(path, full)
    assert list(tmp_path.iterdir()) == []


def test_the_file_is_synced_before_the_rename_and_the_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.txt"
    synced: list[tuple[str, bool]] = []
    sync = os.fsync

    def fsync(descriptor: int) -> None:
        name = Path(f"/proc/self/fd/{descriptor}").readlink()
        synced.append(("folder" if name == tmp_path else "file", path.exists()))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    write_atomically(path, "text")
    assert synced == [("file", False), ("folder", True)]


def test_places_that_cannot_be_written_are_named_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"):
        check_writable(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        write_atomically(tmp_path / "none" / "out.json", "text")
    check_writable(tmp_path / "out.json")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_made_with_those_above_it_and_kept(tmp_path: Path) -> None:
    folder = tmp_path / "above" / "below"
    make_folder(folder)
    (folder / "kept").touch()
    make_folder(folder)
    assert (folder / "kept").exists()
    for place in (folder / "kept", folder / "kept" / "below"):
        with pytest.raises(InputError, match="cannot be created as a folder"):
            make_folder(place)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="no permission"):
            check_writable(tmp_path / "out.json")
        with pytest.raises(InputError, match="no permission"):
            make_folder(tmp_path)
    finally:
        tmp_path.chmod(0o700)


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none: no such file"):
        read_bytes(tmp_path / "none")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_text(tmp_path)
    path = tmp_path / "latin.csv"
    path.write_bytes(b"a\nb\n\xfc\n")
    with pytest.raises(InputError, match=r"latin\.csv: line 3: is not UTF-8"):
        read_text(path)


def test_a_folder_is_locked_by_one_at_a_time(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    lock = lock_folder(folder, "lock", "somebody is here")
    with pytest.raises(InputError, match=f"^{re.escape(str(folder))}: somebody is here$"):
        lock_folder(folder, "lock", "somebody is here")
    os.close(lock)
    os.close(lock_folder(folder, "lock", "somebody is here"))


def test_a_lock_of_another_user_is_taken_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a container that shares the volume."""
    os.close(lock_folder(tmp_path, "lock", "somebody is here"))
    access, opened = os.access, os.open

    def refuse(path: Path, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_RDWR:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, flags, mode)

    monkeypatch.setattr(os, "access", lambda path, mode: path.name != "lock" and access(path, mode))
    monkeypatch.setattr(os, "open", refuse)
    first = lock_folder(tmp_path, "lock", "somebody is here")
    with pytest.raises(InputError, match="somebody is here"):
        lock_folder(tmp_path, "lock", "somebody is here")
    os.close(first)


@pytest.mark.parametrize(
    "search",
    [
        lambda folder: recordings_in([folder]),
        lambda folder: files_below(folder_at(str(folder)), ".mcap"),
        bridges_of,
    ],
    ids=["recordings", "catalogue", "history"],
)
def test_search_names_a_folder_that_cannot_be_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, search: Callable[[Path], Iterable[object]]
) -> None:
    """A search that left it out would count its recordings and alarms as absent."""
    for name in ("a.mcap", "closed/b.mcap", "lost+found/c.mcap", ".hidden/d.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    closed = {"lost+found", ".hidden"}
    scandir = os.scandir

    def refused(where: str = ".") -> object:
        if Path(where).name in closed:
            raise PermissionError(errno.EACCES, "Permission denied", str(where))
        return scandir(where)

    monkeypatch.setattr("os.scandir", refused)
    search(tmp_path)
    closed.add("closed")
    with pytest.raises(InputError, match=r"/closed: cannot be read: Permission denied$"):
        search(tmp_path)
