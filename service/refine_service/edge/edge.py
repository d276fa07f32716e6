"""What both transports stand on: store, blobs, sign-in, metrics, and whether the process is stopping."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

import httpx

from refine_jobs.blobs import BlobStore
from refine_jobs.edge_store import JobStore
from refine_jobs.health import Health
from refine_jobs.redis_server import connect_async
from refine_jobs.settings import JobSettings
from refine_jobs.webhook_outbox import WebhookOutbox
from refine_proto.errors import Draining, RefineError, Unavailable
from refine_proto.models import Refinement, RefinementUrls

from ..settings import ServiceSettings
from .auth import ApiKeys, Auth, CallRate
from .outgoing import Outgoing
from .places import Places
from .prometheus import Metrics

COLLECTION = "/v1/refinements"
_RETRY_S = 5.0  # another replica, or this one restarted

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Edge:
    """One per process, made in its event loop."""

    settings: ServiceSettings
    store: JobStore
    outbox: WebhookOutbox
    outgoing: Outgoing
    blobs: BlobStore
    health: Health
    auth: Auth
    metrics: Metrics
    uploads: Places
    watchers: Places
    draining: asyncio.Future[None]  # done once the process is stopping

    async def refinement(self, owner: str, refinement_id: str) -> Refinement:
        """The owner's refinement as callers see it; raises NotFound and Expired."""
        return with_urls(await self.store.get(owner, refinement_id))

    def check_not_draining(self) -> None:
        """Raise Draining if the process takes nothing new."""
        if self.draining.done():
            raise Draining("this server is shutting down; send the request again", retry_after_s=_RETRY_S)

    async def not_ready(self) -> RefineError | None:
        """Why calls should go elsewhere, or None. Workers do not count: jobs wait for them."""
        try:
            self.check_not_draining()
        except Draining as error:
            return error
        try:
            await self.health.check_writable()
        except Exception as error:
            return _takes_no_writes("job", error)
        try:
            await asyncio.to_thread(self.blobs.check_writable)
        except Exception as error:
            return _takes_no_writes("blob", error)
        return None


@asynccontextmanager
async def open_edge(settings: ServiceSettings, jobs: JobSettings, redis_url: str) -> AsyncIterator[Edge]:
    """The edge of this process; closed at the end. Raises KeysFileInvalid."""
    keys = ApiKeys(settings.keys_path(jobs.data_folder))
    keys.refresh()
    redis = connect_async(redis_url)
    store = JobStore(redis, jobs)
    try:
        yield Edge(
            settings=settings,
            store=store,
            outbox=WebhookOutbox(redis),
            outgoing=Outgoing(settings.reachable_networks, httpx.create_ssl_context()),
            blobs=BlobStore(jobs.blob_location),
            health=Health(redis),
            auth=Auth(keys, CallRate(settings.requests_per_s), settings.key_required),
            metrics=Metrics(),
            uploads=Places("uploads", settings.max_uploads),
            watchers=Places("watchers", settings.max_watchers),
            draining=asyncio.get_running_loop().create_future(),
        )
    finally:
        await store.close()


def _takes_no_writes(store: str, error: Exception) -> Unavailable:
    """For anybody who asks; what the store itself says, with names and paths, is for the log."""
    log.warning("the %s store takes no writes: %s", store, error)
    return Unavailable(
        f"the {store} store takes no writes; the service's log says why", retry_after_s=_RETRY_S
    )


def with_urls(refinement: Refinement) -> Refinement:
    """With the paths of everything about it."""
    path = f"{COLLECTION}/{refinement.id}"
    artifacts = [
        artifact.model_copy(update={"url": f"{path}/artifacts/{artifact.name}"})
        for artifact in refinement.artifacts
    ]
    urls = RefinementUrls(refinement=path, events=f"{path}/events", cancel=f"{path}/cancel")
    return refinement.model_copy(update={"urls": urls, "artifacts": artifacts})
