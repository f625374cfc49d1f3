"""JSON files as models, with one line for each error."""

import json
import re
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from schemas.errors import InputError

ModelT = TypeVar("ModelT", bound=BaseModel)


def load_json(model: type[ModelT], path: Path, what: str) -> ModelT:
    """Read a file as `what` ("a results file"); raise InputError in one line if it is not one."""
    content = b""
    try:
        content = path.read_bytes()
        return model.model_validate_json(content)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, {what} (JSON) is expected") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "extra_forbidden":
            message = "is unknown here, read the file with the version of driveby that wrote it"
        message += _remark_of_newer(content)
        raise InputError(f"{path}: {place or f'not {what}'}: {message}") from error


def _remark_of_newer(content: bytes) -> str:
    """Return a remark if the file declares a newer program than this one as its writer."""
    from importlib import metadata  # 20 ms that only errors need

    try:
        declared = json.loads(content)
        theirs = declared["version"] if declared["program"] == "driveby" else ""
        ours = metadata.version("driveby")
        is_newer = _numbers(theirs) > _numbers(ours)
    except (ValueError, KeyError, TypeError, metadata.PackageNotFoundError):
        return ""
    return f" (written by driveby {theirs[:20]}, this is {ours})" if is_newer else ""


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d{1,9}", version)]
