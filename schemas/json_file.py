"""JSON files as models, with one line for each error."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from schemas.errors import InputError

ModelT = TypeVar("ModelT", bound=BaseModel)


def load_json(model: type[ModelT], path: Path, what: str) -> ModelT:
    """Read a file as `what` ("a results file"); raise InputError in one line if it is not one."""
    try:
        return model.model_validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, {what} (JSON) is expected") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        raise InputError(f"{path}: {place or f'not {what}'}: {message}") from error
