"""`AsyncRefineClient`: `client.RefineClient` for asyncio, method by method."""

from __future__ import annotations

import asyncio
import os
import uuid
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import aclosing, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from refine_proto.errors import Busy, NotFound, RefineError
from refine_proto.lists import make_filter, make_lifetime
from refine_proto.models import (
    Artifact,
    CameraEstimate,
    CameraSpec,
    EstimatedCamera,
    Event,
    MeshFormat,
    Progress,
    Refinement,
    RefinementOptions,
    RefinementPage,
    State,
    Validation,
    Webhook,
)
from refine_proto.tracing import call_span

from .address import Connection
from .cases import Case, folder_of
from .errors import error_of
from .follow import Follow
from .partial_file import PartialFile, choose_artifacts
from .refined import AT_ONCE, PAGE, Refined, tell_nobody
from .retry import Retries, RetryPolicy
from .transports.base import make_async_transport
from .upload import Source, View, make_upload, to_estimate

T = TypeVar("T")


class AsyncRefineClient:
    """RefineClient for one event loop; arguments, results and errors are the same.

    Files are read and written in small portions on the loop's own thread.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        api_key: str | None = None,
        timeout_s: float = 30.0,
        retry: RetryPolicy | None = None,
    ) -> None:
        """See RefineClient."""
        self._connection = Connection.from_arguments(server, api_key, timeout_s)
        self._policy = retry or RetryPolicy()
        self._transport = make_async_transport(self._connection)

    async def submit(
        self,
        mesh: Source,
        silhouette: Source,
        camera: CameraSpec | Mapping[str, Any],
        options: RefinementOptions | Mapping[str, Any] | None = None,
        *,
        ignore: Source | None = None,
        views: Sequence[View] = (),
        mesh_format: MeshFormat | str | None = None,
        webhook: Webhook | Mapping[str, Any] | None = None,
        metadata: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
    ) -> Refinement:
        """See RefineClient.submit."""
        upload = make_upload(
            mesh, silhouette, camera, options, mesh_format, idempotency_key, ignore, views, webhook, metadata
        )
        with call_span("create refinement"):
            return await self._retried(lambda: self._transport.create(upload))

    async def validate(
        self,
        mesh: Source,
        silhouette: Source,
        camera: CameraSpec | Mapping[str, Any],
        options: RefinementOptions | Mapping[str, Any] | None = None,
        *,
        ignore: Source | None = None,
        views: Sequence[View] = (),
        mesh_format: MeshFormat | str | None = None,
    ) -> Validation:
        """See RefineClient.validate."""
        upload = make_upload(mesh, silhouette, camera, options, mesh_format, ignore=ignore, views=views)
        return await self._retried(lambda: self._transport.validate(upload))

    async def estimate_camera(
        self,
        mesh: Source,
        silhouette: Source,
        camera: EstimatedCamera | Mapping[str, Any] | None = None,
        options: RefinementOptions | Mapping[str, Any] | None = None,
        *,
        ignore: Source | None = None,
        mesh_format: MeshFormat | str | None = None,
    ) -> CameraEstimate:
        """See RefineClient.estimate_camera."""
        upload = make_upload(mesh, silhouette, to_estimate(camera), options, mesh_format, ignore=ignore)
        return await self._retried(lambda: self._transport.estimate_camera(upload))

    async def get(self, refinement_id: str) -> Refinement:
        """See RefineClient.get."""
        return await self._retried(lambda: self._transport.get(refinement_id))

    async def list(
        self,
        *,
        limit: int | None = None,
        cursor: str | None = None,
        state: Sequence[State | str] = (),
        metadata: Mapping[str, str] | None = None,
    ) -> RefinementPage:
        """See RefineClient.list."""
        wanted = make_filter(state, metadata)
        return await self._retried(lambda: self._transport.list(limit, cursor, wanted))

    async def list_all(
        self, *, state: Sequence[State | str] = (), metadata: Mapping[str, str] | None = None
    ) -> AsyncGenerator[Refinement, None]:
        """See RefineClient.list_all."""
        cursor: str | None = None
        while True:
            page = await self.list(limit=PAGE, cursor=cursor, state=state, metadata=metadata)
            for refinement in page.refinements:
                yield refinement
            if (cursor := page.next_cursor) is None:
                return

    async def extend(self, refinement_id: str, lifetime_s: float) -> Refinement:
        """See RefineClient.extend."""
        lifetime = make_lifetime(lifetime_s)
        return await self._retried(lambda: self._transport.extend(refinement_id, lifetime))

    async def cancel(self, refinement_id: str) -> Refinement:
        """See RefineClient.cancel."""
        return await self._retried(lambda: self._transport.cancel(refinement_id))

    async def delete(self, refinement_id: str) -> None:
        """See RefineClient.delete."""
        retries = Retries(self._policy)
        while True:
            try:
                return await self._transport.delete(refinement_id)
            except Busy as error:
                await asyncio.sleep(retries.delay_s(error))
            except NotFound:
                if retries.count == 0:
                    raise
                return None  # the try before did it, and only its answer was lost

    async def watch(
        self, refinement_id: str, *, after_sequence: int = 0, timeout_s: float | None = None
    ) -> AsyncGenerator[Event, None]:
        """See RefineClient.watch; leave the loop early only inside `contextlib.aclosing`."""
        follow = Follow(refinement_id, after_sequence, timeout_s, self._policy)
        while not follow.done:
            longest_s = follow.longest_s()
            try:
                async with aclosing(
                    self._transport.events(refinement_id, follow.sequence, longest_s)
                ) as events:
                    async for event in events:
                        if follow.accept(event):
                            yield event
            except Busy as error:
                await asyncio.sleep(follow.delay_s(error))

    async def wait(self, refinement_id: str, *, timeout_s: float | None = None) -> Refinement:
        """See RefineClient.wait."""
        async with aclosing(self.watch(refinement_id, timeout_s=timeout_s)) as events:
            async for event in events:
                if event.refinement is not None:
                    return event.refinement
        return await self.get(refinement_id)

    async def download(
        self, refinement_id: str, directory: str | os.PathLike[str], names: Iterable[str] | None = None
    ) -> dict[str, Path]:
        """See RefineClient.download."""
        artifacts = choose_artifacts(await self.get(refinement_id), names)
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        return {artifact.name: await self._fetch(refinement_id, artifact, folder) for artifact in artifacts}

    async def refine(
        self,
        mesh: Source,
        silhouette: Source,
        camera: CameraSpec | Mapping[str, Any],
        directory: str | os.PathLike[str],
        options: RefinementOptions | Mapping[str, Any] | None = None,
        *,
        ignore: Source | None = None,
        views: Sequence[View] = (),
        mesh_format: MeshFormat | str | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> Refined:
        """See RefineClient.refine; cancelling the task cancels the refinement."""
        Path(directory).mkdir(parents=True, exist_ok=True)
        refinement = await self.submit(
            mesh, silhouette, camera, options, ignore=ignore, views=views, mesh_format=mesh_format
        )

        def tell(event: Event) -> None:
            if event.progress is not None and progress is not None:
                progress(event.progress)

        return await self._see_through(refinement, directory, tell)

    async def submit_many(
        self, cases: Iterable[Case], *, idempotency_key: str | None = None
    ) -> Sequence[Refinement | RefineError | OSError]:
        """See RefineClient.submit_many."""
        key = idempotency_key or str(uuid.uuid4())
        sent: list[Refinement | RefineError | OSError] = []
        for number, case in enumerate(cases, 1):
            try:
                sent.append(await self.submit(**case.arguments(), idempotency_key=f"{key}/{number}"))
            except (RefineError, OSError) as error:
                sent.append(error)
        return sent

    async def refine_many(
        self,
        cases: Iterable[Case],
        directory: str | os.PathLike[str],
        *,
        idempotency_key: str | None = None,
        at_once: int = AT_ONCE,
        progress: Callable[[int, Event], None] | None = None,
    ) -> Sequence[Refined | RefineError | OSError]:
        """See RefineClient.refine_many; `progress` is called in the loop."""
        key = idempotency_key or str(uuid.uuid4())
        free = asyncio.Semaphore(at_once)

        async def one(number: int, case: Case) -> Refined | RefineError | OSError:
            tell = partial(progress, number) if progress is not None else tell_nobody
            async with free:
                try:
                    refinement = await self.submit(**case.arguments(), idempotency_key=f"{key}/{number}")
                    return await self._see_through(refinement, folder_of(Path(directory), number), tell)
                except (RefineError, OSError) as error:
                    return error

        Path(directory).mkdir(parents=True, exist_ok=True)
        calls = [asyncio.create_task(one(number, case)) for number, case in enumerate(cases, 1)]
        try:
            return await asyncio.gather(*calls)
        except BaseException:
            for call in calls:
                call.cancel()
            await asyncio.gather(*calls, return_exceptions=True)
            raise

    async def close(self) -> None:
        """Close the connections."""
        await self._transport.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._connection.server!r})"

    async def _see_through(
        self, refinement: Refinement, directory: str | os.PathLike[str], tell: Callable[[Event], None]
    ) -> Refined:
        """See RefineClient._see_through."""
        try:
            async with aclosing(self.watch(refinement.id)) as events:
                async for event in events:
                    tell(event)
                    refinement = event.refinement or refinement
        except BaseException:
            with suppress(RefineError):
                await self._transport.cancel(refinement.id)
            raise
        if error := error_of(refinement):
            raise error
        return Refined(refinement, await self.download(refinement.id, directory))

    async def _retried(self, attempt: Callable[[], Awaitable[T]]) -> T:
        retries = Retries(self._policy)
        while True:
            try:
                return await attempt()
            except Busy as error:
                await asyncio.sleep(retries.delay_s(error))

    async def _fetch(self, refinement_id: str, artifact: Artifact, directory: Path) -> Path:
        retries = Retries(self._policy)
        with PartialFile(artifact, directory) as file:
            while True:
                try:
                    if not file.complete:
                        async with aclosing(
                            self._transport.download(refinement_id, artifact, file.offset)
                        ) as chunks:
                            async for chunk in chunks:
                                file.write(chunk)
                    return file.finish()
                except Busy as error:
                    await asyncio.sleep(retries.delay_s(error))
