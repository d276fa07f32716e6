"""`RefineClient`: the service for programs with threads. `aio` has the same for asyncio."""

from __future__ import annotations

import os
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import closing, suppress
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
from .transports.base import make_transport
from .upload import Source, View, make_upload, to_estimate

T = TypeVar("T")


class RefineClient:
    """Refines meshes through a server. Safe to share between threads; close it, or use it in a `with`.

    Every method raises the errors of `refine_proto.errors`: the server's own, with its `reason`, `request_id`
    and, in `errors`, pointers to fields; ConnectionLost where there was no answer. `Busy` ones are retried.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        api_key: str | None = None,
        timeout_s: float = 30.0,
        retry: RetryPolicy | None = None,
    ) -> None:
        """Nothing is sent yet.

        Args:
            server: http://host:8000 or https://host for REST, grpc://host:50051 or grpcs://host:443 for gRPC
                (the s: over TLS). Default: REFINE_SERVER, else http://127.0.0.1:8000.
            api_key: Default: REFINE_API_KEY, else none.
            timeout_s: For an answer. Transfers may take longer while bytes flow.
            retry: How often and how soon to try again.
        """
        self._connection = Connection.from_arguments(server, api_key, timeout_s)
        self._policy = retry or RetryPolicy()
        self._transport = make_transport(self._connection)

    def submit(
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
        """Send a refinement and return it as soon as it is queued.

        Args:
            mesh: Path or content of a GLB, glTF, OBJ, PLY (also of points), STL, OFF, binvox or NPZ file,
                or of a ZIP of one.
            silhouette: Path or content of a PNG, JPEG, WebP, TIFF or BMP: alpha, or white on black.
            camera: The camera of the silhouette: a LookAtCamera, a MatrixCamera or the same as a mapping.
            options: RefinementOptions or a mapping; what is left out has its default.
            ignore: An image of the silhouette's size: where it shows an object, nothing is known.
            views: Further views of the same object.
            mesh_format: Default: the suffix of the path, else the server recognises the content.
            webhook: A Webhook or a mapping with the `url` that is told of the end; there, `verify_webhook`
                reads what comes.
            metadata: Up to 20 pairs of text, to find it again.
            idempotency_key: Sending the same key and content again gives the first refinement again. Default:
                a new one, which the retries of this call share.

        Raises:
            OSError: A file cannot be read.
        """
        upload = make_upload(
            mesh, silhouette, camera, options, mesh_format, idempotency_key, ignore, views, webhook, metadata
        )
        with call_span("create refinement"):
            return self._retried(lambda: self._transport.create(upload))

    def validate(
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
        """Say what looks wrong, and whether `submit` would refine it, without a refinement.

        The arguments are those of `submit`. Raises what a refinement of files that cannot be read fails with,
        and Unavailable if no worker slot has time to answer.
        """
        upload = make_upload(mesh, silhouette, camera, options, mesh_format, ignore=ignore, views=views)
        return self._retried(lambda: self._transport.validate(upload))

    def estimate_camera(
        self,
        mesh: Source,
        silhouette: Source,
        camera: EstimatedCamera | Mapping[str, Any] | None = None,
        options: RefinementOptions | Mapping[str, Any] | None = None,
        *,
        ignore: Source | None = None,
        mesh_format: MeshFormat | str | None = None,
    ) -> CameraEstimate:
        """Say where the camera may be that saw the silhouette, and which other cameras fit.

        Args:
            mesh, silhouette, options, ignore, mesh_format: As for `submit`.
            camera: What is known of it. Default: nothing.

        Raises as `validate` does.
        """
        upload = make_upload(mesh, silhouette, to_estimate(camera), options, mesh_format, ignore=ignore)
        return self._retried(lambda: self._transport.estimate_camera(upload))

    def get(self, refinement_id: str) -> Refinement:
        """The refinement as it is now."""
        return self._retried(lambda: self._transport.get(refinement_id))

    def list(
        self,
        *,
        limit: int | None = None,
        cursor: str | None = None,
        state: Sequence[State | str] = (),
        metadata: Mapping[str, str] | None = None,
    ) -> RefinementPage:
        """A page of the caller's refinements, newest first; pass its `next_cursor` for the next page.

        `state` and `metadata` leave out what is in none of these states, or has not all of these pairs; a
        page may then be short, even empty, before the last one.
        """
        wanted = make_filter(state, metadata)
        return self._retried(lambda: self._transport.list(limit, cursor, wanted))

    def list_all(
        self, *, state: Sequence[State | str] = (), metadata: Mapping[str, str] | None = None
    ) -> Iterator[Refinement]:
        """As list, over all pages; they are asked for as they are needed."""
        cursor: str | None = None
        while True:
            page = self.list(limit=PAGE, cursor=cursor, state=state, metadata=metadata)
            yield from page.refinements
            if (cursor := page.next_cursor) is None:
                return

    def extend(self, refinement_id: str, lifetime_s: float) -> Refinement:
        """Keep an ended refinement and its files for `lifetime_s` from now on; Conflict before its end."""
        lifetime = make_lifetime(lifetime_s)
        return self._retried(lambda: self._transport.extend(refinement_id, lifetime))

    def cancel(self, refinement_id: str) -> Refinement:
        """Cancel a queued refinement at once, a running one soon (`cancelling`); a terminal one stays."""
        return self._retried(lambda: self._transport.cancel(refinement_id))

    def delete(self, refinement_id: str) -> None:
        """Remove the record and all bytes; Conflict while it is running."""
        retries = Retries(self._policy)
        while True:
            try:
                return self._transport.delete(refinement_id)
            except Busy as error:
                time.sleep(retries.delay_s(error))
            except NotFound:
                if retries.count == 0:
                    raise
                return None  # the try before did it, and only its answer was lost

    def watch(
        self, refinement_id: str, *, after_sequence: int = 0, timeout_s: float | None = None
    ) -> Iterator[Event]:
        """Every event once, in order, up to `completed`, over as many connections as it takes.

        Args:
            refinement_id: Which one.
            after_sequence: Begin after this event; 0 begins with the first.
            timeout_s: TimeoutError after this long. Default: none.
        """
        follow = Follow(refinement_id, after_sequence, timeout_s, self._policy)
        while not follow.done:
            longest_s = follow.longest_s()
            try:
                with closing(self._transport.events(refinement_id, follow.sequence, longest_s)) as events:
                    yield from filter(follow.accept, events)
            except Busy as error:
                time.sleep(follow.delay_s(error))

    def wait(self, refinement_id: str, *, timeout_s: float | None = None) -> Refinement:
        """The refinement in its terminal state, whichever it is; TimeoutError if that takes too long."""
        for event in self.watch(refinement_id, timeout_s=timeout_s):
            if event.refinement is not None:
                return event.refinement
        return self.get(refinement_id)

    def download(
        self, refinement_id: str, directory: str | os.PathLike[str], names: Iterable[str] | None = None
    ) -> dict[str, Path]:
        """Fetch the artifacts of these names, or all, into `directory`; their paths by name.

        Each file is checked against its SHA-256 and appears whole or not at all. An interrupted download
        continues where it stopped, also in a later call.
        """
        artifacts = choose_artifacts(self.get(refinement_id), names)
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        return {artifact.name: self._fetch(refinement_id, artifact, folder) for artifact in artifacts}

    def refine(
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
        """Submit, follow and download in one call; if that is interrupted, the refinement is cancelled.

        Args:
            mesh, silhouette, camera, options, ignore, views, mesh_format: As for `submit`.
            directory: Where the artifacts go.
            progress: Called with every Progress, at most about twice a second.

        Raises:
            JobFailed: The refinement did not succeed, and why; also InvalidInput, found by the worker.
        """
        Path(directory).mkdir(parents=True, exist_ok=True)
        refinement = self.submit(
            mesh, silhouette, camera, options, ignore=ignore, views=views, mesh_format=mesh_format
        )

        def tell(event: Event) -> None:
            if event.progress is not None and progress is not None:
                progress(event.progress)

        return self._see_through(refinement, directory, tell)

    def submit_many(
        self, cases: Iterable[Case], *, idempotency_key: str | None = None
    ) -> Sequence[Refinement | RefineError | OSError]:
        """Send many refinements, one after the other: for each the queued one, or why there is none.

        Args:
            cases: What is sent.
            idempotency_key: Of all of them: sending the same cases with it again gives the same refinements.
                Default: a new one.
        """
        key = idempotency_key or str(uuid.uuid4())
        sent: list[Refinement | RefineError | OSError] = []
        for number, case in enumerate(cases, 1):
            try:
                sent.append(self.submit(**case.arguments(), idempotency_key=f"{key}/{number}"))
            except (RefineError, OSError) as error:
                sent.append(error)
        return sent

    def refine_many(
        self,
        cases: Iterable[Case],
        directory: str | os.PathLike[str],
        *,
        idempotency_key: str | None = None,
        at_once: int = AT_ONCE,
        progress: Callable[[int, Event], None] | None = None,
    ) -> Sequence[Refined | RefineError | OSError]:
        """Submit, follow and download many: for each, in order, what `refine` returns or raises.

        If that is interrupted, those that are on their way are cancelled. If the program died, the same cases
        with the same key go on where they were.

        Args:
            cases: What is sent.
            directory: The artifacts of the first go to `directory/0001`, and so on.
            idempotency_key: As for `submit_many`.
            at_once: How many are on their way at a time.
            progress: Called with the number of the case, counted from 1, and each of its events, from several
                threads.
        """
        key = idempotency_key or str(uuid.uuid4())
        on_their_way: set[str] = set()
        stopped = threading.Event()

        def one(number: int, case: Case) -> Refined | RefineError | OSError:
            tell = partial(progress, number) if progress is not None else tell_nobody
            try:
                refinement = self.submit(**case.arguments(), idempotency_key=f"{key}/{number}")
                on_their_way.add(refinement.id)
                if stopped.is_set():
                    self._transport.cancel(refinement.id)
                refined = self._see_through(refinement, folder_of(Path(directory), number), tell)
                on_their_way.discard(refinement.id)
                return refined
            except (RefineError, OSError) as error:
                return error

        Path(directory).mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(at_once) as pool:
            calls = [pool.submit(one, number, case) for number, case in enumerate(cases, 1)]
            try:
                for call in wait(calls, return_when=FIRST_EXCEPTION).done:
                    call.result()  # raises what `progress` has
                return [call.result() for call in calls]
            except BaseException:
                stopped.set()
                pool.shutdown(wait=False, cancel_futures=True)
                for refinement_id in tuple(on_their_way):  # which ends their threads
                    with suppress(RefineError):
                        self._transport.cancel(refinement_id)
                raise

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._connection.server!r})"

    def _see_through(
        self, refinement: Refinement, directory: str | os.PathLike[str], tell: Callable[[Event], None]
    ) -> Refined:
        """Follow and download; if following is interrupted, the refinement is cancelled."""
        try:
            for event in self.watch(refinement.id):
                tell(event)
                refinement = event.refinement or refinement
        except BaseException:
            with suppress(RefineError):
                self._transport.cancel(refinement.id)
            raise
        if error := error_of(refinement):
            raise error
        return Refined(refinement, self.download(refinement.id, directory))

    def _retried(self, attempt: Callable[[], T]) -> T:
        retries = Retries(self._policy)
        while True:
            try:
                return attempt()
            except Busy as error:
                time.sleep(retries.delay_s(error))

    def _fetch(self, refinement_id: str, artifact: Artifact, directory: Path) -> Path:
        retries = Retries(self._policy)
        with PartialFile(artifact, directory) as file:
            while True:
                try:
                    if not file.complete:
                        with closing(
                            self._transport.download(refinement_id, artifact, file.offset)
                        ) as chunks:
                            for chunk in chunks:
                                file.write(chunk)
                    return file.finish()
                except Busy as error:
                    time.sleep(retries.delay_s(error))
