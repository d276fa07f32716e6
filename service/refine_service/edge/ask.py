"""Questions: jobs whose answer comes with the call. Nothing of one is kept.

The edge has no numerics, so a worker slot answers, with the code that would refine. A question goes to the
front of the queue; it still waits until a slot is free.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from typing import Any

from refine_jobs.record import Task
from refine_proto.errors import Conflict, RefineError, Unavailable, from_problem, from_validation
from refine_proto.models import EstimatedCamera

from .call import Call
from .edge import Edge
from .follow import wait_for_end
from .submit import Upload, submit

_RETRY_S = 5.0

log = logging.getLogger(__name__)


async def ask(edge: Edge, call: Call, upload: Upload, task: Task) -> Mapping[str, Any]:
    """The answer to a question about an upload, as JSON.

    Raises what a refinement of the same files would fail with, and Unavailable when no worker slot has
    answered within `answer_timeout_s`.
    """
    wait_s = edge.settings.answer_timeout_s
    question = (await submit(edge, call, upload, None, task)).refinement.id
    try:
        ended = await wait_for_end(edge, call.owner, question, wait_s)
        if ended.error is not None:
            raise from_problem(ended.error)
        answer = await edge.store.answer(call.owner, question)
        if answer is None:
            edge.check_not_draining()
            raise Unavailable(
                f"expected an answer of a worker slot within {wait_s:g} s, got none: all are busy, or there "
                "is none; ask again",
                retry_after_s=_RETRY_S,
            )
        return answer
    finally:
        await asyncio.shield(_forget(edge, call.owner, question))


async def ask_for_camera(edge: Edge, call: Call, upload: Upload) -> Mapping[str, Any]:
    """As `ask`, for the camera of the upload; InvalidInput unless that is to be estimated."""
    camera = upload.spec.camera
    if not isinstance(camera, EstimatedCamera):
        told = f"expected a camera of type estimate, got {camera.type}"
        raise from_validation([{"loc": ("camera",), "msg": told}])
    return await ask(edge, call, upload, Task.ESTIMATE)


async def _forget(edge: Edge, owner: str, question: str) -> None:
    """Remove a question; one that a slot works on is stopped, and goes when its record expires."""
    try:
        await edge.store.cancel(owner, question)
        await edge.store.delete(owner, question)
    except Conflict:
        pass
    except RefineError as error:
        log.warning("a question could not be removed: %s", error)
