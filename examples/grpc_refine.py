"""Refines a mesh with the plain gRPC stub: python examples/grpc_refine.py HOST:PORT FOLDER OUTPUT.glb

FOLDER holds coarse.obj, silhouette.png and camera.json (of type look_at). Any language with gRPC can do the
same from proto/refine_proto/v1/refine.proto.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import grpc
from google.protobuf.json_format import ParseDict

from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub

CHUNK_BYTES = 64 * 1024


def messages(folder: Path) -> Iterator[pb.CreateRefinementRequest]:
    """The header, then both files in chunks."""
    look_at = json.loads((folder / "camera.json").read_text())
    assert look_at.pop("type") == "look_at"
    spec = pb.RefinementSpec(mesh_format=pb.RefinementSpec.OBJ)
    ParseDict(look_at, spec.camera.look_at)
    spec.options.preset = pb.RefinementOptions.FAST
    yield pb.CreateRefinementRequest(header=pb.CreateRefinementRequest.Header(spec=spec))
    for chunk in chunks(folder / "coarse.obj"):
        yield pb.CreateRefinementRequest(mesh_chunk=chunk)
    for chunk in chunks(folder / "silhouette.png"):
        yield pb.CreateRefinementRequest(silhouette_chunk=chunk)


def chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk


def main(address: str, folder: Path, output: Path) -> None:
    with grpc.insecure_channel(address) as channel:
        stub = RefinementsStub(channel)
        refinement = stub.CreateRefinement(messages(folder))
        for event in stub.WatchRefinement(pb.WatchRefinementRequest(id=refinement.id)):
            print(f"{pb.Refinement.State.Name(event.state).lower()} {event.progress.percent:.0f} %")
            if event.HasField("refinement"):
                refinement = event.refinement
        if refinement.state != pb.Refinement.SUCCEEDED:
            sys.exit(f"error: {refinement.error.reason}: {refinement.error.detail}")
        request = pb.DownloadArtifactRequest(id=refinement.id, name="refined.glb")
        with output.open("wb") as file:
            for part in stub.DownloadArtifact(request):
                file.write(part.data)  # empty in the first, which describes the artifact


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
