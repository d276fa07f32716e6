"""Measure the engine on this machine's CPU and print the results as Markdown.

    python benchmarks/engine.py speed                                  stages, renderer, end to end
    python benchmarks/engine.py scale --plot docs/scale.png            against vertices and render size
    python benchmarks/engine.py quality examples/samples -o RESULTS    presets and seeds against ground truth
    python benchmarks/engine.py iteration --vertices 1500 --side 224   one size, as JSON

CPU times are of one thread. What else runs on the processor, also in other virtual machines, changes them by
up to two thirds: compare only what one run measured. `speed --against COMMIT` times another version in turn.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
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
from refine_engine.cameras.seen import hard_silhouette
from refine_engine.kernels import cpu, oracle
from refine_engine.method.loop import Fit
from refine_engine.method.presets import PRESETS
from refine_engine.values import Camera, Mesh, View

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_CASE = ROOT / "examples" / "samples" / "airplane"
VERTICES = (500, 1500, 5000, 20_000, 100_000)
SIDES = (112, 224, 448)
RUN = """
import sys
from refine_bench.measure import peak_memory_bytes
from refine_engine.commands.run import run_command
code = run_command(sys.argv[1:])
print(peak_memory_bytes())
sys.exit(code)
"""
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
    parts = {"speed": speed, "scale": scale, "quality": print_quality}
    parts[options.command](options)


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """A Markdown table: text to the left, numbers to the right."""
    print("| " + " | ".join(header) + " |")
    print("|---|" + "---:|" * (len(header) - 1))
    for row in rows:
        print("| " + " | ".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in row) + " |")
    print(flush=True)


def speed(options: argparse.Namespace) -> None:
    """The renderer, the stages of an iteration, another version, and whole runs."""
    inputs = measure.read_case(options.case)
    mesh, view = inputs.mesh_file.mesh, inputs.views[0]
    rate = measure.peak_flop_per_second() / 1e9
    print(f"{options.case.name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces. ", end="")
    print(f"Matrix products reach {rate:.0f} GFLOP/s on one thread.\n")
    renderer(mesh, view)
    for preset, make in PRESETS.items():
        stages(preset, measure.start(mesh, view, make()))
    if options.against:
        against(options.against)
    if not options.no_runs:
        runs(options.case)


def renderer(mesh: Mesh, view: View) -> None:
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
    print("## Renderer\n")
    table(["", "value"], [
        ["one view of 64 x 64, times faster than the torch oracle", reference / ours],
        [f"{len(screen)} views of 224 x 224: contributing (pixel, face) pairs, millions", pairs / 1e6],
        ["forward, ns per pair", forward / pairs * 1e9],
        ["backward, ns per pair", backward / pairs * 1e9],
        ["two threads over one (wall time)", walls[0] / walls[1]],
    ])  # fmt: skip


def _forward_and_backward(
    render: Callable[[Tensor, Tensor, int, float], Tensor],
    screen: Tensor,
    faces: Tensor,
    side: int,
    softness: float,
) -> float:
    points = screen.detach().requires_grad_()
    return measure.cpu_seconds(lambda: render(points, faces, side, softness).sum().backward())


def stages(preset: str, fit: Fit) -> None:
    """CPU time of the parts of one iteration, and the share of the floor that it reaches."""
    seconds = measure.stage_seconds(fit)
    whole = seconds["iteration"]
    flop = measure.network_flop(fit)
    floor = flop / measure.peak_flop_per_second()
    print(f"## One iteration of `{preset}`\n")
    network = seconds.get("encoder", 0.0) + seconds["graph convolutions"]
    rows = [[name, 1e3 * s, f"{100 * s / whole:.0f} %"] for name, s in seconds.items()]
    table(["", "CPU ms", "share"], rows)
    print(f"Network: {flop / 1e9:.2f} GFLOP, at the matrix product's rate {1e3 * floor:.0f} ms: "
          f"{100 * floor / whole:.0f} % of the iteration, "
          f"{100 * floor / network:.0f} % of the network's time.\n")  # fmt: skip


def against(reference: str) -> None:
    """CPU time of an iteration of another version and of this one, in turn: both meet the same machine."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), reference], check=True)
        try:
            rounds = [[_iteration_in_its_own_process(1500, 224, at) for at in (tree, ROOT)] for _ in range(3)]
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)
    print(f"## Against {reference}\n")
    rows = []
    for name in (name for name in rounds[0][1] if name in rounds[0][0]):
        then, now = ([pair[i][name] for pair in rounds] for i in (0, 1))
        ratios = [b / a for a, b in zip(then, now, strict=True)]
        rows.append([name, *(statistics.median(numbers) for numbers in (then, now, ratios))])
    table(["1,500 vertices, renders of 224 x 224", reference, "now", "now / then"], rows)


def runs(case: Path) -> None:
    """`refine run`: wall time on two threads, memory, and two jobs side by side on one thread each."""
    print("## `refine run`\n")
    header = ["preset", "wall s, two threads", "CPU s", "peak memory, GB"]
    table(header, [[preset, *_run(case, preset, threads=2)] for preset in PRESETS])
    alone = _run(case, "fast", threads=1)[0]
    before = time.perf_counter()
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda _: _run(case, "fast", threads=1), range(2)))
    print("Two jobs side by side, one thread each: ", end="")
    print(f"{2 * alone / (time.perf_counter() - before):.2f} times the throughput of one.\n")


def _run(case: Path, preset: str, threads: int) -> tuple[float, float, float]:
    """Wall seconds, CPU seconds and peak memory (GB) of `refine run` in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command: list[str | Path] = [
            *(sys.executable, "-c", RUN, case / "coarse.obj", case / "silhouette.png"),
            *("--camera", case / "camera.json", "-o", Path(folder) / "out"),
            *("--preset", preset, "--threads", str(threads), "--json"),
        ]
        before = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        lines = process.stdout.readlines()
        _, status, usage = os.wait4(process.pid, 0)
        process.stdout.close()
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"refine run failed with exit code {process.returncode}")
        wall = time.perf_counter() - before
        return wall, usage.ru_utime + usage.ru_stime, int(lines[-1]) / 1e9


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


def scale(options: argparse.Namespace) -> None:
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


def _iteration_in_its_own_process(vertices: int, side: int, root: Path = ROOT) -> Numbers:
    """By the benchmark and the engine of a checkout."""
    program = str(root / "benchmarks" / "engine.py")
    command = [sys.executable, program, "iteration", "--vertices", str(vertices), "--side", str(side)]
    paths = os.pathsep.join(str(root / name) for name in ("engine", "benchmarks"))
    environment = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    numbers: Numbers = json.loads(done.stdout)
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
    of_speed.add_argument("--against", metavar="COMMIT", help="time an iteration of that version in turn")
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
