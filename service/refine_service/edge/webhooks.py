"""Webhooks are delivered: taken from the outbox, signed, sent, and tried again for three days.

Every service process runs `deliver_webhooks`; the outbox sees to it that no two send the same at a time.
"""

from __future__ import annotations

import asyncio
import logging
import random
from datetime import UTC, datetime, timedelta

import httpx

from refine_jobs.record import instant
from refine_jobs.webhook_outbox import PendingWebhook
from refine_proto.errors import Expired, InvalidInput, NotFound, Unavailable
from refine_proto.models import FieldError, RefinementSpec, WebhookDelivery
from refine_proto.webhook_messages import WebhookMessage, signed_headers

from .edge import Edge
from .outgoing import AddressRefused

# After each attempt, as Standard Webhooks advises: 75 hours in all.
RETRY_S = (5, 300, 1_800, 7_200, 18_000, 36_000, 50_400, 72_000, 86_400)
_JITTER = 0.1  # of the delay, so that what failed together does not come back together
_TIMEOUT_S = 15.0  # of one attempt
_LEASE_S = 60  # longer than an attempt, or two services would send the same at a time
_AT_ONCE = 32  # attempts of one process
_LOOK_S = 0.5
_GONE = 410  # the receiver wants nothing more of it

log = logging.getLogger(__name__)


def check_webhook(edge: Edge, owner: str, spec: RefinementSpec) -> None:
    """Raise InvalidInput if the webhook of the spec could not be signed."""
    if spec.webhook is not None and not edge.auth.webhook_secrets(owner):
        detail = (
            f"expected an owner with a webhook secret, got {owner}, who has none; ask the operator to run "
            f"`refine keys webhook-secret {owner}`"
        )
        raise InvalidInput(detail, errors=[FieldError(pointer="/webhook", detail=detail)])


async def deliver_webhooks(edge: Edge) -> None:
    """Deliver what is due until the process drains; attempts that run then are finished."""
    async with asyncio.TaskGroup() as attempts:
        free = asyncio.Semaphore(_AT_ONCE)
        while True:
            await free.acquire()
            if edge.draining.done():
                return
            webhook = await _take(edge)
            if webhook is not None:
                attempts.create_task(_attempt(edge, webhook)).add_done_callback(lambda _: free.release())
            else:
                free.release()
                await asyncio.wait({edge.draining}, timeout=_LOOK_S)


async def _take(edge: Edge) -> PendingWebhook | None:
    try:
        return await edge.outbox.take(_LEASE_S)
    except Unavailable:
        return None
    except Exception:
        log.exception("the outbox of webhooks cannot be read")
        return None


async def _attempt(edge: Edge, webhook: PendingWebhook) -> None:
    """One attempt. What goes wrong with it is logged, and the lease brings the webhook back."""
    try:
        body, status, error = await _tell(edge, webhook)
        given_up = body is None or error is None or status == _GONE
        retry_s = None if given_up else _retry_s(webhook.attempt)
        now = datetime.now(UTC)
        delivery = WebhookDelivery(
            attempt=webhook.attempt,
            time=now,
            status=status,
            error=error,
            next_attempt_at=now + timedelta(seconds=retry_s) if retry_s is not None else None,
        )
        await edge.outbox.settle(webhook, delivery, retry_s, body or "")
        level = logging.INFO if error is None else logging.WARNING
        log.log(level, "webhook of %s: attempt %s: %s", webhook.id, webhook.attempt, error or status)
    except Unavailable:
        log.warning("webhook of %s: the job store does not answer", webhook.id)
    except Exception:
        log.exception("webhook of %s: attempt %s", webhook.id, webhook.attempt)


async def _tell(edge: Edge, webhook: PendingWebhook) -> tuple[str | None, int | None, str | None]:
    """The message, None if there is none left to tell; the status of the answer; why it was not delivered."""
    body = webhook.body
    try:
        body = body or await _body(edge, webhook)
        if body is None:
            return None, None, "the refinement is gone"
        return body, *await _send(edge, webhook, body)
    except Unavailable:
        raise
    except Exception:  # of ours: it may be gone with the next version, so it counts as any other failure
        log.exception("webhook of %s: attempt %s", webhook.id, webhook.attempt)
        return body or "", None, "expected to send it, got an error of the server; its log says more"


async def _body(edge: Edge, webhook: PendingWebhook) -> str | None:
    """The message, the same for every attempt; None if the refinement is gone and was never told."""
    try:
        refinement = await edge.refinement(webhook.owner, webhook.id)
    except (NotFound, Expired):
        return None
    message = WebhookMessage(
        type=f"refinement.{webhook.state}",
        timestamp=instant(webhook.ended_ms),
        data=refinement.model_copy(update={"webhook_deliveries": []}),
    )
    return message.model_dump_json(exclude_none=True)


async def _send(edge: Edge, webhook: PendingWebhook, body: str) -> tuple[int | None, str | None]:
    """The status of the answer, if there was one, and why the webhook counts as not delivered."""
    secrets = edge.auth.webhook_secrets(webhook.owner)
    if not secrets:
        return None, f"expected a webhook secret of {webhook.owner}, got none"
    content = body.encode()
    headers = {
        **signed_headers(webhook.id, content, secrets),
        "Content-Type": "application/json",
        "User-Agent": "refine-webhooks",
    }
    try:
        async with (
            asyncio.timeout(_TIMEOUT_S),
            edge.outgoing.request("POST", webhook.url, _TIMEOUT_S, headers, content) as response,
        ):
            return response.status_code, _complaint(response)
    except AddressRefused as error:
        return None, str(error)
    except (TimeoutError, httpx.TimeoutException):
        return None, f"expected an answer within {_TIMEOUT_S:g} s, got none"
    except (OSError, httpx.HTTPError, httpx.InvalidURL) as error:
        return None, f"expected an answer, got none ({type(error).__name__})"


def _complaint(response: httpx.Response) -> str | None:
    if response.is_success:
        return None
    if response.is_redirect:
        return f"expected a status from 200 to 299, got the redirect {response.status_code}, not followed"
    return f"expected a status from 200 to 299, got {response.status_code}"


def _retry_s(attempt: int) -> float | None:
    """How long after this attempt the next one is; None after the last."""
    if attempt > len(RETRY_S):
        return None
    return RETRY_S[attempt - 1] * random.uniform(1 - _JITTER, 1 + _JITTER)
