"""Runs methods over cases: every result is scored, drawn and written before the next one is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import islice

from refine_engine.cameras.seen import silhouette_iou
from refine_engine.errors import RefineError
from refine_engine.scores.scores import Normalisation, evaluate
from refine_engine.values import Mesh

from .cases import Case, CaseSkipped, Direction, Scene
from .confidence import confidence_auc, mirror_distances
from .methods import applies, seeds_of
from .outcome import Method, Outcome
from .pictures import draw
from .records import MEASURES, METRICS, Record, Results, Scores, thinned
from .show import Show


@dataclass(frozen=True)
class Plan:
    """What is to be run and how it is judged."""

    cases: Sequence[Case]
    methods: Mapping[str, Method]
    seeds: Sequence[int] = (0,)
    normalisation: Normalisation = "shared"
    score_seeds: int = 3
    """Random draws of surface points that a score averages."""
    in_flight: int = 1
    """Refinements asked for at once; above 1 only for a server."""


@dataclass(frozen=True)
class _Task:
    case: Case
    method: str
    seed: int


@dataclass(frozen=True)
class _Attempt:
    task: _Task
    scene: Scene | None
    outcome: Outcome | None
    error: Exception | None


def run(plan: Plan, results: Results, show: Show) -> None:
    """Do what `results` lacks of the plan. A case that fails is recorded and the run goes on."""
    tasks = [
        _Task(case, method, seed)
        for case in plan.cases
        for method in plan.methods
        for seed in seeds_of(method, plan.seeds)
        if applies(method, case) and not results.has((case.name, method, seed))
    ]
    before: dict[str, Scores] = {r.case: r.before for r in results.records if r.before is not None}
    show.start(len(tasks), results.records)
    for attempt in _attempts(plan, tasks):
        record = _judged(plan, attempt, before, results)
        results.add(record)
        show.add(record)


def _attempts(plan: Plan, tasks: Sequence[_Task]) -> Iterator[_Attempt]:
    """In the order of the tasks, or with several in flight in the order of their ends."""

    @lru_cache(maxsize=2 * plan.in_flight)  # the methods and seeds of a case follow each other
    def load(case: Case) -> Scene:
        return case.load()

    def attempt(task: _Task) -> _Attempt:
        scene = None
        try:
            scene = load(task.case)
            outcome = plan.methods[task.method](task.case, scene, task.seed)
        except Exception as error:  # the data or a plug-in may do anything; the other cases are not to suffer
            return _Attempt(task, scene, None, error)
        return _Attempt(task, scene, outcome, None)

    if plan.in_flight == 1:
        yield from map(attempt, tasks)
        return
    remaining = iter(tasks)
    with ThreadPoolExecutor(plan.in_flight) as pool:
        running: set[Future[_Attempt]] = {pool.submit(attempt, t) for t in islice(remaining, plan.in_flight)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            running |= {pool.submit(attempt, task) for task in islice(remaining, len(done))}
            for future in done:
                yield future.result()


def _judged(plan: Plan, attempt: _Attempt, before: dict[str, Scores], results: Results) -> Record:
    task, scene, outcome = attempt.task, attempt.scene, attempt.outcome
    record = Record.of(task.case, task.method, task.seed, "done")
    if isinstance(attempt.error, CaseSkipped):
        return replace(record, status="skipped", message=str(attempt.error))
    if attempt.error is not None or scene is None or outcome is None:
        return replace(record, status="failed", message=_message(attempt.error))
    try:
        if task.case.name not in before:
            before[task.case.name] = score(plan, scene, scene.coarse)
        after = score(plan, scene, outcome.mesh)
    except RefineError as error:  # for instance a result without a surface
        return replace(record, status="failed", message=_message(error))
    picture = f"pictures/{task.method.replace(':', '.')}/{task.case.name}_{task.seed}.png"
    path = results.folder / picture
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(draw(scene, outcome))
    return replace(
        record,
        before=before[task.case.name],
        after=after,
        measures=measures(task.case, scene, outcome),
        seconds=round(outcome.seconds, 3),
        queue_s=outcome.queue_s,
        loss_curve=thinned(outcome.loss_curve),
        picture=picture,
    )


def score(plan: Plan, scene: Scene, mesh: Mesh) -> Scores:
    """By METRICS; without ground truth only the 2D IoU."""
    if scene.ground_truth is None:
        return dict.fromkeys(METRICS) | {"silhouette_iou": silhouette_iou(mesh, scene.view)}
    scores = evaluate(
        mesh,
        scene.ground_truth,
        normalisation=plan.normalisation,
        seeds=range(plan.score_seeds),
        view=scene.view,
    )
    return asdict(scores)


def measures(case: Case, scene: Scene, outcome: Outcome) -> Scores:
    """By MEASURES: the mean motion of the vertices in per cent of the longest side, where the result still
    has those of the coarse mesh; of the confidence its mean on a symmetric object, its AUC on an asymmetric
    one, about the plane that the confidence is about, where the truth is known to be symmetric or not."""
    found: dict[str, float | None] = dict.fromkeys(MEASURES)
    coarse, refined = scene.coarse.vertices, outcome.mesh.vertices
    if coarse.shape == refined.shape:
        side = float((coarse.amax(0) - coarse.amin(0)).max())
        found["motion"] = 100.0 * float((refined - coarse).norm(dim=1).mean()) / side
    truth, true_plane, plane = scene.ground_truth, case.plane, outcome.plane
    known = true_plane is not None and true_plane.offset is not None
    if outcome.confidence is None or not known or not isinstance(truth, Mesh):
        return found
    if not case.asymmetric:
        return found | {"confidence_mean": float(outcome.confidence.mean())}
    if plane is None:
        return found
    used = outcome.mesh.faces.unique()
    normal: Direction = tuple(plane.normal.tolist())
    distances = mirror_distances(refined[used].double().numpy(), truth, normal, plane.offset)
    return found | {"confidence_auc": confidence_auc(outcome.confidence[used].double().numpy(), distances)}


def _message(error: Exception | None) -> str:
    kind = "" if isinstance(error, RefineError) else f"{type(error).__name__}: "
    return " ".join(f"{kind}{error}".split())
