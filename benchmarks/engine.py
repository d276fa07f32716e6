"""Measure the engine on this machine's CPU and print the results as Markdown.

    python benchmarks/engine.py speed                                  stages, renderer, end to end
    python benchmarks/engine.py scale --plot docs/scale.png            against vertices and render size
    python benchmarks/engine.py quality examples/samples -o RESULTS    presets and seeds against ground truth
    python benchmarks/engine.py iteration --vertices 1500 --side 224   one size, as JSON

CPU times are of one thread: they barely depend on what else runs on the machine. `--save FILE.json` keeps the
numbers of `speed` and `scale`, and `--previous FILE.json` prints their ratio to an earlier run's.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from refine_bench import measure, quality
from refine_engine.loop import Fit
from refine_engine.metrics import hard_silhouette
from refine_engine.options import PRESETS
from refine_engine.scene import Camera, Mesh, View
from refine_engine.silhouette import cpu, oracle

DEFAULT_CASE = Path(__file__).resolve().parent.parent / "examples" / "samples" / "airplane"
VERTICES = (500, 1500, 5000, 20_000, 100_000)
SIDES = (112, 224, 448)
RUN = "import sys; from refine_engine.commands.run import run_command; sys.exit(run_command(sys.argv[1:]))"
Numbers = dict[str, float]


def main(argv: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(argv)
    torch.set_num_threads(1)
    if options.command == "iteration":
        print(json.dumps(iteration(options.vertices, options.side)))
        return
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
        f"torch {torch.__version__}\n"
    )
    if options.command == "quality":
        print_quality(options)
        return
    numbers = speed(options) if options.command == "speed" else scale(options)
    if options.previous:
        print_ratios(numbers, json.loads(options.previous.read_text()))
    if options.save:
        options.save.write_text(json.dumps(numbers, indent=2) + "\n")


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """A Markdown table: text to the left, numbers to the right."""
    print("| " + " | ".join(header) + " |")
    print("|---|" + "---:|" * (len(header) - 1))
    for row in rows:
        print("| " + " | ".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in row) + " |")
    print(flush=True)


def speed(options: argparse.Namespace) -> Numbers:
    """The renderer, the stages of an iteration, and whole runs."""
    inputs = measure.read_case(options.case)
    mesh, view = inputs.mesh_file.mesh, inputs.view
    numbers: Numbers = {"gemm_gflops": measure.peak_flop_per_second() / 1e9}
    print(f"{options.case.name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces. "
          f"Matrix products reach {numbers['gemm_gflops']:.0f} GFLOP/s on one thread.\n")  # fmt: skip
    numbers |= renderer(mesh, view)
    for preset, make in PRESETS.items():
        numbers |= stages(preset, measure.start(mesh, view, make()))
    return numbers if options.no_runs else numbers | runs(options.case)


def renderer(mesh: Mesh, view: View) -> Numbers:
    """The CPU renderer against the oracle, per pair, and on two threads."""
    config = PRESETS["paper"]()
    fit = measure.start(mesh, view, config)
    softness, faces = config.stages[-1].softness, mesh.faces
    side, screen = 64, measure.screen_of(fit)[:1] * (64 / 224)
    reference = _forward_and_backward(oracle.optical_depth, screen, faces, side, softness)
    ours = _forward_and_backward(cpu.optical_depth, screen, faces, side, softness)

    side, screen = 224, measure.screen_of(fit)
    forward, backward = measure.render_seconds(screen, faces, side, softness)
    pairs = measure.contributing_pairs(screen, faces, side, softness)
    walls = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        walls.append(measure.wall_seconds(lambda: cpu.optical_depth(screen, faces, side, softness)))
    torch.set_num_threads(1)
    numbers = {
        "renderer_over_oracle": reference / ours,
        "renderer_forward_ns_per_pair": forward / pairs * 1e9,
        "renderer_backward_ns_per_pair": backward / pairs * 1e9,
        "renderer_two_threads": walls[0] / walls[1],
    }
    print("## Renderer\n")
    table(["", "value"], [
        ["one view of 64 x 64, times faster than the torch oracle", numbers["renderer_over_oracle"]],
        [f"{len(screen)} views of 224 x 224: contributing (pixel, face) pairs, millions", pairs / 1e6],
        ["forward, ns per pair", numbers["renderer_forward_ns_per_pair"]],
        ["backward, ns per pair", numbers["renderer_backward_ns_per_pair"]],
        ["two threads over one (wall time)", numbers["renderer_two_threads"]],
    ])  # fmt: skip
    return numbers


def _forward_and_backward(
    render: Callable[[Tensor, Tensor, int, float], Tensor],
    screen: Tensor,
    faces: Tensor,
    side: int,
    softness: float,
) -> float:
    points = screen.detach().requires_grad_()
    return measure.cpu_seconds(lambda: render(points, faces, side, softness).sum().backward())


def stages(preset: str, fit: Fit) -> Numbers:
    """CPU time of the parts of one iteration, and the share of the floor that it reaches."""
    seconds = measure.stage_seconds(fit)
    whole = seconds["iteration"]
    flop = measure.network_flop(fit)
    floor = flop / measure.peak_flop_per_second()
    print(f"## One iteration of `{preset}`\n")
    network = seconds["encoder"] + seconds["graph convolutions"]
    rows = [[name, 1e3 * s, f"{100 * s / whole:.0f} %"] for name, s in seconds.items()]
    table(["", "CPU ms", "share"], rows)
    print(f"Network: {flop / 1e9:.2f} GFLOP, at the matrix product's rate {1e3 * floor:.0f} ms: "
          f"{100 * floor / whole:.0f} % of the iteration, "
          f"{100 * floor / network:.0f} % of the network's time.\n")  # fmt: skip
    return {f"{preset}: {name}, ms": 1e3 * s for name, s in seconds.items()}


def runs(case: Path) -> Numbers:
    """`refine run`: wall time on two threads, memory, and two jobs side by side on one thread each."""
    print("## `refine run`\n")
    numbers: Numbers = {}
    for preset in PRESETS:
        wall, processor, memory = _run(case, preset, threads=2)
        numbers |= {f"{preset}: run, s": wall, f"{preset}: run, CPU s": processor, f"{preset}: GB": memory}
    names = "run, s", "run, CPU s", "GB"
    header = ["preset", "wall s, two threads", "CPU s", "peak memory, GB"]
    table(header, [[p, *(numbers[f"{p}: {n}"] for n in names)] for p in PRESETS])
    alone = _run(case, "fast", threads=1)[0]
    before = time.perf_counter()
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda _: _run(case, "fast", threads=1), range(2)))
    numbers["two jobs over one"] = 2 * alone / (time.perf_counter() - before)
    print("Two jobs side by side, one thread each: ", end="")
    print(f"{numbers['two jobs over one']:.2f} times the throughput of one.\n")
    return numbers


def _run(case: Path, preset: str, threads: int) -> tuple[float, float, float]:
    """Wall seconds, CPU seconds and peak memory (GB) of `refine run` in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command: list[str | Path] = [
            *(sys.executable, "-c", RUN, case / "coarse.obj", case / "silhouette.png"),
            *("--camera", case / "camera.json", "-o", Path(folder) / "out"),
            *("--preset", preset, "--threads", str(threads), "--json"),
        ]
        before = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"refine run failed with exit code {process.returncode}")
        kibibyte = 1 if sys.platform == "darwin" else 1024
        wall = time.perf_counter() - before
        return wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * kibibyte / 1e9


def ellipsoid(vertices: int, side: int) -> tuple[Mesh, View]:
    """A smooth object of any number of vertices, and the silhouette of a longer one."""
    i = np.arange(vertices) + 0.5
    height, angle = 1 - 2 * i / vertices, np.pi * (1 + 5**0.5) * i  # Fibonacci sphere
    radius = np.sqrt(1 - height**2)
    sphere = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], 1)
    faces = torch.from_numpy(ConvexHull(sphere).simplices.astype(np.int64))
    points = torch.from_numpy(sphere.astype(np.float32))
    camera = Camera.look_at(40, 25, 1.5, 60, side, side)
    longer = Mesh(points * torch.tensor([0.5, 0.3, 0.2]), faces)
    coarse = Mesh(points * torch.tensor([0.45, 0.32, 0.2]), faces)
    return coarse, View(hard_silhouette(longer, camera).float(), camera)


def iteration(vertices: int, side: int) -> Numbers:
    """CPU time and peak memory of an iteration of the default preset and of `paper`, in this process."""
    mesh, view = ellipsoid(vertices, side)
    numbers = {}
    for preset in ("default", "paper"):
        fit = measure.start(mesh, view, measure.at_size(PRESETS[preset](), side))
        numbers[f"{preset}, ms"] = 1e3 * measure.cpu_seconds(fit.step)
        del fit
    return numbers | {"memory, GB": measure.peak_memory_bytes() / 1e9}


def scale(options: argparse.Namespace) -> Numbers:
    """Iterations of growing meshes and growing images, each size in a process of its own."""
    sizes = [(v, 224) for v in VERTICES] + [(1500, s) for s in SIDES if s != 224]
    results = {size: _iteration_in_its_own_process(*size) for size in sizes}
    for title, chosen in (
        ("Vertices, renders of 224 x 224", [(v, 224) for v in VERTICES]),
        ("Render size, 1,500 vertices", [(1500, s) for s in SIDES]),
    ):
        print(f"## {title}\n")
        names = list(results[chosen[0]])
        table(["vertices", "side", *names], [[*size, *results[size].values()] for size in chosen])
    if options.plot:
        plot(results, options.plot)
    return {f"{v} vertices, {s} pixels: {n}": x for (v, s), row in results.items() for n, x in row.items()}


def _iteration_in_its_own_process(vertices: int, side: int) -> Numbers:
    command = [sys.executable, __file__, "iteration", "--vertices", str(vertices), "--side", str(side)]
    numbers: Numbers = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return numbers


def plot(results: Mapping[tuple[int, int], Numbers], path: Path) -> None:
    """Time and memory against vertices and render size, on logarithmic axes."""
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise SystemExit("expected matplotlib for --plot, found none: pip install matplotlib") from None
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, label, chosen in (
        (axes[0], "vertices (renders of 224 x 224)", [(v, 224) for v in VERTICES]),
        (axes[1], "render size, pixels (1,500 vertices)", [(1500, s) for s in SIDES]),
    ):
        x = [size[0 if axis is axes[0] else 1] for size in chosen]
        for preset in ("default", "paper"):
            axis.loglog(
                x, [results[size][f"{preset}, ms"] for size in chosen], "o-", label=f"{preset}, CPU ms"
            )
        axis.loglog(x, [1e3 * results[size]["memory, GB"] for size in chosen], "s--", label="peak memory, MB")
        axis.set_xlabel(label)
        axis.set_xticks(x, [f"{value:,}" for value in x])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend()
    figure.savefig(path, dpi=120)


def print_quality(options: argparse.Namespace) -> None:
    """Refine every case with every preset and seed, then the tables: a summary, and the cases."""
    cases = quality.cases_of(options.folders)
    if not cases:
        raise SystemExit(f"expected folders of cases (with camera.json), found none in {options.folders}")
    summaries, scores = [], []
    for preset in options.presets:
        for seed in range(options.seeds):
            config = replace(PRESETS[preset](), seed=seed)
            output = options.output / f"{preset}-{seed}"
            of_run = []
            for case in cases:
                quality.refine_case(case, config, output / case.name)
                of_run.append(quality.score_case(case, output / case.name / "refined.glb"))
                print(f"{preset} {seed} {case.name}", file=sys.stderr, flush=True)
            summaries.append((preset, str(seed), quality.Summary.of(of_run)))
            scores += [(preset, seed, score) for score in of_run]
    for preset in options.presets:
        of_preset = [s for name, _, s in summaries if name == preset]
        summaries.append((preset, "mean", quality.mean(of_preset)))
    print("## Presets\n")
    table(
        ["preset", "seed", "Chamfer-l2 ratio", "F-score gain", "2D IoU before", "after", "worst case"],
        [[p, s, q.chamfer_ratio, q.f_gain, q.iou_before, q.iou_after, f"{q.worst_ratio:.2f} {q.worst_case}"]
         for p, s, q in summaries],
    )  # fmt: skip
    print("## Cases\n")
    rows = []
    for preset, seed, score in scores:
        chamfer, f = score.chamfer or ("-", "-"), score.f or ("-", "-")
        rows.append([score.case, preset, seed, *score.iou, *chamfer, *f])
    header = ["case", "preset", "seed", "2D IoU", "after", "Chamfer-l2", "after", "F-score", "after"]
    table(header, sorted(rows, key=lambda row: str(row[0])))


def print_ratios(numbers: Numbers, previous: Numbers) -> None:
    """This run's numbers against an earlier one's."""
    print("## Against the previous run\n")
    shared = [name for name in numbers if name in previous]
    rows = [[name, previous[name], numbers[name], numbers[name] / previous[name]] for name in shared]
    table(["", "previous", "now", "now / previous"], rows)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    of_speed = commands.add_parser("speed", help="renderer, stages of an iteration, whole runs")
    of_speed.add_argument("--case", type=Path, default=DEFAULT_CASE, help="folder with coarse.obj etc.")
    of_speed.add_argument("--no-runs", action="store_true", help="leave the whole runs out")
    of_scale = commands.add_parser("scale", help="against vertices and render size")
    of_scale.add_argument("--plot", type=Path, metavar="FILE.png", help="needs matplotlib")
    for measured in (of_speed, of_scale):
        measured.add_argument("--save", type=Path, metavar="FILE.json", help="keep the numbers")
        measured.add_argument(
            "--previous", type=Path, metavar="FILE.json", help="compare with an earlier run"
        )
    of_quality = commands.add_parser("quality", help="presets and seeds against ground truth; can be resumed")
    of_quality.add_argument("folders", type=Path, nargs="+", help="each holds case folders")
    of_quality.add_argument("-o", "--output", type=Path, required=True, metavar="RESULTS")
    of_quality.add_argument("--presets", nargs="+", choices=list(PRESETS), default=list(PRESETS))
    of_quality.add_argument("--seeds", type=int, default=3, metavar="N", help="seeds 0 ... N - 1 (3)")
    of_iteration = commands.add_parser("iteration", help="one size in this process, as JSON")
    of_iteration.add_argument("--vertices", type=int, required=True)
    of_iteration.add_argument("--side", type=int, default=224)
    return parser


if __name__ == "__main__":
    main()
