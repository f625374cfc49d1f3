"""What the words of a report mean, for who reads nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple


class Word(NamedTuple):
    """A word, how to see that it is used, and what it means here."""

    word: str
    seen_by: tuple[str, ...]
    meaning: str


_WORDS = (
    Word(
        "Verdict",
        (": good", ": suspect", ": rejected"),
        "Of a crossing, one drive over the bridge: good is to be relied upon, suspect is not, "
        "rejected gave no number. It judges the measurement and says nothing of the bridge.",
    ),
    Word(
        "EI",
        ("EI",),
        "Flexural rigidity: how hard the bridge is to bend at a place. A crack makes it smaller.",
    ),
    Word(
        "Element",
        ("element",),
        "A piece of the span, of which one EI is told; counted from the start of the bridge.",
    ),
    Word(
        "95 % interval",
        ("interval",),
        "What is said lies in it in 95 of 100 cases, if what is declared of truck and sensors "
        "is true.",
    ),
    Word(
        "Scatter",
        ("crossings alone",),
        "One crossing alone knows less than all together, by noise, speed and temperature. So "
        "single crossings, dots in the picture, lie farther apart than the interval is wide.",
    ),
    Word("Nominal", ("nominal",), "The value that the owner wrote down of the sound bridge."),
    Word("Baseline", ("baseline",), "Results of an earlier survey, to compare with."),
    Word(
        "Misfit, χ²",
        ("χ²", "does not explain", "leaves over"),
        "How far the signals are from what the model of truck and bridge makes of them, over what "
        "the noise of the sensors explains: 1 where the model holds, larger where it does not.",
    ),
    Word(
        "Noise",
        ("noise", "noisier", "quieter"),
        "What an accelerometer shows when nothing moves. The site file, which describes truck, "
        "sensors and bridge, declares how strong it is.",
    ),
    Word(
        "Channel",
        ("hannel",),
        "The signal of one accelerometer: sprung_front and sprung_rear are on the body above an "
        "axle, unsprung_front and unsprung_rear on the axle itself.",
    ),
    Word(
        "Draws",
        ("draws",),
        "Values of all unknowns, some thousands, that are as likely as the measurement says: "
        "intervals are counted among them, so they must be enough and agree.",
    ),
    Word(
        "IRI, class of ISO 8608",
        ("International Roughness",),
        "How rough the road is: below 2 m/km is smooth; A is the best class and H the worst.",
    ),
)


def words_of(text: str) -> Iterator[tuple[str, str]]:
    """The words that a text uses, each with its meaning."""
    return ((one.word, one.meaning) for one in _WORDS if any(part in text for part in one.seen_by))
