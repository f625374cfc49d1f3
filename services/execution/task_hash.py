"""Hash of a crossing's input: equal data, program and search give equal results.

Values are hashed, not pickles, which differ from run to run for equal values.
"""

import hashlib
from collections.abc import Iterable, Mapping
from enum import Enum

import numpy as np
from pydantic import BaseModel

from schemas.settings import NOT_OF_THE_RESULT
from services.identification.outputs import IdentificationTask


def task_hash(task: IdentificationTask, program: Mapping[str, str]) -> str:
    """Return the hash of a crossing's data, its settings and the program."""
    settings = task.settings.model_dump(mode="json", exclude=set(NOT_OF_THE_RESULT))
    job = (*task.data, task.certificate, sorted(settings.items()), sorted(program.items()))
    return hashlib.sha256(b"".join(_parts(job))).hexdigest()[:32]


def combined_hash(contents: Iterable[str]) -> str:
    """Return one hash for several, in their order."""
    return hashlib.sha256("".join(contents).encode()).hexdigest()[:32]


def _parts(value: object) -> Iterable[bytes]:
    """Return the unambiguous bytes of a value: kind, length, content."""
    if isinstance(value, np.ndarray):
        yield f"array {value.dtype.str} {value.shape};".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, BaseModel):
        yield from _parts(value.model_dump_json())
    elif isinstance(value, Enum):
        yield from _parts(str(value.value))
    elif isinstance(value, Mapping):
        yield from _parts(sorted(value.items()))
    elif isinstance(value, list | tuple):
        yield f"{len(value)} of;".encode()
        for one in value:
            yield from _parts(one)
    elif value is None or isinstance(value, bool | int | float | str):
        text = repr(value).encode()
        yield b"%s %d;" % (type(value).__name__.encode(), len(text)) + text
    else:
        raise TypeError(f"a {type(value).__name__} has no content that is known here")
