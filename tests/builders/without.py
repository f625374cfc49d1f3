"""A command as it runs where only some extras are installed.

    python -m tests.builders.without identify,view driveby identify REC.mcap
    python -m tests.builders.without "" python "import driveby"

Modules that only other extras bring cannot be imported. Packages that an extra brings by way of
its own packages stay.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec

from services.common.extras import EXTRAS

BROUGHT = {
    "identify": {"llvmlite"},
    "view": {"pyarrow"},
    "s3": {"fsspec"},
    "cluster": {"dask"},
}
"""What the packages of an extra need themselves, as far as it is a package of another extra or
refuses to be imported without it."""


def modules_of(extra: str) -> set[str]:
    return {*EXTRAS[extra], *BROUGHT.get(extra, ())}


class Refused:
    """A finder that has all modules of an extra missing but those of the extras that are there."""

    def __init__(self, extras: Sequence[str]) -> None:
        there = {module for extra in extras for module in modules_of(extra)}
        self.modules = {module for extra in EXTRAS for module in modules_of(extra)} - there

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name.partition(".")[0] in self.modules:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


def main(extras: str, what: str, *arguments: str) -> int:
    refused = Refused([extra for extra in extras.split(",") if extra])
    assert not refused.modules & sys.modules.keys()
    sys.meta_path.insert(0, refused)
    if what == "python":
        exec(arguments[0], {})  # noqa: S102
        return 0
    from services.cli.main import main as driveby

    return driveby(arguments)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
