"""Writes docs/topics.md from the table of topics: `python -m schemas.topics_page`.

A test compares the page with the table and runs the subscriber that the page shows.
"""

from pathlib import Path

from schemas.spool import PAGE_BYTES, PAGE_MESSAGES, SUFFIX
from schemas.topics import IDENTIFIER, PREFIX, TOPICS, Topic

PAGE = Path(__file__).resolve().parents[1] / "docs" / "topics.md"

SUBSCRIBER = """\
import json, sys, zenoh
from schemas.messages import decode
from schemas.topics import parse_key, topic

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))  # tcp/127.0.0.1:7447
history = zenoh.ext.HistoryConfig(detect_late_publishers=True)  # what was said before, too
with zenoh.open(config) as session:
    received = zenoh.ext.declare_advanced_subscriber(session, "driveby/v1/**", history=history)
    for sample in received:
        key = parse_key(str(sample.key_expr))
        message = decode(topic(key.owner, key.stream).message, sample.payload.to_bytes())
        found = getattr(message, "parameters", {})  # of an estimate; none if it was rejected
        said = (f"{n} {p.q025:.3g} to {p.q975:.3g}" for n, p in sorted(found.items()) if "EI_" in n)
        print(key.realm, key.identifier, key.stream, *said, flush=True)
"""

_HEAD = f"""\
<!-- Written by `python -m schemas.topics_page` from schemas/topics.py. Do not edit. -->
# Topics

What travels over Zenoh, one row for each stream. Logger, replay, liveness and viewer go by the
same table (`schemas/topics.py`); messages are Protocol Buffers (`schemas/proto/driveby.proto`).

A key is `{PREFIX}/{{realm}}/{{owner}}/{{id}}/{{stream}}`, for example
`{PREFIX}/live/vehicle/truck-1/accel`. The realm is `live`, `replay-NAME`, `sim-NAME` or
`import-NAME`: a replay never mixes with the real thing. Identifiers and NAME match
`{IDENTIFIER}`.
"""

PAGE_MIB = PAGE_BYTES >> 20

_TAIL = f"""
- **reliable** publishers block instead of dropping, keep their last messages (*kept*) and are
  asked again for what was missed. **latest** may be dropped. A **latched** topic gives its last
  message to a late subscriber; it also answers `session.get(key)`. The logger writes what is
  **logged**, byte for byte.
- A message's identity is (realm, owner and id, stream, boot_id, sequence). `boot_id` rises with
  every start of the publisher, `sequence` counts the messages of one key from 0. Both are in the
  Zenoh attachment of every put: two unsigned 64-bit integers, big-endian. A message may arrive
  twice or late; tell it by its identity, and order a stream by (boot_id, sequence).
- `durable` says, for every stream and boot, up to where a logger has all messages safely on disk
  (`sequence`, from 0) and how many different ones it has (`count`). A publisher that is about to
  leave waits until `count` has reached what it sent.
- A payload larger than *at most*, of another message, of another schema version or with
  impossible values is refused by the logger, counted, and reported in an `event`.

## What a truck has on its own disk

A truck with a spool answers queries, and a logger asks for what the bus did not bring: after the
truck's process died, after an outage longer than what publishers keep, or while the connection does
not take all. The key is that of the data with `{SUFFIX}` behind it (`schemas/spool.py`); ask with
consolidation `NONE` and target `ALL`.

- `{PREFIX}/{{realm}}/vehicle/*/*{SUFFIX}`: what is there. One `driveby.v1.SpoolContents` for each
  stream: of every boot the next sequence, what is held, up to where a logger has confirmed it, how
  many messages were given up for room.
- `{PREFIX}/{{realm}}/vehicle/{{id}}/{{stream}}{SUFFIX}?boot=B;from=F;to=T`: messages F to T
  that are held, payload and attachment as published; at last, without attachment, a
  `driveby.v1.SpoolPage`.

One answer holds at most {PAGE_MESSAGES} messages or {PAGE_MIB} MiB; `next` in the page says from
where to ask on. What lies below it and did not come is not held any more. An answer without a page
was cut off: ask again. A truck frees what `durable` confirms.

## A subscriber

Run it with the endpoint of the logger, e.g. `.venv/bin/python subscriber.py tcp/127.0.0.1:7447`.
Where a wheel is installed instead of the checkout, `schemas` is `driveby.schemas`.

```python
{SUBSCRIBER}```
"""


def page() -> str:
    """Return the text of docs/topics.md."""
    columns = (
        "stream", "message", "logged", "latched", "per second", "delivery", "kept", "at most", "",
    )  # fmt: skip
    lines = [_row(columns), _row(("---",) * len(columns))]
    lines += [_row(_cells(row)) for row in TOPICS]
    return _HEAD + "\n" + "\n".join(lines) + "\n" + _TAIL


def _cells(row: Topic) -> tuple[str, ...]:
    rate = row.nominal_rate_hz
    per_second = "on occasion" if rate is None else f"{rate:g}" if rate >= 1 else "1 a minute"
    return (
        f"`{row.owner}/…/{row.stream}`",
        f"`{row.message}`" if row.message else "(a liveliness token)",
        "yes" if row.logged else "no",
        "yes" if row.latched else "no",
        per_second,
        row.delivery,
        f"{row.cache}" if row.message else "",
        f"{row.max_bytes // 1024} KiB" if row.message else "",
        row.description,
    )


def _row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    PAGE.write_text(page())
