"""Results as they come: one JSON object per line, so that a run can be continued and read by anything."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from .cases import Case, SetInvalid

Status = Literal["done", "failed", "skipped"]
MEASURES = ("motion", "confidence_mean", "confidence_auc")  # of a result alone
METRICS = ("emd", "chamfer_l2", "f_score", "volumetric_iou", "silhouette_iou")
CURVE_POINTS = 120  # of a loss curve: as many as a small plot shows

Scores = Mapping[str, float | None]  # by the names of METRICS or MEASURES; None: not measured


@dataclass(frozen=True)
class Record:
    """One case refined by one method with one seed."""

    case: str
    category: str
    level: str
    asymmetric: bool
    method: str
    seed: int
    status: Status
    message: str = ""  # why it failed or was skipped
    before: Scores | None = None
    after: Scores | None = None
    measures: Scores = field(default_factory=dict)  # by MEASURES
    seconds: float = 0.0
    queue_s: float | None = None
    loss_curve: Sequence[float] = ()
    picture: str | None = None  # path in the results folder

    @staticmethod
    def of(case: Case, method: str, seed: int, status: Status, message: str = "") -> Record:
        return Record(case.name, case.category, case.level, case.asymmetric, method, seed, status, message)

    @property
    def key(self) -> tuple[str, str, int]:
        return self.case, self.method, self.seed


class Results:
    """A results folder. What is done stays when the same run is started again; what failed is tried again."""

    def __init__(self, folder: Path, settings: Mapping[str, object]) -> None:
        """Opens the folder; SetInvalid when it holds the results of a run with other settings."""
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._file = folder / "results.jsonl"
        self._check(settings)
        records = [_parse(line) for line in self._lines()]
        self._records = {record.key: record for record in records if record.status != "failed"}

    @property
    def records(self) -> list[Record]:
        return list(self._records.values())

    def has(self, key: tuple[str, str, int]) -> bool:
        return key in self._records

    def add(self, record: Record) -> None:
        self._records[record.key] = record
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(record)) + "\n")

    def _check(self, settings: Mapping[str, object]) -> None:
        path, wanted = self.folder / "run.json", json.loads(json.dumps(settings))
        if not path.exists():
            path.write_text(json.dumps(wanted, indent=2) + "\n", encoding="utf-8")
            return
        found = json.loads(path.read_text(encoding="utf-8"))
        differing = [name for name in {**wanted, **found} if wanted.get(name) != found.get(name)]
        if differing:
            name = differing[0]
            raise SetInvalid(
                f"expected {self.folder} to be new or to hold results of the same run, got some with "
                f"{name} = {found.get(name)} instead of {wanted.get(name)}; choose another --output"
            )

    def _lines(self) -> list[str]:
        """Whole lines only: a run that was killed may have left half of one, which is cut off."""
        if not self._file.exists():
            return []
        data = self._file.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            self._file.write_bytes(whole)
        return whole.decode("utf-8").splitlines()


def _parse(line: str) -> Record:
    return Record(**json.loads(line))


def thinned(curve: Sequence[float]) -> list[float]:
    """At most CURVE_POINTS of a loss curve, with its first and last value."""
    if len(curve) <= CURVE_POINTS:
        return [round(value, 6) for value in curve]
    last = CURVE_POINTS - 1
    return [round(curve[round(k * (len(curve) - 1) / last)], 6) for k in range(CURVE_POINTS)]


def without_seeds(records: Sequence[Record]) -> list[Record]:
    """Finished records with the seeds of each case and method averaged."""
    groups: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        if record.status == "done":
            groups.setdefault((record.case, record.method), []).append(record)
    return [
        replace(
            group[0],
            before=_mean([r.before for r in group], METRICS),
            after=_mean([r.after for r in group], METRICS),
            measures=_mean([r.measures for r in group], MEASURES),
        )
        for group in groups.values()
    ]


def _mean(scores: Sequence[Scores | None], names: Sequence[str]) -> Scores:
    result: dict[str, float | None] = {}
    for name in names:
        values = [s[name] for s in scores if s is not None and s.get(name) is not None]
        result[name] = sum(v for v in values if v is not None) / len(values) if values else None
    return result
