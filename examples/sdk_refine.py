"""Refine a sample through a server, step by step: submit, watch, download.

python examples/sdk_refine.py [SAMPLE_FOLDER [OUTPUT_FOLDER]]
The server is REFINE_SERVER (http:// or grpc://), the key, if it asks for one, REFINE_API_KEY.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from refine_client import RefineClient
from refine_proto.errors import RefineError


def main(sample: Path, output: Path) -> None:
    camera = json.loads((sample / "camera.json").read_text())
    with RefineClient() as client:
        refinement = client.submit(
            sample / "coarse.obj", sample / "silhouette.png", camera, {"preset": "fast"}
        )
        print(f"{refinement.id} {refinement.state}")
        for event in client.watch(refinement.id):
            if event.progress is not None and event.progress.losses:  # from the first iteration on
                progress = event.progress
                print(
                    f"{progress.iteration}/{progress.total}  loss {progress.losses['total']:.3f}  "
                    f"2D IoU {progress.silhouette_iou:.3f}"
                )
        finished = client.get(refinement.id)
        if finished.error is not None:
            sys.exit(f"{finished.error.reason}: {finished.error.detail}")
        if finished.silhouette_iou is not None:
            print(f"2D IoU {finished.silhouette_iou.before:.3f} -> {finished.silhouette_iou.after:.3f}")
        for path in client.download(refinement.id, output).values():
            print(path)


if __name__ == "__main__":
    sample = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "samples" / "airplane")
    try:
        main(sample, Path(sys.argv[2] if len(sys.argv) > 2 else "out"))
    except RefineError as error:
        sys.exit(f"{error.reason}: {error.detail} (request {error.request_id})")
