"""What is not installed with the program itself, but with `pip install "driveby[notebook]"`."""

from importlib.util import find_spec

from services.common.errors import InputError


def check_installed(what: str, *modules: str, otherwise: str = "", extra: str = "notebook") -> None:
    """InputError that says how to install them if any of the modules is missing; imports none.

    `otherwise` is what can be done without them, `extra` the name under which all are installed.
    """
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise InputError(
            f"{what} needs {' and '.join(missing)}, which {verb} not installed: "
            f'pip install "driveby[{extra}]"{otherwise and f" ({otherwise})"}'
        )
