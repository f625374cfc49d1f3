"""Recordings: MCAP files of the bytes that went over the bus, and what is needed to read them.

One MCAP channel per key and boot; its topic is the Zenoh key, its metadata holds the boot_id, the
message's `sequence` is MCAP's own, `log_time` the wall time of the first sample, `publish_time`
when the message came in. Schemas carry all that they import, so that Rerun and Foxglove decode
them. Besides the messages a file has

- metadata `driveby`: program, version, format, and realm and vehicle where there is only one;
- metadata `driveby.start` and `driveby.end`: reason, time, and at the end the counts. A file
  without `driveby.end` was cut off: everything up to its last whole chunk can still be read. A file
  that continues another one names it as `previous` in `driveby.start`, and begins with that many
  latched messages again as `repeated` says;
- metadata `driveby.identities`, every minute and before the end: by key and boot, the sequence
  numbers of all messages before it;
- metadata `driveby.recovered`, if the file was rewritten by `driveby recover`: what was lost;
- attachment `site.toml`, if the site was known to the writer.
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
from schemas.topics import Key, key, parse_key, topic
from services.common.errors import InputError
from services.common.files import check_ordinary, is_held
from services.common.intervals import Intervals
from services.common.progress import Offset, unwatched
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
"""A number of 64 bits has no more."""

Warn = Callable[[str], None]
"""Takes what is wrong with a file that can be read all the same, in one line."""
Identities = dict[tuple[Key, int], Intervals]
"""By key and boot_id: the sequence numbers of the messages."""


class Message(NamedTuple):
    """One message as it went over the bus; its identity is (key, boot_id, sequence)."""

    key: Key
    payload: bytes
    boot_id: int
    sequence: int
    log_time_ns: int
    """Wall time of the first sample, ns since 1970 UTC."""
    publish_time_ns: int
    """Wall time at which the writer got it, ns since 1970 UTC."""


class RecordingInfo(NamedTuple):
    """What a recording says of itself and what it holds."""

    about: dict[str, str]
    start: dict[str, str]
    end: dict[str, str] | None
    """None: the writer did not get to finish the file."""
    site_toml: str | None
    messages: dict[str, int]
    """Number of messages by key."""
    first_time_ns: int
    last_time_ns: int
    damaged_chunks: int
    """Places in the middle of the file that cannot be read, a chunk each as a rule."""
    truncated: bool
    """The file ends in the middle of a record or without MCAP's footer."""


def _log_warning(text: str) -> None:
    _log.warning("%s", text)


def read_messages(
    path: Path, progress: Offset = unwatched, *, warn: Warn = _log_warning
) -> Iterator[Message]:
    """Yield the messages in the order of the file; `progress` is told how far that is.

    A file that was cut off is read up to its last whole chunk, damaged places are left out; both
    are said to `warn` (and counted by `read_info`). InputError if the file is missing, is no MCAP
    file, holds no message of ours, or one of a truck that is larger than its topic allows: taking
    apart what fits the name of a message and nothing else can cost gigabytes.
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
            warn(f"{path}: {item.text}")
    if not found:
        raise InputError(f"{path}: holds no driveby message; a recording of a truck is expected")


def check_message(path: Path, message: Message) -> None:
    """InputError if the bus would not take a message, or no logger: what is wrong, in one line."""
    try:
        check_stamp(topic(message.key.owner, message.key.stream), message.payload)
    except ValueError as error:
        raise _wrong(path, message, error) from None
    check_envelope(path, message)


def check_envelope(path: Path, message: Message) -> None:
    """The same of all but what is in a message, which whoever decodes it sees by that."""
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
    """Return the site file stored in the recording, None if there is none; InputError as above."""
    for item in _scan(path):
        if isinstance(item, Attachment) and item.name == SITE:
            try:
                return item.data.decode()
            except UnicodeDecodeError:
                raise InputError(f"{path}: its attachment {SITE} is not UTF-8 text") from None
        if isinstance(item, Message):  # the attachment stands before all messages
            return None
    return None


def read_info(
    path: Path,
    look: Callable[[Message], object] = lambda message: None,
    progress: Offset = unwatched,
) -> RecordingInfo:
    """Read the whole file and say what is in it; InputError if it is missing or not MCAP.

    `look` is given every message of a topic that is logged, `progress` is told how far it is.
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
    """Return which messages a recording holds, without reading all of it if it is one of ours.

    InputError if the file is missing or not MCAP.
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
    """Whether a recording has an END sentinel and its index; InputError if it cannot be read."""
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(max(0, size - len(MCAP0_MAGIC)))
        return file.read() == MCAP0_MAGIC and last_metadata(file, END) is not None


def is_being_written(path: Path) -> bool:
    """Whether a living process writes to a recording; InputError if it cannot be opened."""
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
    path: Path, start: int = 0, progress: Offset = unwatched, warn: Warn = _log_warning
) -> Iterator[Message | Metadata | Attachment | Damage]:
    """Yield all that is of use in a file, in its order, and what is damaged."""
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            raise InputError(f"{path}: is empty; an MCAP recording is expected")
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise InputError(f"{path}: is not an MCAP file; a recording (.mcap) is expected")
        channels: dict[int, tuple[Key, int] | None] = {}
        has_looked = False
        for item in watched(scan(file, start), file, progress):
            if isinstance(item, RawMessage):
                if item.channel_id not in channels and not has_looked:
                    has_looked = True
                    # The chunk that said it is lost. Ours say it again in every chunk; of older
                    # files only the summary does.
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
                yield item


def watched(items: Iterator[Item], file: BinaryIO, progress: Offset) -> Iterator[Item]:
    """The same items; `progress` is told whenever more of the file has been read."""
    before = -1
    for item in items:
        if (offset := file.tell()) > before:
            progress(offset)
            before = offset
        yield item


def find_channels(path: Path) -> dict[int, Channel]:
    """Return all channels that are named anywhere in a file; of several, the first."""
    channels: dict[int, Channel] = {}
    with _opened(path) as file:
        for item in scan(file):
            if isinstance(item, Channel):
                channels.setdefault(item.id, item)
    return channels


def our_channel(
    path: Path | str, channel: Channel, warn: Warn = _log_warning
) -> tuple[Key, int] | None:
    """Key and boot of a channel's messages; None, and `warn` is told, if they are not ours."""
    boot_id = channel.metadata.get("boot_id", "0")
    try:
        where = parse_key(channel.topic)
    except ValueError:
        warn(f"{path}: topic {channel.topic!r:.80} is not ours and is left out")
        return None
    is_number = boot_id.isascii() and boot_id.isdecimal() and len(boot_id) <= _BOOT_DIGITS
    return where, int(boot_id) if is_number else 0


def program_version() -> str:
    """Return this program's version, as recordings and results carry it."""
    try:
        return metadata.version("driveby")
    except metadata.PackageNotFoundError:  # run from a checkout that was not installed
        return "0"
