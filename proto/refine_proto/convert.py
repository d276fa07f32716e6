"""Models to messages and back: two generic functions over protobuf's JSON mapping.

These rules bridge the two JSON dialects: enum values are lower case in the models; a message that is nothing
but one oneof is a union tagged by the oneof's name, `{"type": "look_at", ...}`; unset, empty and unspecified
fields are left to the model's defaults. A matrix is rows in the models, row-major numbers on the wire.
An enum value that only a newer version has is unspecified on the wire, and its number in the models.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import Any, TypeAlias, TypeVar

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import MessageToDict, ParseDict
from google.protobuf.message import Message
from pydantic import BaseModel

MessageT = TypeVar("MessageT", bound=Message)
ModelT = TypeVar("ModelT", bound=BaseModel)
# protobuf's two implementations of Descriptor have no common base.
Descriptor: TypeAlias = Any
_OfMessage: TypeAlias = Callable[..., dict[str, Any]]
_OfEnum: TypeAlias = Callable[..., str]


def to_message(model: BaseModel, message_type: type[MessageT]) -> MessageT:
    """The message of `message_type` with the values of `model`."""
    message = message_type()
    data = model.model_dump(mode="json", exclude_none=True)
    ParseDict(_to_wire(data, message.DESCRIPTOR), message)
    return message


def to_model(message: Message, model_type: type[ModelT]) -> ModelT:
    """The model of `model_type` with the values of `message`; ValidationError if they are invalid."""
    data = MessageToDict(message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True)
    return model_type.model_validate(_from_wire(data, message.DESCRIPTOR))


def tagged_union(descriptor: Descriptor) -> str | None:
    """The name of the tag if the message is nothing but one oneof."""
    oneofs = {field.containing_oneof for field in descriptor.fields}
    oneof = oneofs.pop() if len(oneofs) == 1 and len(descriptor.fields) > 1 else None
    return oneof.name if oneof is not None else None


def _to_wire(data: dict[str, Any], descriptor: Descriptor) -> dict[str, Any]:
    tag = tagged_union(descriptor)
    if tag is not None:
        data = {data[tag]: {name: value for name, value in data.items() if name != tag}}
    fields = descriptor.fields_by_name
    return {name: _each(value, fields[name], _to_wire, _enum_to_wire) for name, value in data.items()}


def _from_wire(data: dict[str, Any], descriptor: Descriptor) -> dict[str, Any]:
    fields = descriptor.fields_by_name
    values = {name: _each(value, fields[name], _from_wire, _enum_from_wire) for name, value in data.items()}
    values = {
        name: v for name, v in values.items() if v not in ([], {}) and not _unspecified(v, fields[name])
    }
    tag = tagged_union(descriptor)
    if tag is None or not values:
        return values
    [(kind, value)] = values.items()
    return {tag: kind, **value}


def _enum_to_wire(value: str, descriptor: Descriptor) -> str:
    name = value.upper()
    return name if name in descriptor.values_by_name else str(descriptor.values_by_number[0].name)


def _enum_from_wire(value: str | int, descriptor: Descriptor) -> str:
    return str(value).lower()  # JSON knows a value without a name by its number


def _each(value: Any, field: FieldDescriptor, of_message: _OfMessage, of_enum: _OfEnum) -> Any:
    """Convert one field's JSON value: item by item if repeated; maps and well-known types stay."""
    if field.enum_type is not None:
        convert: Callable[[Any], Any] = partial(of_enum, descriptor=field.enum_type)
    elif field.message_type is None:
        return _flat(value) if field.is_repeated else value
    elif _is_plain(field.message_type):
        return value
    else:
        convert = partial(of_message, descriptor=field.message_type)
    return [convert(item) for item in value] if isinstance(value, list) else convert(value)


def _flat(values: list[Any]) -> list[Any]:
    return list(chain.from_iterable(values)) if values and isinstance(values[0], list) else values


def _is_plain(descriptor: Descriptor) -> bool:
    return bool(descriptor.GetOptions().map_entry) or descriptor.full_name.startswith("google.protobuf.")


def _unspecified(value: Any, field: FieldDescriptor) -> bool:
    """Whether an enum was left out. One that the models require is told as it is."""
    if field.enum_type is None or not field.has_presence:
        return False
    return bool(value == field.enum_type.values_by_number[0].name.lower())
