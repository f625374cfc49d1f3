"""Recordings: MCAP files of the bytes on the bus, and the data to read them.

There is one MCAP channel for each key and boot; its topic is the Zenoh key, its metadata holds the
boot_id, the message's `sequence` is MCAP's own, `log_time` the wall time of the first sample,
`publish_time` that of arrival. Schemas include their imports, so that Rerun and Foxglove can decode
them. In addition to the messages a file has

- metadata `driveby`: program, version, format, and realm and vehicle where there is only one;
- metadata `driveby.start` and `driveby.end`: reason, time, and at the end counts. A file without
  `driveby.end` was cut off: it is readable up to its last whole chunk. A file that continues
  another one names it as `previous` in `driveby.start`, and begins with as many repeated latched
  messages as `repeated` states;
- metadata `driveby.identities`, every minute and before the end: by key and boot, the sequence
  numbers of all messages before it;
- metadata `driveby.recovered`, if the file was rewritten by `driveby recover`: the losses;
- attachment `site.toml`, if the writer knew the site.
"""

import contextlib
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.records import Attachment, Channel, Metadata
from mcap.writer import MCAP0_MAGIC

from schemas.messages import check_stamp
from schemas.signals import check_wall_time, encode_identity
from schemas.topics import Key, Message, key, parse_key, topic
from services.common.errors import InputError
from services.common.files import check_ordinary, is_held
from services.common.intervals import Intervals
from services.common.progress import Offset, no_progress
from services.recordings.mcap_scan import Damage, Item, RawMessage, last_metadata, scan

FORMAT = "1"
ABOUT = "driveby"
START = "driveby.start"
END = "driveby.end"
IDENTITIES = "driveby.identities"
RECOVERED = "driveby.recovered"
SITE = "site.toml"

_log = logging.getLogger(__name__)
_BOOT_DIGITS = 20
"""Largest number of digits in 64 bits."""

Warn = Callable[[str], None]
"""Callback with one line for a defect of a file that is readable all the same."""
Identities = dict[tuple[Key, int], Intervals]
"""Sequence numbers of the messages by key and boot_id."""


class RecordingInfo(NamedTuple):
    """The metadata of a recording and a summary of its content."""

    about: dict[str, str]
    start: dict[str, str]
    end: dict[str, str] | None
    """Content of `driveby.end`; None if the writer did not finish the file."""
    site_toml: str | None
    messages: dict[str, int]
    """Number of messages by key."""
    first_time_ns: int
    last_time_ns: int
    damaged_chunks: int
    """Number of unreadable places in the middle of the file, usually a chunk each."""
    truncated: bool
    """Whether the file ends in the middle of a record or without MCAP's footer."""


def _log_warning(text: str) -> None:
    _log.warning("%s", text)


def read_messages(
    path: Path, progress: Offset = no_progress, *, warn: Warn = _log_warning
) -> Iterator[Message]:
    """Yield the messages in the order of the file; `progress` receives the position in it.

    A truncated file is read up to its last whole chunk and damaged places are skipped; `warn`
    receives both (and `read_info` counts them). Raise InputError if the file is missing, is not
    MCAP, holds no message of ours, or one of a truck that is larger than its topic allows: decoding
    bytes that only claim to be a message can cost gigabytes.
    """
    found = False
    for item in _scan(path, progress=progress, warn=warn):
        if isinstance(item, Message):
            found = True
            owner, stream = item.key.owner, item.key.stream
            if owner == "vehicle" and len(item.payload) > topic(owner, stream).max_bytes:
                check_message(path, item)
            yield item
        elif isinstance(item, Damage):
            grows = item.is_cut_off and is_being_written(path)
            warn(f"{path}: {'is being written; read up to its end now' if grows else item.text}")
    if not found:
        raise InputError(f"{path}: holds no driveby message; a recording of a truck is expected")


def check_message(path: Path, message: Message) -> None:
    """Raise InputError in one line if bus or logger would refuse a message."""
    try:
        check_stamp(topic(message.key.owner, message.key.stream), message.payload)
    except ValueError as error:
        raise _wrong(path, message, error) from None
    check_envelope(path, message)


def check_envelope(path: Path, message: Message) -> None:
    """Raise InputError as `check_message` does, but leave the payload to its decoder."""
    most = topic(message.key.owner, message.key.stream).max_bytes
    try:
        if len(message.payload) > most:
            raise ValueError(f"{len(message.payload)} bytes; at most {most}")
        check_wall_time(message.log_time_ns)
        encode_identity(message.boot_id, message.sequence)
    except ValueError as error:
        raise _wrong(path, message, error) from None


def _wrong(path: Path, message: Message, error: ValueError) -> InputError:
    where = f"message {message.sequence} of {message.key.identifier}"
    return InputError(f"{path}: {where}: {error}")


def read_site(path: Path) -> str | None:
    """Return the site file in the recording, None if there is none; raise InputError as above."""
    for item in _scan(path):
        if isinstance(item, Attachment) and item.name == SITE:
            try:
                return item.data.decode()
            except UnicodeDecodeError:
                raise InputError(f"{path}: its attachment {SITE} is not UTF-8 text") from None
        if isinstance(item, Message):  # the attachment precedes all messages
            return None
    return None


def read_info(
    path: Path,
    look: Callable[[Message], object] = lambda message: None,
    progress: Offset = no_progress,
) -> RecordingInfo:
    """Read the whole file and return its summary; raise InputError if it is missing or not MCAP.

    `look` receives every message of a logged topic, `progress` the position in the file.
    """
    sentinels: dict[str, dict[str, str]] = {}
    site_toml: str | None = None
    counts: Counter[str] = Counter()
    first_time_ns, last_time_ns = 0, 0
    damaged_chunks, truncated = 0, False
    for item in _scan(path, progress=progress):
        match item:
            case Message():
                if topic(item.key.owner, item.key.stream).logged:
                    look(item)
                counts[key(*item.key)] += 1
                first_time_ns = min(first_time_ns or item.log_time_ns, item.log_time_ns)
                last_time_ns = max(last_time_ns, item.log_time_ns)
            case Metadata():
                sentinels[item.name] = dict(item.metadata)
            case Attachment() if item.name == SITE:
                site_toml = item.data.decode(errors="replace")
            case Damage():
                truncated = truncated or item.is_cut_off
                damaged_chunks += 0 if item.is_cut_off else 1
    return RecordingInfo(
        sentinels.get(ABOUT, {}),
        sentinels.get(START, {}),
        sentinels.get(END),
        site_toml,
        dict(counts),
        first_time_ns,
        last_time_ns,
        damaged_chunks,
        truncated,
    )


def read_identities(path: Path) -> Identities:
    """Return the messages in a recording; one of our own is not read completely.

    Raise InputError if the file is missing or not MCAP.
    """
    identities: Identities = {}
    start = 0
    with _opened(path) as file:
        stored = last_metadata(file, IDENTITIES)
    if stored is not None:
        try:
            identities = _parsed_identities(stored[0].metadata)
            start = stored[1]
        except ValueError:
            _log.warning("%s: its %s cannot be read", path, IDENTITIES)
    for item in _scan(path, start):
        if isinstance(item, Metadata) and item.name == END:
            break
        if isinstance(item, Message):
            numbers = identities.setdefault((item.key, item.boot_id), Intervals())
            numbers.add(item.sequence)
    return identities


def is_closed(path: Path) -> bool:
    """Return whether a recording has END and its index; raise InputError if unreadable."""
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(max(0, size - len(MCAP0_MAGIC)))
        return file.read() == MCAP0_MAGIC and last_metadata(file, END) is not None


def is_being_written(path: Path) -> bool:
    """Return whether a living process writes to a recording; raise InputError if unreadable."""
    with _opened(path) as file:
        return is_held(file)


def _parsed_identities(stored: Mapping[str, str]) -> Identities:
    identities: Identities = {}
    for name, ranges in stored.items():
        where, _, boot_id = name.partition(" ")
        numbers = identities[(parse_key(where), int(boot_id))] = Intervals()
        for text in ranges.split(","):
            first, _, last = text.partition("-")
            numbers.add_range(int(first), int(last))
    return identities


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    check_ordinary(path)
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        why = "no such file" if missing else f"cannot be read: {error.strerror}"
        raise InputError(f"{path}: {why}") from None


def _scan(
    path: Path, start: int = 0, progress: Offset = no_progress, warn: Warn = _log_warning
) -> Iterator[Message | Metadata | Attachment | Damage]:
    """Yield the useful records of a file in order, and the damage."""
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            raise InputError(f"{path}: is empty; an MCAP recording is expected")
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            how = "; driveby import makes one of CSV files" if path.suffix == ".csv" else ""
            raise InputError(f"{path}: is not an MCAP file; a recording (.mcap) is expected{how}")
        channels: dict[int, tuple[Key, int] | None] = {}
        has_looked = False
        for item in watched(scan(file, start), file, progress):
            if isinstance(item, RawMessage):
                if item.channel_id not in channels and not has_looked:
                    has_looked = True
                    # The chunk that declared it is lost. Every chunk of ours declares it again; of
                    # older files only the summary does.
                    everywhere = find_channels(path).items()
                    channels |= {
                        n: our_channel(path, c, warn) for n, c in everywhere if n not in channels
                    }
                known = channels.setdefault(item.channel_id, None)
                if known is not None:
                    where, boot_id = known
                    _, sequence, log_time_ns, publish_time_ns, data = item
                    yield Message(where, data, boot_id, sequence, log_time_ns, publish_time_ns)
            elif isinstance(item, Channel):
                if item.id not in channels:
                    channels[item.id] = our_channel(path, item, warn)
            elif isinstance(item, (Metadata, Attachment, Damage)):
                if isinstance(item, Metadata) and item.name == ABOUT:
                    _check_format(path, item.metadata, warn)
                yield item


def _check_format(path: Path, about: Mapping[str, str], warn: Warn) -> None:
    """Warn of a recording in a format that this program does not know."""
    if (theirs := about.get("format", FORMAT)) != FORMAT:
        writer = f"driveby {about.get('version', 'of an unknown version')}"
        warn(
            f"{path}: is in format {theirs:.20} of {writer:.40}, this program knows format "
            f"{FORMAT} and may misread it"
        )


def watched(items: Iterator[Item], file: BinaryIO, progress: Offset) -> Iterator[Item]:
    """Yield the same items; `progress` receives every new position in the file."""
    before = -1
    for item in items:
        if (offset := file.tell()) > before:
            progress(offset)
            before = offset
        yield item


def find_channels(path: Path) -> dict[int, Channel]:
    """Return all channels named anywhere in a file; of several, the first."""
    channels: dict[int, Channel] = {}
    with _opened(path) as file:
        for item in scan(file):
            if isinstance(item, Channel):
                channels.setdefault(item.id, item)
    return channels


def our_channel(
    path: Path | str, channel: Channel, warn: Warn = _log_warning
) -> tuple[Key, int] | None:
    """Return key and boot of a channel's messages; None, with a warning, if they are not ours."""
    boot_id = channel.metadata.get("boot_id", "0")
    try:
        where = parse_key(channel.topic)
    except ValueError:
        warn(f"{path}: topic {channel.topic!r:.80} is not one of driveby and is left out")
        return None
    is_number = boot_id.isascii() and boot_id.isdecimal() and len(boot_id) <= _BOOT_DIGITS
    return where, int(boot_id) if is_number else 0


def program_version() -> str:
    """Return this program's version, as recordings and results contain it."""
    try:
        return metadata.version("driveby")
    except metadata.PackageNotFoundError:  # run from a checkout that is not installed
        return "0"
