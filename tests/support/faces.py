"""The sync and the async client, called in the same way."""

from __future__ import annotations

import asyncio
from typing import Any, Protocol

from refine_client import AsyncRefineClient, RefineClient
from refine_proto.models import Event


class Face(Protocol):
    def call(self, method: str, *arguments: Any, **more: Any) -> Any: ...
    def all(self, method: str, *arguments: Any, **more: Any) -> list[Any]: ...
    def watch(self, refinement_id: str, **more: Any) -> list[Event]: ...


class SyncFace:
    def __init__(self, client: RefineClient) -> None:
        self._client = client

    def call(self, method: str, *arguments: Any, **more: Any) -> Any:
        return getattr(self._client, method)(*arguments, **more)

    def all(self, method: str, *arguments: Any, **more: Any) -> list[Any]:
        return list(getattr(self._client, method)(*arguments, **more))

    def watch(self, refinement_id: str, **more: Any) -> list[Event]:
        return self.all("watch", refinement_id, **more)


class AsyncFace:
    """Every call runs in the loop of `runner`."""

    def __init__(self, client: AsyncRefineClient, runner: asyncio.Runner) -> None:
        self._client = client
        self._runner = runner

    def call(self, method: str, *arguments: Any, **more: Any) -> Any:
        return self._runner.run(getattr(self._client, method)(*arguments, **more))

    def all(self, method: str, *arguments: Any, **more: Any) -> list[Any]:
        async def collect() -> list[Any]:
            return [item async for item in getattr(self._client, method)(*arguments, **more)]

        return self._runner.run(collect())

    def watch(self, refinement_id: str, **more: Any) -> list[Event]:
        return self.all("watch", refinement_id, **more)
