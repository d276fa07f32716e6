"""The simulated autoscaler: no job is lost, and the bounds of workers hold."""

import random
import runpy
from pathlib import Path

AUTOSCALE = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks/autoscale.py"))


def test_every_job_starts_and_idle_workers_from_zero_cost_less_than_fixed_ones() -> None:
    world = AUTOSCALE["World"](job_s=20, cold_s=30, slots=4, most=5)
    jobs = len(AUTOSCALE["arrivals"](random.Random(1)))
    results = {
        policy.name: AUTOSCALE["simulate"](policy, world, 1) for policy in AUTOSCALE["policies"](world)
    }
    assert {len(waits) for waits, _ in results.values()} == {jobs}
    assert results["1 worker, fixed"][1] < results["age / 60 s, from 0"][1] < results["5 workers, fixed"][1]
    assert max(results["5 workers, fixed"][0]) < max(results["1 worker, fixed"][0])


def test_an_idle_world_of_a_policy_from_zero_has_no_worker() -> None:
    world = AUTOSCALE["World"](job_s=20, cold_s=30, slots=4, most=5)
    from_zero = [policy for policy in AUTOSCALE["policies"](world) if policy.name.endswith("from 0")]
    assert from_zero
    assert all(policy.wanted(AUTOSCALE["Seen"](0, 0.0, 4)) == 0 for policy in from_zero)
