"""WebhookOutbox: webhooks that wait for delivery. `end_job` of lua/ writes them with the terminal state.

Any number of services deliver from it: who takes a webhook has it alone for a while, and who has lost it
since writes nothing. One that dies meanwhile leaves it to the next: it may come twice, but is not lost.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict
from redis.asyncio import Redis

from refine_proto.models import State, WebhookDelivery

from .record import pairs, to_json
from .redis_server import unavailable
from .scripts import Clock, Scripts


class PendingWebhook(BaseModel):
    """A webhook that has been taken for its `attempt`, counted from 1."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    id: str  # of the refinement
    owner: str
    url: str
    state: State
    ended_ms: int
    attempt: int
    body: str | None = None  # what earlier attempts sent


class WebhookOutbox:
    """All that services do with webhooks. Raises Unavailable when Redis is away."""

    def __init__(self, redis: Redis, clock: Clock | None = None) -> None:
        self._scripts = Scripts(redis, clock)

    @unavailable
    async def take(self, lease_s: float) -> PendingWebhook | None:
        """The webhook that has been due longest, if any is; nobody else gets it for `lease_s`."""
        fields: list[Any] | None = await self._scripts.run("take_webhook", int(lease_s * 1000))
        return PendingWebhook.model_validate(pairs(fields)) if fields else None

    @unavailable
    async def settle(
        self, webhook: PendingWebhook, delivery: WebhookDelivery, retry_s: float | None, body: str
    ) -> bool:
        """Write down the attempt; the next one is in `retry_s`, or there is none.

        False, and nothing is written: the refinement was deleted, or the attempt took so long that another
        service has the webhook.
        """
        retry_ms = "" if retry_s is None else int(retry_s * 1000)
        settled = await self._scripts.run(
            "settle_webhook", webhook.id, webhook.attempt, to_json(delivery), retry_ms, body
        )
        return bool(settled)
