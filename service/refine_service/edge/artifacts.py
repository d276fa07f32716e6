"""An artifact of a refinement: found by its name, opened for reading."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import aclosing

from refine_jobs import keys
from refine_jobs.blobs import BlobNotFound
from refine_proto.errors import Expired, NotFound
from refine_proto.models import Artifact, Refinement

from .edge import Edge


def find_artifact(refinement: Refinement, name: str) -> Artifact:
    """The artifact of this name; raises NotFound."""
    for artifact in refinement.artifacts:
        if artifact.name == name:
            return artifact
    names = ", ".join(artifact.name for artifact in refinement.artifacts) or "none yet"
    raise NotFound(
        f"refinement {refinement.id} ({refinement.state}) has no artifact {name[:64]!r}; it has {names}"
    )


async def open_artifact(
    edge: Edge, refinement: Refinement, artifact: Artifact, start: int, stop: int
) -> AsyncGenerator[bytes, None]:
    """Its bytes from `start` to before `stop`; raises Expired at once if they are gone."""
    blob = keys.artifact_blob(refinement.id, refinement.attempt, artifact.name)
    chunks = edge.blobs.stream(blob, start, stop)
    try:
        first = await anext(chunks, b"")
    except BlobNotFound:
        raise Expired(f"the artifacts of refinement {refinement.id} have been removed") from None

    async def rest() -> AsyncGenerator[bytes, None]:
        async with aclosing(chunks):
            yield first
            async for chunk in chunks:
                yield chunk

    return rest()
