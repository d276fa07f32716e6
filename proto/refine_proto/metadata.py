"""Metadata: pairs of text that callers write on their refinements; the server keeps and compares them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field, StringConstraints

_MAX_PAIRS = 20

Metadata = Annotated[
    Mapping[
        Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]{1,64}$")],
        Annotated[str, StringConstraints(max_length=512)],
    ],
    Field(max_length=_MAX_PAIRS),
]
"""Up to 20 pairs; keys of 1 to 64 letters, digits and `_.-`, values of up to 512 characters."""
