"""The numbers of the tables, against ones computed by hand; and the records they come from."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest

from refine_bench.cases import SetInvalid
from refine_bench.cells import cell
from refine_bench.records import METRICS, Record, Results, thinned, without_seeds
from refine_bench.report import badness, write_report
from refine_bench.tables import tables_csv, tables_markdown


def record(
    case: str, before: float, after: float, category: str = "car", method: str = "refine", seed: int = 0
) -> Record:
    """Chamfer-l2 as given, the other metrics unchanged."""
    same = {"emd": 0.1, "f_score": 50.0, "volumetric_iou": 0.5, "silhouette_iou": 0.7}
    return Record(
        case, category, "mild", case.startswith("a_"), method, seed, "done",
        before={**same, "chamfer_l2": before}, after={**same, "chamfer_l2": after},
        loss_curve=[3.0, 2.0, 1.0],
    )  # fmt: skip


RECORDS = [record("one", 10.0, 4.0), record("two", 20.0, 24.0), record("three", 6.0, 2.0, "chair")]


def test_a_cell_by_hand() -> None:
    found = cell(RECORDS, "chamfer_l2")
    assert found is not None
    assert (found.before, found.after) == (12.0, 10.0)
    assert (found.median_before, found.median_after) == (10.0, 4.0)
    assert found.worse == 1
    # changes -6, 4, -4: mean -2, sample variance (16 + 36 + 4) / 2 = 28
    assert found.standard_error == pytest.approx((28 / 3) ** 0.5)
    unchanged = cell(RECORDS, "f_score")
    assert unchanged is not None
    assert (unchanged.worse, unchanged.standard_error) == (0, 0.0)


def test_the_table_has_a_row_per_category_and_the_paper_s_columns() -> None:
    lines = tables_markdown(RECORDS, "title").splitlines()
    header = next(line for line in lines if line.startswith("| category"))
    assert [c.strip() for c in header.strip("|").split("|")] == [
        "category", "n", "EMD", "CD-l2", "F-score", "Vol. IoU", "2D IoU",
    ]  # fmt: skip
    rows = {line.split("|")[1].strip(): line for line in lines if line.startswith("|")}
    assert "15.00 -> 14.00 (-7 %)" in rows["car"]
    assert "6.00 -> 2.00 (-67 %)" in rows["chair"]
    assert "**12.00 -> 10.00 (-17 %)**" in rows["**mean**"]
    assert "10.00 -> 4.00" in rows["median"]
    assert "± 3.06" in rows["standard error"]
    assert "1 of 3" in rows["made worse"]


def test_what_got_worse_comes_first_and_the_summary_counts_it() -> None:
    far = replace(record("far", 10.0, 15.0), level="strong", measures={"motion": 2.0})
    text = tables_markdown([*RECORDS, far], "title")
    assert text.index("## Made worse") < text.index("## Summary") < text.index("## refine")
    worse = [line for line in text[: text.index("## Summary")].splitlines() if line.startswith("| refine")]
    assert [line.split("|")[3].strip() for line in worse] == ["x1.50", "x1.20"]
    assert [line.split("|")[2].strip() for line in worse] == ["far", "two"]
    lines = text[text.index("## Summary") : text.index("## refine")].splitlines()
    mild, strong = (line for line in lines if line.startswith("| refine"))
    # ratios 0.4, 1.2 and 1/3: geometric mean 0.16 ** (1 / 3)
    cells = [cell.strip() for cell in mild.strip("|").split("|")]
    assert cells[1:7] == ["mild", "3", "1", "1", "x1.20 two", "x0.543"]
    assert strong.rstrip(" |").endswith("2.00 %")
    better = tables_markdown([record("one", 10.0, 9.9)], "title")
    assert "No case was made worse" in better


def test_confidence_is_a_mean_on_symmetric_objects_and_an_auc_on_asymmetric_ones() -> None:
    sure = replace(record("one", 10.0, 4.0), measures={"confidence_mean": 0.9, "confidence_auc": None})
    unsure = replace(record("two", 10.0, 4.0), measures={"confidence_mean": 0.7, "confidence_auc": None})
    chair = replace(record("a_chair", 10.0, 4.0), measures={"confidence_mean": None, "confidence_auc": 0.6})
    text = tables_markdown([sure, unsure, chair], "title")
    assert "| refine | 2 | 0.800 | 0.700 two | 1 | 0.600 | 0.600 a_chair |" in text
    assert "Confidence of symmetry" not in tables_markdown(RECORDS, "title")
    seeds = [sure, replace(sure, seed=1, measures={"confidence_mean": 0.8, "confidence_auc": None})]
    assert without_seeds(seeds)[0].measures["confidence_mean"] == pytest.approx(0.85)


def test_methods_are_compared_on_the_cases_that_all_did() -> None:
    silhouette = [
        record("one", 10.0, 12.0, method="silhouette"),
        record("extra", 1.0, 9.0, method="silhouette"),
    ]
    rows = tables_markdown([*RECORDS, *silhouette], "title").splitlines()
    start = rows.index("## Methods side by side")
    table = rows[start + 2 : start + 7]
    assert table[0].startswith("| method (n = 1) ")
    assert "| none | 0.1000 | 10.00 |" in table[2]
    assert any("12.00 (+20 %)" in row and "silhouette only" in row for row in table)
    assert any("4.00 (-60 %)" in row and "refine" in row for row in table)


def test_lambda_b_is_compared_on_asymmetric_objects_only() -> None:
    rows = [record("a_one", 10.0, 5.0, method="all"), record("one", 10.0, 1.0, method="all")]
    text = tables_markdown([*rows, record("a_one", 10.0, 8.0, method="confidence_cost_1")], "title")
    table = text[text.index("## Asymmetric objects") :].split("##")[1]
    assert "n = 1" in table
    assert "5.00 (-50 %)" in table
    assert "8.00 (-20 %)" in table


def test_seeds_are_averaged_and_their_spread_is_reported() -> None:
    seeds = [record("one", 10.0, 4.0), record("one", 10.0, 6.0, seed=1), record("one", 10.0, 5.0, seed=2)]
    (mean,) = without_seeds(seeds)
    assert mean.after is not None
    assert mean.after["chamfer_l2"] == pytest.approx(5.0)
    assert "5.00 ± 1.00" in tables_markdown(seeds, "title")
    assert "Spread over seeds" not in tables_markdown(RECORDS, "title")


def test_csv_holds_every_cell_unrounded() -> None:
    rows = list(csv.DictReader(io.StringIO(tables_csv(RECORDS))))
    assert len(rows) == len(METRICS) * 3  # two categories and all
    (row,) = [r for r in rows if (r["category"], r["metric"]) == ("all", "chamfer_l2")]
    assert float(row["gain"]) == pytest.approx(-100 / 6)
    assert (row["cases"], row["worse"], row["gain_unit"]) == ("3", "1", "per cent")


def test_cases_without_ground_truth_are_counted_in_2d_only() -> None:
    scores: dict[str, float | None] = dict.fromkeys(METRICS)
    photo = Record(
        "photo", "all", "", False, "refine", 0, "done",
        before={**scores, "silhouette_iou": 0.6}, after={**scores, "silhouette_iou": 0.8},
    )  # fmt: skip
    header = next(line for line in tables_markdown([photo], "t").splitlines() if "category" in line)
    assert header == "| category | n | 2D IoU |"
    assert badness(photo) == pytest.approx(0.5)


def test_results_continue_and_try_failures_again(tmp_path: Path) -> None:
    settings = {"preset": "paper"}
    results = Results(tmp_path, settings)
    results.add(RECORDS[0])
    results.add(Record("broken", "car", "", False, "refine", 0, "failed", "no file"))
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"case": "half a li')  # the process was killed here
    again = Results(tmp_path, settings)
    assert again.records == [RECORDS[0]]
    assert not again.has(("broken", "refine", 0))
    again.add(RECORDS[1])
    assert [r.case for r in Results(tmp_path, settings).records] == ["one", "two"]
    assert all(json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines())


def test_results_of_another_run_are_not_mixed_in(tmp_path: Path) -> None:
    Results(tmp_path, {"preset": "paper"})
    with pytest.raises(SetInvalid, match="preset = paper instead of fast"):
        Results(tmp_path, {"preset": "fast"})


def test_a_long_loss_curve_is_thinned_with_both_ends() -> None:
    curve = [float(k) for k in range(1000)]
    thin = thinned(curve)
    assert (len(thin), thin[0], thin[-1]) == (120, 0.0, 999.0)


def test_the_report_is_one_file_with_the_worst_first(tmp_path: Path) -> None:
    problem = Record("lost", "car", "", False, "refine", 0, "failed", "expected <coarse>, got none")
    page = write_report(tmp_path, [*RECORDS, problem], "A <run>", "tables").read_text()
    assert page.index(">two<") < page.index(">one<") < page.index(">three<")
    assert "A &lt;run&gt;" in page
    assert "expected &lt;coarse&gt;" in page
    assert page.count("<polyline") == 3
    assert "http" not in page.replace("http-equiv", "")
