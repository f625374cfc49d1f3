"""Types of the numbers in a site file, and the base of its tables."""

from typing import Annotated, Any, ClassVar, Final

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    Strict,
    StringConstraints,
    model_serializer,
)

from schemas.signals import MAX_RATE_HZ
from schemas.topics import IDENTIFIER

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0, le=1e15)]
NotNegative = Annotated[Number, Field(ge=0, le=1e15)]
PositivePair = tuple[Positive, Positive]
NotNegativePair = tuple[NotNegative, NotNegative]
Spread = Annotated[Number, Field(ge=0, le=3)]
Identifier = Annotated[str, StringConstraints(pattern=f"^{IDENTIFIER}$")]
Rate = Annotated[Number, Field(ge=1, le=MAX_RATE_HZ)]
Density = Annotated[Number, Field(ge=0, le=1e6)]
Track = Annotated[Number, Field(gt=0, le=5)]

UNSPRUNG_MASS_SPREAD: Final = 0.15


class Table(BaseModel):
    """A table of a site file: immutable, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    later_keys: ClassVar[tuple[str, ...]] = ()
    """Keys that are written only if they differ from their defaults, so that a file without them
    keeps the hash that it had before the keys existed."""

    @model_serializer(mode="wrap")
    def _without_later_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        fields = type(self).model_fields
        for key in self.later_keys:
            if key in values and getattr(self, key) == fields[key].default:
                del values[key]
        return values
