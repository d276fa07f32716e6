"""The metric that tells which version runs, the same for service and worker."""

from __future__ import annotations

import platform
from importlib.metadata import version

from prometheus_client import CollectorRegistry, Gauge


def register_build(registry: CollectorRegistry) -> None:
    """Add refine_build_info, which is always 1."""
    build = Gauge(
        "refine_build_info", "What runs here; always 1.", ["version", "python_version"], registry=registry
    )
    build.labels(version("refine-mesh"), platform.python_version()).set(1)
