"""Webhooks: what a caller asks for, and what a Refinement tells of their delivery.

What is sent, and how it is signed, is in webhook_messages.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from enum import StrEnum
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import AfterValidator, BaseModel, Field, TypeAdapter

from .strict import Input, short


def check_url(url: str) -> str:
    """The address, if it is http or https with a host and without a user; ValueError."""
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and parts.hostname and "@" not in parts.netloc
        usable = usable and (parts.port is None or parts.port > 0)
    except ValueError:
        usable = False
    if not usable or not url.isascii() or not url.isprintable() or " " in url:
        raise ValueError(f"expected an address like https://example.com/a, without a user, got {short(url)}")
    return url


Url = Annotated[str, Field(max_length=2048), AfterValidator(check_url)]
URL: TypeAdapter[str] = TypeAdapter(Url)


class WebhookEvent(StrEnum):
    """The ends of a refinement that a webhook may tell."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


class Webhook(Input):
    """Where the server tells that the refinement has ended, so that nobody has to ask."""

    url: Url = Field(description="https address that gets a POST.")
    events: Sequence[WebhookEvent] = Field(
        tuple(WebhookEvent), min_length=1, description="Which ends are told; all unless said otherwise."
    )


class WebhookDelivery(BaseModel, frozen=True, extra="ignore"):
    """One attempt to deliver the webhook."""

    attempt: int = Field(description="Counts up from 1.")
    time: datetime
    status: int | None = Field(None, description="HTTP status of the answer; unset: there was none.")
    error: str | None = Field(None, description="Why it was not delivered; unset: it was.")
    next_attempt_at: datetime | None = Field(None, description="Unset: there will be none.")
