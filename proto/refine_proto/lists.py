"""What callers write on their refinements, and by what they find them again in a list."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import Field, ValidationError, field_validator

from .errors import from_validation
from .metadata import Metadata
from .models import Refinement, State
from .strict import Input, Positive, short


class RefinementFilter(Input):
    """Which refinements a list shows; by default all of them."""

    state: tuple[State, ...] = Field((), description="Those that are in one of these states.")
    metadata: Metadata = Field({}, description="Those that have all of these pairs.")

    @field_validator("state", mode="before")
    @classmethod
    def _known(cls, value: Any) -> Any:
        states = (value,) if isinstance(value, str) else tuple(value)
        for state in states:
            if state not in list(State):
                raise ValueError(f"expected one of {', '.join(State)}, got {short(state)}")
        return states

    @property
    def takes_all(self) -> bool:
        """Whether it leaves nothing out."""
        return self == type(self)()

    def takes(self, refinement: Refinement) -> bool:
        """Whether the list shows it."""
        in_state = not self.state or refinement.state in self.state
        return in_state and self.metadata.items() <= refinement.metadata.items()


class Lifetime(Input):
    """The body of `PATCH /v1/refinements/{id}`."""

    lifetime_s: Positive = Field(description="How long, from now on, record and bytes are kept.")


def make_filter(state: Iterable[str], metadata: Mapping[str, str] | None) -> RefinementFilter:
    """Checked; raises InvalidInput."""
    try:
        return RefinementFilter.model_validate({"state": state, "metadata": metadata or {}})
    except ValidationError as error:
        raise from_validation(error.errors()) from None


def make_lifetime(lifetime_s: float) -> Lifetime:
    """Checked; raises InvalidInput."""
    try:
        return Lifetime(lifetime_s=lifetime_s)
    except ValidationError as error:
        raise from_validation(error.errors()) from None


def read_pairs(texts: Iterable[str]) -> dict[str, str]:
    """KEY=VALUE, as query parameters and command lines have metadata; raises InvalidInput."""
    pairs: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise from_validation([{"loc": ("metadata",), "msg": f"expected KEY=VALUE, got {short(text)}"}])
        pairs[key] = value
    return pairs
