"""The message of a webhook and its signature, as Standard Webhooks 1.0 says (standardwebhooks.com).

Headers: `webhook-id`, the same for every attempt; `webhook-timestamp`, seconds since 1970 of this attempt;
`webhook-signature`, for each secret of the owner `v1,` and the base64 of HMAC-SHA256 of `id.timestamp.body`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import secrets
import time
from collections.abc import Iterable, Mapping
from datetime import datetime

from pydantic import Field, ValidationError

from .models import Output, Refinement

SECRET_PREFIX = "whsec_"
TOLERANCE_S = 300.0
_SECRET_BYTES = 32


class WebhookMessage(Output):
    """The body of the POST."""

    type: str = Field(description="refinement.succeeded, refinement.failed or refinement.cancelled.")
    timestamp: datetime = Field(description="When it ended.")
    data: Refinement = Field(description="As it was at its end.")


class WebhookInvalid(ValueError):
    """A request that is no webhook of ours: do not act on it."""


def new_secret() -> str:
    """A signing secret of 256 random bits."""
    return SECRET_PREFIX + base64.b64encode(secrets.token_bytes(_SECRET_BYTES)).decode()


def signed_headers(
    message_id: str, body: bytes, keys: Iterable[str], now_s: float | None = None
) -> dict[str, str]:
    """The headers of one attempt; `keys` are the secrets that sign, newest first."""
    timestamp = str(int(time.time() if now_s is None else now_s))
    return {
        "webhook-id": message_id,
        "webhook-timestamp": timestamp,
        "webhook-signature": " ".join(f"v1,{_signature(key, message_id, timestamp, body)}" for key in keys),
    }


def verify_webhook(
    body: bytes,
    headers: Mapping[str, str],
    secret: str,
    *,
    tolerance_s: float = TOLERANCE_S,
    now_s: float | None = None,
) -> WebhookMessage:
    """The message, if it was signed with `secret` and at most `tolerance_s` ago.

    Args:
        body: The bytes as they came: parsed and written again they have another signature.
        headers: Of the request; the case of their names does not matter.
        secret: whsec_...; the server's operator hands it out.
        tolerance_s: How far the clocks may differ; older messages may have been recorded and sent again.
        now_s: Seconds since 1970. Default: the clock.

    Raises:
        WebhookInvalid: It is not authentic, too old, or no message.
    """
    sent = {name.lower(): value for name, value in headers.items()}
    missing = [n for n in ("webhook-id", "webhook-timestamp", "webhook-signature") if not sent.get(n)]
    if missing:
        raise WebhookInvalid(f"expected the header {missing[0]}, got none; is this a webhook of REFINE?")
    message_id, timestamp = sent["webhook-id"], sent["webhook-timestamp"]
    wanted = f"v1,{_signature(secret, message_id, timestamp, body)}".encode()
    given = sent["webhook-signature"].encode()
    if not any(hmac.compare_digest(wanted, signature) for signature in given.split()):
        raise WebhookInvalid("expected a signature by this secret, got others; is it the newest secret?")
    now_s = time.time() if now_s is None else now_s
    if not timestamp.isdecimal() or abs(now_s - int(timestamp)) > tolerance_s:
        raise WebhookInvalid(
            f"expected a message of the last {tolerance_s:g} s, got the timestamp {timestamp:.40}"
        )
    try:
        return WebhookMessage.model_validate_json(body)
    except ValidationError as error:
        raise WebhookInvalid(f"expected a message of a webhook: {error.errors()[0]['msg']}") from None


def _signature(secret: str, message_id: str, timestamp: str, body: bytes) -> str:
    try:
        key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except (binascii.Error, ValueError):
        raise ValueError(f"expected a secret like {SECRET_PREFIX}..., got another text") from None
    content = f"{message_id}.{timestamp}.".encode() + body
    return base64.b64encode(hmac.digest(key, content, hashlib.sha256)).decode()
