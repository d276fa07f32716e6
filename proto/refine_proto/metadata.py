"""Metadata: pairs of text that callers write on their refinements; the server keeps and compares them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field, StringConstraints, WithJsonSchema
from typing_extensions import TypeAliasType  # of typing from Python 3.12 on

_MAX_PAIRS = 20
_MAX_VALUE = 512
_KEY = r"^[A-Za-z0-9_.-]{1,64}$"

Metadata = TypeAliasType(  # a name, under which OpenAPI has it
    "Metadata",
    Annotated[
        Mapping[
            Annotated[str, StringConstraints(pattern=_KEY)],
            Annotated[str, StringConstraints(max_length=_MAX_VALUE)],
        ],
        Field(max_length=_MAX_PAIRS),
        WithJsonSchema(  # pydantic's has patternProperties, of which generators of clients make nothing
            {
                "type": "object",
                "additionalProperties": {"type": "string", "maxLength": _MAX_VALUE},
                "propertyNames": {"pattern": _KEY},
                "maxProperties": _MAX_PAIRS,
            }
        ),
    ],
)
"""Up to 20 pairs; keys of 1 to 64 letters, digits and `_.-`, values of up to 512 characters."""
