"""Webhooks: what a caller asks for, and what a Refinement tells of their delivery.

What is sent, and how it is signed, is in webhook_messages.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from enum import StrEnum
from urllib.parse import urlsplit

from pydantic import BaseModel, Field, field_validator

from .strict import Input, short

_MAX_URL = 2048


class WebhookEvent(StrEnum):
    """The ends of a refinement that a webhook may tell."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


class Webhook(Input):
    """Where the server tells that the refinement has ended, so that nobody has to ask."""

    url: str = Field(max_length=_MAX_URL, description="https address that gets a POST.")
    events: Sequence[WebhookEvent] = Field(
        tuple(WebhookEvent), min_length=1, description="Which ends are told; all unless said otherwise."
    )

    @field_validator("url")
    @classmethod
    def _can_be_called(cls, url: str) -> str:
        check_url(url)
        return url


class WebhookDelivery(BaseModel, frozen=True, extra="ignore"):
    """One attempt to deliver the webhook."""

    attempt: int = Field(description="Counts up from 1.")
    time: datetime
    status: int | None = Field(None, description="HTTP status of the answer; unset: there was none.")
    error: str | None = Field(None, description="Why it was not delivered; unset: it was.")
    next_attempt_at: datetime | None = Field(None, description="Unset: there will be none.")


def check_url(url: str) -> None:
    """ValueError unless it is an http or https address with a host and without a user."""
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and parts.hostname and "@" not in parts.netloc
        usable = usable and (parts.port is None or parts.port > 0)
    except ValueError:
        usable = False
    if not usable or not url.isascii() or not url.isprintable() or " " in url:
        raise ValueError(
            f"expected an address like https://example.com/hook, without a user, got {short(url)}"
        )
