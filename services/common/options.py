"""Options of a command as the fields of a frozen dataclass, and the types of their values.

`cli.parser` makes an argument of each field, in their order, and an instance of what was given.
Nothing heavy is imported here: `driveby --help` does not wait for compilers and viewers.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from services.common.endpoints import DEFAULT_ENDPOINT, DEFAULT_TLS_ENDPOINT
from services.common.kinds import MCAP, Kind

RECORDINGS: Final = Path("recordings")
CERTIFICATES: Final = RECORDINGS / "certificates"
SCENARIOS: Final = range(1, 13)
METHODS: Final = ("pre", "least-squares", "random-walk")
OPTION: Final = "option"
"""Key of a field's metadata under which its `Option` is."""


class Option(NamedTuple):
    """An argument of the command line, which fills one field."""

    flags: tuple[str, ...]
    """Spellings; if empty, one made from the field's name. A positional argument has its name."""
    group: str
    """Title of the group in the help; empty: none."""
    alternatives: str
    """Name shared by options of which one may be given; empty: none."""
    settings: Mapping[str, Any]
    """Arguments of `argparse.ArgumentParser.add_argument`."""


def opt(
    text: str,
    parse: Callable[[str], Any] | None = None,
    *,
    flags: tuple[str, ...] = (),
    group: str = "",
    alternatives: str = "",
    default: Any = None,
    **settings: Any,
) -> Any:
    """Return the field of an option; `text` is its help, `parse` makes the value.

    It has no default if it is `required`; of `alternatives` that are required, one has to be given.
    An option that may be
    repeated (`action`) has the default `()`, and its value is a tuple.
    """
    if parse is not None:
        settings["type"] = parse
    option = Option(flags, group, alternatives, {"help": text, **settings})
    is_required = settings.get("required", False) and not alternatives
    return field(default=MISSING if is_required else default, metadata={OPTION: option})


def flag(text: str, *, group: str = "", alternatives: str = "") -> Any:
    """Return the field of an option without a value, which is False unless it is given."""
    return opt(text, group=group, alternatives=alternatives, default=False, action="store_true")


def positional(text: str, parse: Callable[[str], Any] | None = None, **settings: Any) -> Any:
    """Return the field of a positional argument."""
    more = {} if parse is None else {"type": parse}
    option = Option(("",), "", "", {"help": text, **more, **settings})
    return field(metadata={OPTION: option})


def endpoint_option(group: str = "") -> Any:
    """Return `--endpoint`: the address of the bus; None for the usual one."""
    return opt(f"address of the logger (default: {DEFAULT_ENDPOINT})", group=group)


def realm_option(group: str = "") -> Any:
    """Return `--realm`."""
    return opt("realm on the bus (default: live)", default="live", group=group)


def tls_option(group: str = "") -> Any:
    """Return `--tls`: a folder of credentials."""
    address = f"the default address is then {DEFAULT_TLS_ENDPOINT}"
    text = f"credentials made by `driveby certs`; {address}"
    return opt(text, Path, group=group, metavar="FOLDER")


def site_option(text: str, *, group: str = "", required: bool = False) -> Any:
    """Return `--site`: a site file."""
    return opt(text, Path, group=group, metavar="SITE.toml", required=required)


def speed_option(default: float, *, zero: str = "", other: str = "", group: str = "") -> Any:
    """Return `--speed` as a multiple of the original one.

    `zero` explains the value 0; `other`, with its punctuation, the effect of any but 1.
    """
    what = f"playback speed as a multiple of real time{', ' + zero if zero else ''}{other}"
    return opt(
        f"{what} (default: {default:g})",
        number("a factor", low=0 if zero else 1e-3, high=1e6),
        default=default,
        group=group,
        metavar="FACTOR",
    )


def config_option() -> Any:
    """Return `--config`: a file of options, which the command line overrides."""
    text = 'file of options such as id = "a"; the command line overrides it'
    return file_option(text, "CONFIG.toml")


def file_option(text: str, metavar: str, *, group: str = "") -> Any:
    """Return an option that names a file to read."""
    return opt(text, Path, group=group, metavar=metavar)


def output_option(
    text: str,
    metavar: str,
    *kinds: Kind,
    flags: tuple[str, ...] = (),
    group: str = "",
    default: Path | None = None,
    required: bool = False,
) -> Any:
    """Return an option that names a file to write, which replaces a file of these kinds only."""
    parse = OutputFile(kinds)
    return opt(
        text, parse, flags=flags, group=group, default=default, metavar=metavar, required=required
    )


def recording_option(*, required: bool = False) -> Any:
    """Return `-o`: the recording to write, which is replaced with `--force` only."""
    flags = ("-o", "--output")
    return output_option("recording to write", "REC.mcap", MCAP, flags=flags, required=required)


def output_folder_option(text: str, *, group: str = "", required: bool = False) -> Any:
    """Return an option that names a folder to write to."""
    return opt(text, folder_here, group=group, metavar="DIR", required=required)


def method_option() -> Any:
    """Return `--method` of identification."""
    text = "pre: with intervals, for real sensors; least-squares: for simulations without noise; "
    return opt(
        f"{text}random-walk: the paper's search (default: {METHODS[0]})",
        default=METHODS[0],
        choices=METHODS,
    )


def folder_option(text: str) -> Any:
    """Return `--folder`: where a service writes its files."""
    return opt(f"{text} (default: recordings)", Path, default=RECORDINGS, metavar="DIR")


def history_option() -> Any:
    """Return `--history`: the folder of a history."""
    text = "folder of the history (default: history)"
    return opt(text, Path, default=Path("history"), metavar="DIR")


def id_option(default: str) -> Any:
    """Return `--id` of a service."""
    text = f"name of this service (default: {default})"
    return opt(text, flags=("--id",), default=default)


def count_option(
    text: str,
    what: str,
    default: int,
    low: int = 0,
    high: int = (1 << 63) - 1,
    group: str = "",
) -> Any:
    """Return an option with a whole number from `low` to `high`; `what` is for its error."""
    text = f"{text} (default: {default})"
    return opt(text, whole(what, low, high), group=group, default=default, metavar="N")


def noise_option(text: str, default: float | None = 0.0) -> Any:
    """Return `--noise` of the accelerometers."""
    parse = number("a noise density", low=0, high=1e6)
    return opt(text, parse, default=default, metavar="UG_PER_RTHZ")


def seed_option() -> Any:
    """Return `--seed` of all random numbers."""
    return opt("seed of all random numbers (default: 1)", whole("a seed", 0), default=1)


def force_option() -> Any:
    """Return `--force`: replace existing files."""
    return flag("replace an existing recording, unless it is being written")


def validations_option(text: str, *, group: str = "") -> Any:
    """Return `--validations`: a folder of validation records."""
    return opt(text, Path, flags=("--validations",), group=group, metavar="DIR")


def validations_folder(given: Path | None) -> Path:
    """Return the folder of validation records: the given one, else the usual one."""
    return given or CERTIFICATES


def baseline_option() -> Any:
    """Return `--baseline`: earlier results to compare with."""
    text = "results that the bridge is compared with (default: those that the site file names)"
    return file_option(text, "OLD.json")


def fuse_suspect_option() -> Any:
    """Return `--fuse-suspect`."""
    return flag("fuse suspect crossings too; the bridge's estimate is then suspect")


def option_of(name: str) -> str:
    """Return the option whose value has this name among the parsed ones."""
    return f"--{name.replace('_', '-')}"


def scenario(text: str) -> int:
    """Parse the number of a damage scenario of the paper."""
    if not text.isascii() or not text.isdigit() or int(text[:9]) not in SCENARIOS:
        raise argparse.ArgumentTypeError(f'is "{text}", it must be 1 to 12')
    return int(text)


def source(text: str) -> Path | str:
    """Return a file or folder; an address such as s3://bucket/fleet stays as it is."""
    return text if "://" in text else Path(text)


@dataclass(frozen=True)
class OutputFile:
    """Type of an argument that names a file to write, and the kinds that it may replace.

    Every other path is an input, or a folder to write to (`folder_here`).
    """

    kinds: tuple[Kind, ...]
    """Kinds that may be replaced; None if the command has a rule of its own."""

    def __call__(self, text: str) -> Path:
        """Return the path."""
        return Path(text)


def folder_here(text: str) -> Path:
    """Return a local folder to write to; an address would otherwise name a folder s3:."""
    if "://" in text:
        raise argparse.ArgumentTypeError(f"is {text!r}, a folder of this machine is expected")
    return Path(text)


def number(what: str, *, low: float, high: float, hint: str = "") -> Callable[[str], float]:
    """Return a parser of numbers between two limits; `what` and `hint` are for its error."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f'is "{text}", it must be {what} from {low:g} to {high:g}'
                + (f"; {hint}" if hint else "")
            )
        return value

    return parse


def numbers(what: str, *limits: tuple[float, float]) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of as many numbers, separated by colons, as there are limits."""

    def parse(text: str) -> tuple[float, ...]:
        parts = text.split(":")
        if len(parts) != len(limits):
            raise argparse.ArgumentTypeError(f'is "{text}", it must be {what}')
        return tuple(
            number(what, low=low, high=high)(part)
            for part, (low, high) in zip(parts, limits, strict=True)
        )

    return parse


def names(text: str) -> tuple[str, ...]:
    """Parse names between commas."""
    return tuple(name.strip() for name in text.split(","))


def whole(what: str, low: int, high: int = (1 << 63) - 1) -> Callable[[str], int]:
    """Return a parser of whole numbers between two limits; `what` is for its error."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            limits = f"of at least {low}" if high >= (1 << 63) - 1 else f"from {low} to {high}"
            raise argparse.ArgumentTypeError(
                f'is "{text}", it must be {what}, a whole number {limits}'
            )
        return value

    return parse
