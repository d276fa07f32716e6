"""Enumerations to which a newer version may add: a value that this one does not list reads as itself."""

from __future__ import annotations

from enum import StrEnum
from typing import Self, TypeVar

EnumT = TypeVar("EnumT", bound=StrEnum)


def of_newer_version(kind: type[EnumT], value: str) -> EnumT:
    """The member of this value; for a value that is not listed, one of its own that is no member."""
    if value in list(kind):
        return kind(value)
    member = str.__new__(kind, value)
    member._name_, member._value_ = value.upper(), value
    return member


class OpenEnum(StrEnum):
    """Takes any text. Members are the same objects as ever; another value equals its text."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        return of_newer_version(cls, value) if isinstance(value, str) else None
