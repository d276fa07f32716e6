"""What a refinement hands back, by file name (design of the service contract: docs/files.md)."""

from __future__ import annotations

import io
import json
import platform
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import torch

from refine_proto.formats import ArtifactName

from ..cameras.seen import silhouette_iou
from ..contract import judgement_of
from ..files.mesh_file import MeshFile
from ..kernels import interpolate, rasterize
from ..method.config import RefineConfig
from ..method.views import Frame, SymmetryViews
from ..request import Inputs
from ..values import Mesh, Result, View
from .pictures import draw_confidence, draw_preview, drawn_camera, drawn_silhouette

_VERSIONED = ("refine-mesh", "torch", "numpy", "scipy", "numba", "pillow")


def make_artifacts(inputs: Inputs, result: Result, config: RefineConfig) -> dict[str, bytes]:
    """All artifacts of one refinement: `result` is that of `inputs` under `config`.

    refined.glb       the input file with moved vertices and `_SYMMETRY_CONFIDENCE`
    confidence.glb    the welded mesh in the colours of its confidence, see files/colour_scale.py
    confidence.png    the confidence as the first input camera sees it
    confidence.npz    the confidence per vertex and as maps of all symmetry views, see `confidence_arrays`,
                      and what was refined, see `input_arrays`
    preview.png       before and after from that camera, and contours in all views, for people
    report.json       2D IoU, loss curve, effective configuration, seconds, device, versions, warnings
    """
    mesh_file, views = inputs.mesh_file, inputs.views
    vertices, confidence = result.mesh.vertices, result.confidence
    arrays = io.BytesIO()
    np.savez_compressed(arrays, **confidence_arrays(mesh_file, result, config), **input_arrays(inputs))
    report = json.dumps(make_report(inputs, result, config), indent=2, allow_nan=False)
    return {
        ArtifactName.REFINED: mesh_file.with_vertices(vertices, confidence, result.kept_faces),
        ArtifactName.CONFIDENCE_MESH: mesh_file.confidence_glb(vertices, confidence, result.mesh.faces),
        ArtifactName.CONFIDENCE_IMAGE: draw_confidence(views[0], result.mesh, confidence),
        ArtifactName.CONFIDENCE_ARRAYS: arrays.getvalue(),
        ArtifactName.PREVIEW: draw_preview(views, mesh_file.mesh, result.mesh, confidence),
        ArtifactName.REPORT: report.encode() + b"\n",
    }


def confidence_arrays(mesh_file: MeshFile, result: Result, config: RefineConfig) -> dict[str, Any]:
    """The arrays of confidence.npz, float32.

    vertices (V, 3), faces (F, 3)   the refined welded mesh, world units
    vertex (V,)                     confidence per vertex of it
    source_vertex (S,)              confidence per vertex of the input file, NaN where no triangle uses it
    views (2m, N, N)                confidence seen by the m symmetry cameras, then by their m reflections;
                                    NaN on background
    world_to_camera (2m, 4, 4)      those cameras (OpenCV axes), in the frame (x - centre) / scale
    intrinsics (2m, 4)              their fx, fy, cx, cy in pixels
    centre (3,), scale ()           that frame in world units
    """
    confidence = result.confidence.detach().cpu()
    of_source = mesh_file.vertex_of_source
    per_source = torch.where(of_source >= 0, confidence[of_source.clamp_min(0)], torch.nan)
    coarse = Mesh(mesh_file.mesh.vertices.cpu(), mesh_file.mesh.faces.cpu())
    plane = result.plane and replace(result.plane, normal=result.plane.normal.cpu())
    frame = Frame.of(coarse, plane)
    side = config.stages[-1].render_size
    normal = torch.tensor([0.0, 0.0, 1.0]) if plane is None else plane.normal
    views = SymmetryViews.of(config, side, normal)
    vertices, faces = result.mesh.vertices.detach().cpu(), result.mesh.faces.cpu()
    fragments = rasterize(views.project(frame.normalise(vertices)), faces, (side, side))
    maps = interpolate(fragments, faces, confidence)
    arrays = {
        "vertices": vertices,
        "faces": faces,
        "vertex": confidence,
        "source_vertex": per_source,
        "views": torch.where(fragments.face >= 0, maps, torch.nan),
        "world_to_camera": views.world_to_camera,
        "intrinsics": views.intrinsics,
        "centre": frame.centre,
        "scale": torch.tensor(frame.scale),
    }
    return {name: tensor.numpy() for name, tensor in arrays.items()}


def input_arrays(inputs: Inputs) -> dict[str, Any]:
    """The arrays of confidence.npz that show what was refined beside the result.

    coarse_vertices (V, 3)   the welded coarse mesh, world units; row by row the same vertices as `vertices`
    coarse_faces (F, 3)      its faces, of which `faces` are those that were kept
    silhouette (H, W)        of the first view, 1 object, 0 background; at most 1024 pixels a side
    silhouette_camera (4, 4), silhouette_intrinsics (4,), silhouette_orthographic ()
                             who saw it: world_to_camera (OpenCV axes), and fx, fy, cx, cy in its pixels
    """
    mesh, camera = inputs.mesh_file.mesh, drawn_camera(inputs.views[0])
    return {
        "coarse_vertices": mesh.vertices.cpu().numpy(),
        "coarse_faces": mesh.faces.cpu().numpy(),
        "silhouette": drawn_silhouette(inputs.views[0]).astype(np.uint8),
        "silhouette_camera": camera.world_to_camera.cpu().numpy(),
        "silhouette_intrinsics": np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32),
        "silhouette_orthographic": np.uint8(camera.projection == "orthographic"),
    }


def make_report(inputs: Inputs, result: Result, config: RefineConfig) -> dict[str, Any]:
    """report.json as an object."""
    mesh_file = inputs.mesh_file
    device = result.mesh.vertices.device
    return {
        **judgement_of(mesh_file, result, inputs.estimate).model_dump(mode="json"),
        "views": [_of_view(view, mesh_file.mesh, result.mesh.to("cpu")) for view in inputs.views],
        "best_iteration": result.best_iteration,
        "confidence": {
            "min": float(result.confidence.min()),
            "mean": float(result.confidence.mean()),
            "max": float(result.confidence.max()),
        },
        "seconds": result.seconds,
        "device": torch.cuda.get_device_name(device)
        if device.type == "cuda"
        else f"cpu ({platform.machine()})",
        "config": asdict(config),
        "versions": {"python": platform.python_version(), **_versions()},
        "loss_curve": {name: [float(x) for x in curve] for name, curve in result.loss_curve.items()},
    }


def _of_view(view: View, before: Mesh, after: Mesh) -> dict[str, Any]:
    """2D IoU of one view, and the share of its pixels that is known."""
    return {
        "silhouette_iou": {"before": silhouette_iou(before, view), "after": silhouette_iou(after, view)},
        "known": 1.0 if view.known is None else float(view.known.float().mean()),
    }


@cache
def _versions() -> dict[str, str]:
    found = {}
    for name in _VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # run from a source tree that is not installed
            continue
    return found
