"""Fields of a protobuf message as nested dictionaries, for models whose fields have the same names.

A None and an absent field are the same; names of enumerations are in lower case, and their zero,
which means that no value was given, is None.
"""

from collections.abc import Mapping
from typing import Any

from google.protobuf.message import Message


def fill_fields(message: Message, values: Mapping[str, Any]) -> None:
    """Set fields of a message; raise KeyError for a name that the message lacks."""
    for name, value in values.items():
        field: Any = message.DESCRIPTOR.fields_by_name[name]
        if value is None:
            continue
        target = getattr(message, name)
        if _is_map(field):
            if field.message_type.fields_by_name["value"].message_type is None:
                target.update(value)
            else:
                for key, one in value.items():
                    fill_fields(target[key], one)
        elif field.is_repeated:
            if field.message_type is None:
                target.extend(value)
            else:
                for one in value:
                    fill_fields(target.add(), one)
        elif field.message_type is not None:
            target.SetInParent()
            fill_fields(target, value)
        elif field.enum_type is not None:
            setattr(message, name, field.enum_type.values_by_name[value.upper()].number)
        else:
            setattr(message, name, value)


def read_fields(message: Message) -> dict[str, Any]:
    """Return all fields of a message; None for an absent one, if it may be absent."""
    return {field.name: _value(message, field) for field in message.DESCRIPTOR.fields}


def _value(message: Message, field: Any) -> Any:
    value = getattr(message, field.name)
    if _is_map(field):
        is_plain = field.message_type.fields_by_name["value"].message_type is None
        return dict(value) if is_plain else {key: read_fields(one) for key, one in value.items()}
    if field.is_repeated:
        return list(value) if field.message_type is None else [read_fields(one) for one in value]
    if field.has_presence and not message.HasField(field.name):
        return None
    if field.message_type is not None:
        return read_fields(value)
    if field.enum_type is not None:
        return field.enum_type.values_by_number[value].name.lower() if value else None
    return value


def _is_map(field: Any) -> bool:
    return field.message_type is not None and field.message_type.GetOptions().map_entry
