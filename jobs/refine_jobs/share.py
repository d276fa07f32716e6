"""How the slots are shared: what a job is expected to cost, what its flow is charged, how early it may start.

The order itself is start-time fair queueing (lua/README.md). It counts in milliseconds of estimated work on
one core: what matters is how the costs compare.
"""

from __future__ import annotations

from dataclasses import dataclass

from refine_proto.models import Preset, Priority, RefinementSpec

from .record import Submission, Task

_CHARGE = {Priority.LOW: 4.0, Priority.NORMAL: 1.0, Priority.HIGH: 0.25}  # times the cost: 1 / share
_HEAD_START_MS = {Priority.LOW: -60_000, Priority.NORMAL: 0, Priority.HIGH: 60_000}
_QUESTION_MS = 1_000
_IN_FRONT_MS = 2**52  # more than a queue ever holds, and a double still counts single milliseconds

_ITERATIONS = {Preset.PAPER: 400, Preset.DEFAULT: 100, Preset.FAST: 40}  # the engine's
_START_MS = {Preset.PAPER: 5_000, Preset.DEFAULT: 15_000, Preset.FAST: 8_000}  # all but the iterations
_ITERATION_MS = {Preset.PAPER: 75.0, Preset.DEFAULT: 20.0, Preset.FAST: 20.0}  # but for the vertices
_VERTEX_MS = 0.04  # of an iteration: docs/benchmarks.md, Scale
_VIEW = 0.1  # of an iteration, for each further view
_VERTEX_BYTES = 60  # in a file; a texture counts as vertices,
_MOST_VERTICES = 20_000  # which is why there are no more than these


@dataclass(frozen=True)
class Share:
    """What the scripts need to know to give a job its place."""

    flow: str  # jobs of one flow start in the order in which they came
    cost_ms: int
    charge_ms: int  # how much later the next job of the flow may start
    head_start_ms: int  # how much earlier than its turn it is taken

    @classmethod
    def of(cls, submission: Submission) -> Share:
        """A flow for each owner and priority; questions go before all refinements, fair among themselves."""
        if submission.task is not Task.REFINE:
            flow = f"{submission.owner}:question"
            return cls(flow, _QUESTION_MS, _QUESTION_MS, _IN_FRONT_MS)
        priority = submission.spec.options.priority
        cost_ms = estimated_cost_ms(submission.spec, submission.mesh.size_bytes)
        return cls(
            flow=f"{submission.owner}:{priority}",
            cost_ms=cost_ms,
            charge_ms=round(cost_ms * _CHARGE[priority]),
            head_start_ms=_HEAD_START_MS[priority],
        )


def estimated_cost_ms(spec: RefinementSpec, mesh_bytes: int) -> int:
    """Milliseconds of one core, from what is known without reading the mesh."""
    options = spec.options
    vertices = min(mesh_bytes / _VERTEX_BYTES, _MOST_VERTICES)
    iterations = options.iterations or _ITERATIONS[options.preset]
    iteration_ms = _ITERATION_MS[options.preset] + _VERTEX_MS * vertices
    return round(_START_MS[options.preset] + iterations * iteration_ms * (1 + _VIEW * len(spec.views)))
