"""Signatures of webhooks, against the published example of Standard Webhooks."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from refine_client import WebhookInvalid, verify_webhook
from refine_proto.models import Refinement, RefinementOptions, State, Webhook
from refine_proto.webhook_messages import WebhookMessage, new_secret, signed_headers

NOW_S = 1_800_000_000.0
TIME = datetime(2026, 3, 1, tzinfo=UTC)
MESSAGE = WebhookMessage(
    type="refinement.succeeded",
    timestamp=TIME,
    data=Refinement(
        id="x", state=State.SUCCEEDED, options=RefinementOptions(), created_at=TIME, expires_at=TIME
    ),
)
BODY = MESSAGE.model_dump_json().encode()


def test_the_published_example_has_the_published_signature() -> None:
    headers = signed_headers(
        "msg_p5jXN8AQM9LWM0D4loKWxJek",
        b'{"test": 2432232314}',
        ["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"],
        1_614_265_330,
    )
    assert headers["webhook-signature"] == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


def test_a_message_is_read_with_either_of_two_secrets() -> None:
    old, new = new_secret(), new_secret()
    headers = signed_headers("x", BODY, [new, old], NOW_S)
    for secret in (old, new):
        assert verify_webhook(BODY, headers, secret, now_s=NOW_S + 299) == MESSAGE
    upper = {name.upper(): value for name, value in headers.items()}
    assert verify_webhook(BODY, upper, new, now_s=NOW_S) == MESSAGE


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"webhook-signature": ""}, "header webhook-signature"),
        ({"webhook-signature": "v1,AAAA v1a,BBBB"}, "by this secret"),
        ({"webhook-signature": "ünlesbar"}, "by this secret"),
        ({"webhook-id": "y"}, "by this secret"),
        ({"webhook-timestamp": "1800000001"}, "by this secret"),
    ],
)
def test_what_was_changed_is_refused(changed: dict[str, str], says: str) -> None:
    secret = new_secret()
    headers = signed_headers("x", BODY, [secret], NOW_S) | changed
    with pytest.raises(WebhookInvalid, match=says):
        verify_webhook(BODY, headers, secret, now_s=NOW_S)


def test_another_body_another_time_and_no_message_are_refused() -> None:
    secret = new_secret()
    headers = signed_headers("x", BODY, [secret], NOW_S)
    with pytest.raises(WebhookInvalid, match="by this secret"):
        verify_webhook(BODY + b" ", headers, secret, now_s=NOW_S)
    for now_s in (NOW_S + 301, NOW_S - 301):
        with pytest.raises(WebhookInvalid, match="last 300 s"):
            verify_webhook(BODY, headers, secret, now_s=now_s)
    with pytest.raises(WebhookInvalid, match="message of a webhook"):
        verify_webhook(b"{}", signed_headers("x", b"{}", [secret], NOW_S), secret, now_s=NOW_S)
    with pytest.raises(ValueError, match="whsec_"):
        verify_webhook(BODY, headers, "no secret")


@pytest.mark.parametrize(
    "url",
    ["", "example.com/hook", "ftp://example.com", "https://", "https://ann:pw@example.com", "https://a b",
     "https://example.com:0", "https://example.com:x", "https://exämple.com", "https://[::1"],
)  # fmt: skip
def test_what_is_no_address_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="expected an address"):
        Webhook(url=url)
