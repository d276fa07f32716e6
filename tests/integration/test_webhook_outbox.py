"""The outbox of webhooks on a real Redis: who has one, for how long, and what a latecomer may write."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from refine_jobs import keys
from refine_jobs.edge_store import JobStore
from refine_jobs.redis_server import connect_async
from refine_jobs.webhook_outbox import WebhookOutbox
from refine_proto.models import RefinementSpec, State, WebhookDelivery

if TYPE_CHECKING:
    from .conftest import HandClock, Jobs

SPEC = RefinementSpec.model_validate(
    {
        "camera": {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 1.9},
        "webhook": {"url": "https://example.com/hook", "events": ["cancelled"]},
    }
)
FAILED = WebhookDelivery(attempt=1, time=datetime(2026, 3, 1, tzinfo=UTC), status=500, error="e")
DELIVERED = WebhookDelivery(attempt=2, time=datetime(2026, 3, 1, tzinfo=UTC), status=204)


@asynccontextmanager
async def ended(jobs: Jobs, clock: HandClock) -> AsyncIterator[tuple[JobStore, WebhookOutbox, str]]:
    """A cancelled job with a webhook."""
    redis = connect_async(jobs.url)
    async with jobs.with_clock(clock).edge() as store:
        job_id = (await jobs.with_clock(clock).submit(store, spec=SPEC)).refinement.id
        await store.cancel("ann", job_id)
        yield store, WebhookOutbox(redis, clock), job_id
    await redis.aclose()


def test_one_has_it_until_the_lease_is_over(jobs: Jobs, clock: HandClock) -> None:
    async def check() -> None:
        async with ended(jobs, clock) as (_, outbox, job_id):
            first = await outbox.take(60)
            assert first is not None
            assert (first.id, first.owner, first.state, first.attempt) == (job_id, "ann", State.CANCELLED, 1)
            assert (first.url, first.ended_ms, first.body) == ("https://example.com/hook", clock(), None)
            clock.move(59)
            assert await outbox.take(60) is None
            clock.move(2)
            second = await outbox.take(60)
            assert second is not None
            assert second.attempt == 2
            assert not await outbox.settle(first, DELIVERED, None, "late")  # it went on without this one
            assert await outbox.settle(second, FAILED, 5, "body")
            clock.move(4)
            assert await outbox.take(60) is None
            clock.move(2)
            third = await outbox.take(60)
            assert third is not None
            assert (third.attempt, third.body) == (3, "body")

    asyncio.run(check())


def test_the_record_lists_the_attempts(jobs: Jobs, clock: HandClock) -> None:
    async def check() -> None:
        async with ended(jobs, clock) as (store, outbox, job_id):
            for delivery, retry_s in ((FAILED, 0.0), (DELIVERED, None)):
                webhook = await outbox.take(60)
                assert webhook is not None
                await outbox.settle(webhook, delivery, retry_s, "body")
            assert (await store.get("ann", job_id)).webhook_deliveries == [FAILED, DELIVERED]
            assert await outbox.take(60) is None
            assert not jobs.redis.exists(keys.OUTBOX, keys.WEBHOOK + job_id)

    asyncio.run(check())


def test_a_deleted_one_is_not_written_again(jobs: Jobs, clock: HandClock) -> None:
    async def check() -> None:
        async with ended(jobs, clock) as (store, outbox, job_id):
            webhook = await outbox.take(60)
            assert webhook is not None
            await store.delete("ann", job_id)
            assert not await outbox.settle(webhook, FAILED, 5, "body")
            assert not jobs.redis.exists(keys.OUTBOX, keys.WEBHOOK + job_id, keys.JOB + job_id)

    asyncio.run(check())
