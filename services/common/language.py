"""Languages of reports: their sentences, from one file each, and how they write numbers."""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from importlib import resources
from typing import Any, Final, NamedTuple

from schemas.reasons import (
    BRIDGE_REASON_TEXTS,
    LEFT_OUT_TEXTS,
    REASON_TEXTS,
    Reason,
)
from schemas.toml_text import parse_toml

LANGUAGES: Final = {"en": "english", "de": "german"}
"""File of each language, by its code of ISO 639-1."""
_COMMA: Final = str.maketrans(".,", ",.")


class GlossaryEntry(NamedTuple):
    """A term, the texts by which its use is recognised, and its meaning here."""

    word: str
    seen_by: tuple[str, ...]
    meaning: str


class Language(NamedTuple):
    """Sentences of one language."""

    code: str
    has_decimal_comma: bool
    sentences: Mapping[str, str]
    """Sentences by key, with named values as of `str.format`."""
    reasons: Mapping[str, str]
    """Sentence of each reason of a crossing, by its code."""
    bridge_reasons: Mapping[str, str]
    left_out: Mapping[str, str]
    details: Mapping[str, str]
    """Translations of parts of the details that follow a reason, by the English text."""
    advice: Mapping[str, str]
    """Advice for each reason of a crossing with method `pre`; see `remedy`."""
    bridge_advice: Mapping[str, str]
    glossary: tuple[GlossaryEntry, ...]

    def text(self, key: str, **values: Any) -> str:
        """Return a sentence with its values; KeyError for an unknown key or a missing value."""
        return self._formatter.vformat(self.sentences[key], (), values)

    def number(self, value: float, form: str = ".3g") -> str:
        """Return a number in a format of `str.format`."""
        return str(self._formatter.format_field(float(value), form))

    def change(self, ratio: float) -> str:
        """Return the change of a ratio to 1 in per cent, with its sign."""
        change = round(100.0 * (ratio - 1.0))
        return f"{self.number(change, '+.0f')} %" if change else "0 %"

    def choice(self, key: str, number: int, **values: Any) -> str:
        """Return the sentence `key.one` for one of something, and `key.many` for another number."""
        return self.text(f"{key}.{'one' if number == 1 else 'many'}", number=number, **values)

    def listed(self, items: Sequence[str]) -> str:
        """Return the items with commas, and a word before the last."""
        if len(items) < 2:
            return "".join(items)
        return f"{', '.join(items[:-1])} {self.sentences['and']} {items[-1]}"

    def reason(self, code: str, stored: str) -> str:
        """Return the sentence of a reason, with the details that the stored one ends with."""
        if self.reasons is REASON_TEXTS:
            return stored
        sentence = self.reasons[code]
        # An older version's sentence has other words, and its details behind as many colons.
        parts = stored.split(": ", REASON_TEXTS[Reason(code)].count(": ") + 1)
        if len(parts) < REASON_TEXTS[Reason(code)].count(": ") + 2:
            return sentence
        details = parts[-1]
        for english, own in self.details.items():
            details = details.replace(english, own)
        return f"{sentence.removesuffix('.')}: {details}"

    def remedy(self, code: str, method: str) -> str:
        """Return the advice for a reason of a crossing that was identified by a method."""
        return self.sentences.get(f"remedy.{code}.{method}", self.advice[code])

    def bridge_reason(self, code: str, stored: str) -> str:
        """Return the sentence of a reason of a bridge's state."""
        return stored if self.reasons is REASON_TEXTS else self.bridge_reasons[code]

    @property
    def _formatter(self) -> _NumberFormatter:
        return _NumberFormatter(self.has_decimal_comma)


class _NumberFormatter(string.Formatter):
    """Format numbers with a true minus sign and, where it is usual, with a decimal comma."""

    def __init__(self, has_decimal_comma: bool) -> None:
        self._has_decimal_comma = has_decimal_comma

    def format_field(self, value: Any, format_spec: str) -> Any:
        text = super().format_field(value, format_spec)
        if not isinstance(value, float):
            return text
        text = text.replace("-", "−")
        return text.translate(_COMMA) if self._has_decimal_comma else text


@lru_cache
def language_of(code: str) -> Language:
    """Return a language by its code, one of `LANGUAGES`."""
    name = f"{LANGUAGES[code]}.toml"
    text = resources.files("services").joinpath(f"data/{name}").read_text(encoding="utf-8")
    content = parse_toml(text, name)
    return Language(
        content["code"],
        content["has_decimal_comma"],
        _flat(content["sentences"]),
        content.get("reasons", REASON_TEXTS),
        content.get("bridge_reasons", BRIDGE_REASON_TEXTS),
        content.get("left_out", LEFT_OUT_TEXTS),
        content.get("details", {}),
        content["advice"],
        content["bridge_advice"],
        tuple(
            GlossaryEntry(one["word"], tuple(one["seen_by"]), one["meaning"])
            for one in content["glossary"]
        ),
    )


def utc_day(time_s: float) -> str:
    """Return the day of a time in s since 1970 UTC, such as 2026-07-01, alike in all languages."""
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d}"


def utc_second(time_s: float) -> str:
    """Return a time in s since 1970 UTC to the second, such as 2026-07-01 09:30:00."""
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M:%S}"


def _flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return the sentences of nested tables, by dotted keys."""
    found: dict[str, str] = {}
    for key, value in content.items():
        name = f"{prefix}{key}"
        found |= {name: value} if isinstance(value, str) else _flat(value, f"{name}.")
    return found


ENGLISH: Final = language_of("en")
