"""Measures the engine on a CUDA card and prints Markdown tables: python benchmarks/cards.py [--help]

Time per preset after warm-up, the parts of an iteration, memory per instance, one to eight instances side by
side as processes and as streams of one process, the first job of a process, and how soon a cancellation acts.
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
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from refine_bench.measure import screen_of
from refine_engine import Cancelled, Mesh, RefineConfig, View, make_config, read_camera, read_inputs, refine
from refine_engine.kernels import image_symmetry, optical_depth, rasterize
from refine_engine.kernels.cuda import keep_float32
from refine_engine.kernels.graph import EAGER_RUNS, repeatable
from refine_engine.method.loop import Fit
from refine_engine.method.presets import PRESETS
from refine_engine.method.whole_mesh import fit_whole_mesh

SAMPLES = Path(__file__).parents[1] / "examples" / "samples"
MIB = 2**20
Case = tuple[Mesh, list[View]]


@dataclass(frozen=True)
class Run:
    """What one process or stream did in a race."""

    seconds: float  # of all its refinements
    memory_mib: float  # most that torch's allocator held, beyond the CUDA context


def load(sample: Path, device: torch.device) -> Case:
    """A sample's coarse mesh and silhouette, on the device."""
    camera = read_camera((sample / "camera.json").read_bytes())
    mesh_bytes, image_bytes = (sample / "coarse.obj").read_bytes(), (sample / "silhouette.png").read_bytes()
    inputs = read_inputs(mesh_bytes, "coarse.obj", image_bytes, camera)
    return inputs.mesh_file.mesh.to(device), [view.to(device) for view in inputs.views]


def make_working(preset: str, iterations: int | None) -> RefineConfig:
    """The preset that also refines a mesh which agrees already, so that there is work to time."""
    return replace(make_config(preset, iterations=iterations), agreement=None)


def wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def seconds_of(work: Callable[[], object], device: torch.device) -> float:
    """Wall time of one call, to the end of what it queued."""
    wait_for(device)
    start = time.perf_counter()
    work()
    wait_for(device)
    return time.perf_counter() - start


def peak_mib(device: torch.device) -> float:
    return torch.cuda.max_memory_reserved(device) / MIB if device.type == "cuda" else float("nan")


def time_presets(
    case: Case, device: torch.device, configs: dict[str, RefineConfig], repeats: int
) -> list[list[str]]:
    """Rows: preset, first run in this process, median, least and most after it, memory."""
    rows = []
    for name, config in configs.items():
        if device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(device)

        def once(config: RefineConfig = config) -> object:
            return refine(*case, config)

        first = seconds_of(once, device)
        times = [seconds_of(once, device) for _ in range(repeats)]
        numbers = [first, statistics.median(times), min(times), max(times)]
        rows.append([name, *(f"{n:.3f}" for n in numbers), f"{peak_mib(device):.0f}"])
    return rows


def parts_of_iteration(fit: Fit) -> dict[str, Callable[[], object]]:
    """Each part of an iteration by itself, forward and backward, on the state of `fit`."""
    network, faces, side = fit.network, fit.seen_faces, fit.stage.render_size
    with torch.no_grad():
        features = fit.features().detach()
        screen = screen_of(fit)
    confidence = torch.full_like(fit.coarse[:, 0], 0.5)

    def back(output: Tensor) -> None:
        output.sum().backward()

    def refiner() -> None:
        offsets, sigma = network(features, fit.coarse, fit.topology)
        back(offsets.sum() + sigma.sum() if fit.config.learn_confidence else offsets)

    def vertex_symmetry() -> None:
        back(fit.mirrored(leaf(fit.coarse), leaf(confidence))[1])

    parts: dict[str, Callable[[], object]] = {
        "graph convolutions and heads": refiner,
        "soft renders": lambda: back(optical_depth(leaf(screen), faces, side, fit.stage.softness)),
        **(parts_of_image_symmetry(fit, screen, confidence) if len(screen) > len(fit.views) else {}),
        "vertex symmetry": vertex_symmetry,
        "optimiser": fit.optimiser.step,
        "whole iteration": fit.step,
    }
    if fit.config.train_encoder:
        parts = {"encoder": lambda: back(fit.features()), **parts}
    return parts


def parts_of_image_symmetry(fit: Fit, screen: Tensor, confidence: Tensor) -> dict[str, Callable[[], object]]:
    """What the view pairs, after the input views on `screen`, cost beside their soft renders."""
    faces, side, cost = fit.seen_faces, fit.stage.render_size, fit.config.confidence_cost
    pairs = screen[len(fit.views) :]
    other = pairs[len(pairs) // 2 :]
    with torch.no_grad():
        seen, mirrored = optical_depth(pairs, faces, side, fit.stage.softness).chunk(2)
        visible = rasterize(other, faces, (side, side))

    def loss() -> None:
        image_symmetry(leaf(seen), leaf(mirrored), visible, faces, leaf(confidence), cost).backward()

    return {
        "hard renders": lambda: rasterize(other, faces, (side, side)),
        "image symmetry": loss,
    }


def leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().requires_grad_()


def time_parts(case: Case, device: torch.device, config: RefineConfig, runs: int) -> list[list[str]]:
    """Rows: part, milliseconds replayed as a graph of its own, share of the whole iteration."""
    stage = replace(config.stages[-1], iterations=runs + EAGER_RUNS + 2)
    config = replace(config, stages=(stage,))
    fit = Fit(fit_whole_mesh(*case, config), config)
    fit.enter(stage)
    with repeatable(fit.step, device) as step:
        step()  # makes the gradients and the optimiser's state
    milliseconds = {}
    for name, part in parts_of_iteration(fit).items():

        def call(part: Callable[[], object] = part) -> None:
            part()

        with repeatable(call, device) as replay:
            for _ in range(EAGER_RUNS + 1 if device.type == "cuda" else 0):
                replay()

            def loop(replay: Callable[[], None] = replay) -> None:
                for _ in range(runs):
                    replay()

            milliseconds[name] = 1000 * seconds_of(loop, device) / runs
    whole = milliseconds["whole iteration"]
    return [[name, f"{ms:.3f}", f"{100 * ms / whole:.0f} %"] for name, ms in milliseconds.items()]


def race_streams(
    case: Case, device: torch.device, config: RefineConfig, instances: int, repeats: int
) -> list[Run]:
    """`instances` threads of this process, each with a stream of its own and its own graph."""
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    wait_for(device)  # the case was put on the card by another stream
    barrier = threading.Barrier(instances)
    runs: list[Run] = []
    failures: list[BaseException] = []

    def compete() -> None:
        own = torch.cuda.stream(torch.cuda.Stream(device)) if device.type == "cuda" else nullcontext()
        try:
            with own:
                refine(*case, config)
                barrier.wait()
                start = time.perf_counter()
                for _ in range(repeats):
                    refine(*case, config)
                runs.append(Run(time.perf_counter() - start, peak_mib(device) / instances))
        except BaseException as failure:
            barrier.abort()
            failures.append(failure)

    threads = [threading.Thread(target=compete) for _ in range(instances)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    return runs


def race_processes(arguments: Sequence[str], instances: int) -> list[Run]:
    """`instances` processes of this script: all warm up, then all start together."""
    command = [sys.executable, __file__, *arguments, "--racer"]
    racers = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(instances)
    ]
    try:
        for racer in racers:
            assert racer.stdout is not None
            if racer.stdout.readline().strip() != "ready":
                code = racer.wait()
                raise SystemExit(f"a process of the race ended before it was ready, with exit code {code}")
        for racer in racers:
            assert racer.stdin is not None
            racer.stdin.write("go\n")
            racer.stdin.flush()
        return [Run(**json.loads(racer.communicate()[0])) for racer in racers]
    finally:
        for racer in racers:
            racer.kill()
            with racer:  # closes its pipes, waits
                pass


def be_racer(case: Case, device: torch.device, config: RefineConfig, repeats: int) -> None:
    """The other end of `race_processes`."""
    refine(*case, config)
    wait_for(device)
    print("ready", flush=True)
    sys.stdin.readline()

    def all_of_them() -> None:
        for _ in range(repeats):
            refine(*case, config)

    print(json.dumps(vars(Run(seconds_of(all_of_them, device), peak_mib(device)))), flush=True)


def race_rows(kind: str, races: dict[int, list[Run]], repeats: int) -> list[list[str]]:
    """Rows: kind, instances, refinements a minute, ratio to one instance, slowest, memory of each."""
    rows = []
    base = None
    for instances, runs in races.items():
        longest = max(run.seconds for run in runs)
        throughput = instances * repeats / longest
        base = base or throughput / instances
        memory = max(run.memory_mib for run in runs)
        numbers = [
            f"{60 * throughput:.1f}",
            f"{throughput / base:.2f}",
            f"{longest / repeats:.3f}",
            f"{memory:.0f}",
        ]
        rows.append([kind, str(instances), *numbers])
    return rows


def first_jobs(arguments: Sequence[str]) -> list[list[str]]:
    """Rows: what was there before, seconds from the start of a process to the end of its first refinement."""
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "XDG_CACHE_HOME": cache}
        for state in ("no compiled kernels", "kernels compiled by the process before"):
            start = time.perf_counter()
            command = [sys.executable, __file__, *arguments, "--racer", "--repeats", "0"]
            subprocess.run(command, env=environment, input="go\n", text=True, check=True, capture_output=True)
            rows.append([state, f"{time.perf_counter() - start:.1f}"])
    return rows


def cancellation_ms(case: Case, config: RefineConfig, after_s: float) -> float:
    """Milliseconds from the request, made `after_s` seconds into a run, to the end of `refine`."""
    requested = threading.Event()
    at: list[float] = []

    def request() -> None:
        at.append(time.perf_counter())
        requested.set()

    timer = threading.Timer(after_s, request)
    timer.start()
    try:
        refine(*case, config, cancelled=requested.is_set)
    except Cancelled:
        return 1000 * (time.perf_counter() - at[0])
    finally:
        timer.cancel()
    raise SystemExit(f"the run ended before it could be cancelled after {after_s} s; give more --iterations")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def describe(device: torch.device) -> str:
    properties = torch.cuda.get_device_properties(device)
    return (
        f"{properties.name}, compute capability {properties.major}.{properties.minor}, "
        f"{properties.total_memory // MIB} MiB; torch {torch.__version__}, CUDA {torch.version.cuda}; "
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    )


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sample", type=Path, default=SAMPLES / "airplane", help="folder of an example")
    parser.add_argument("--preset", choices=list(PRESETS), default="paper", help="of all but the first table")
    parser.add_argument("--iterations", type=int, help="instead of the presets' own")
    parser.add_argument("--instances", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--repeats", type=int, default=5, help="refinements after the first")
    parser.add_argument("--device", type=torch.device, default=torch.device("cuda:0"))
    parser.add_argument("--racer", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def main() -> int:
    """Print the tables; 2 without a card."""
    options = parse(None)
    if not torch.cuda.is_available():
        print(
            f"expected a CUDA device, got none (torch {torch.__version__}, its CUDA {torch.version.cuda}); "
            "run this on a machine with an NVIDIA card, its driver and a CUDA build of torch",
            file=sys.stderr,
        )
        return 2
    device = options.device
    torch.cuda.set_device(device)
    keep_float32()
    case = load(options.sample, device)
    config = make_working(options.preset, options.iterations)
    if options.racer:
        be_racer(case, device, config, options.repeats)
        return 0

    print(describe(device), f"{options.sample.name}: {len(case[0].vertices)} vertices\n", sep="\n")
    configs = {name: make_working(name, options.iterations) for name in PRESETS}
    header = ["preset", "first run s", "median s", "least s", "most s", "memory MiB"]
    print(table(header, time_presets(case, device, configs, options.repeats)))
    header = [f"part of an iteration of {options.preset}", "ms", "share"]
    print(table(header, time_parts(case, device, config, 100)))

    arguments = ["--sample", str(options.sample), "--preset", options.preset, "--device", str(device)]
    arguments += ["--iterations", str(config.iterations)]
    repeated = [*arguments, "--repeats", str(options.repeats)]
    processes = {n: race_processes(repeated, n) for n in options.instances}
    streams = {n: race_streams(case, device, config, n, options.repeats) for n in options.instances}
    header = [
        "instances as",
        "instances",
        "refinements a minute",
        "ratio to one",
        "slowest s",
        "memory of each MiB",
    ]
    rows = race_rows("processes", processes, options.repeats) + race_rows("streams", streams, options.repeats)
    print(table(header, rows))
    print(table(["first job of a process", "s"], first_jobs(arguments)))
    late = max(cancellation_ms(case, make_config("paper", iterations=10_000), 1 + 0.13 * k) for k in range(5))
    print(f"Cancellation: at most {late:.0f} ms in 5 trials.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
