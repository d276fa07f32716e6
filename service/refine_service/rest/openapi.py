"""What /openapi.json says beyond what FastAPI reads from the routes: bodies, examples, every error answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import JsonSchemaMode, models_json_schema

from refine_proto.errors import TABLE, error_class
from refine_proto.formats import ARTIFACTS, IMAGE_PARTS, MESH, SILHOUETTE_THRESHOLD, ArtifactName, address_of
from refine_proto.models import Event, ProblemDetails, Refinement, RefinementRequest, View

_REFERENCE = "#/components/schemas/{model}"
_MODELS: list[tuple[type[BaseModel], JsonSchemaMode]] = [
    (RefinementRequest, "validation"),
    (View, "validation"),
    (Refinement, "serialization"),
    (Event, "serialization"),
    (ProblemDetails, "serialization"),
]
_CAMERA = {
    "type": "look_at",
    "azimuth_degrees": 30,
    "elevation_degrees": 20,
    "distance": 1.9,
    "fov_y_degrees": 60,
}
_OPTIONS = {"preset": "default", "seed": 0}
_REFINEMENT = {
    "id": "0f8fad5bd9cb469fa165708677289503",
    "state": "succeeded",
    "options": {
        **_OPTIONS,
        "symmetry_normal": [0, 0, 1],
        "silhouette_threshold": SILHOUETTE_THRESHOLD,
        "timeout_s": 3600,
    },
    "artifacts": [
        {
            "name": ArtifactName.REFINED,
            "media_type": ARTIFACTS[ArtifactName.REFINED],
            "size_bytes": 48_212,
            "sha256": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
            "url": "/v1/refinements/0f8fad5bd9cb469fa165708677289503/artifacts/refined.glb",
        }
    ],
    "created_at": "2026-01-01T12:00:00Z",
    "started_at": "2026-01-01T12:00:01Z",
    "finished_at": "2026-01-01T12:00:31Z",
    "expires_at": "2026-01-02T12:00:31Z",
    "silhouette_iou": {"before": 0.71, "after": 0.93},
    "outcome": "refined",
    "mirror_plane": {"normal": [0.0, 0.0, 1.0], "offset": 0.0, "error": 0.012},
    "mesh_counts": {
        "vertices": 120_000,
        "faces": 240_000,
        "source_vertices": 131_204,
        "optimised_vertices": 1500,
        "optimised_faces": 2996,
        "refined_vertices": 120_000,
        "refined_faces": 238_912,
        "removed_faces": 1088,
    },
    "attempt": 1,
    "urls": {
        "refinement": "/v1/refinements/0f8fad5bd9cb469fa165708677289503",
        "events": "/v1/refinements/0f8fad5bd9cb469fa165708677289503/events",
        "cancel": "/v1/refinements/0f8fad5bd9cb469fa165708677289503/cancel",
    },
}
_QUEUED = {
    **{name: _REFINEMENT[name] for name in ("id", "options", "created_at", "expires_at", "urls")},
    "state": "queued",
    "queue_position": 0,
    "attempt": 0,
}
_IMAGE = "The silhouette: a PNG, JPEG, WebP, TIFF or BMP file."
_UNKNOWN = "An image of the same size: where it shows an object, nothing is known."
_BINARY = {"schema": {"type": "string", "format": "binary"}}


def _of(model: type) -> dict[str, str]:
    return {"$ref": _REFERENCE.format(model=model.__name__)}


FINISHED: dict[str, Any] = {
    "description": "The refinement has ended.",
    "content": {
        "application/json": {"schema": _of(Refinement), "example": _REFINEMENT},
        "model/gltf-binary": _BINARY,
    },
}
ACCEPTED: dict[str, Any] = {
    "description": "The refinement goes on.",
    "headers": {"Location": {"schema": {"type": "string"}, "description": "Where the refinement is."}},
    "content": {"application/json": {"schema": _of(Refinement), "example": _QUEUED}},
}
EVENTS: dict[str, Any] = {
    "description": "Server-sent events; `event` is the type, `id` the sequence, `data` an Event.",
    "content": {
        "text/event-stream": {
            "example": 'event: state\ndata: {"sequence": 1, "state": "queued", ...}\nid: 1\n\n',
        }
    },
}
DESCRIBED: dict[str, Any] = {
    "description": "What the bytes are, without them.",
    "headers": {
        "ETag": {"schema": {"type": "string"}, "description": "Their SHA-256."},
        "Content-Length": {"schema": {"type": "integer"}, "description": "How many they are."},
    },
}
WHOLE: dict[str, Any] = {
    **DESCRIBED,
    "description": "The bytes.",
    "content": dict.fromkeys(ARTIFACTS.values(), _BINARY),
}
PART: dict[str, Any] = {**WHOLE, "description": "The bytes of the range."}
NOT_MODIFIED: dict[str, Any] = {"description": "The caller has these bytes."}
CREATE_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["camera"],
                "additionalProperties": False,
                "properties": {
                    "mesh": {"type": "string", "format": "binary", "description": "The coarse mesh file."},
                    "silhouette": {"type": "string", "format": "binary", "description": _IMAGE},
                    "ignore": {"type": "string", "format": "binary", "description": _UNKNOWN},
                    "camera": {"$ref": _REFERENCE.format(model="CameraSpec")},
                    "options": {"$ref": _REFERENCE.format(model="RefinementOptions")},
                    "mesh_format": {"$ref": _REFERENCE.format(model="MeshFormat")},
                    "views": {"type": "array", "items": {"$ref": _REFERENCE.format(model="View")}},
                    "webhook": {"$ref": _REFERENCE.format(model="Webhook")},
                    "metadata": {"$ref": _REFERENCE.format(model="Metadata")},
                    **{name: {"type": "string", "format": "binary"} for name in IMAGE_PARTS[2:]},
                    **{
                        address_of(name): {
                            "type": "string",
                            "maxLength": 2048,
                            "description": f"https address of `{name}`, in its place.",
                        }
                        for name in (MESH, *IMAGE_PARTS)
                    },
                },
            },
            "encoding": {
                "mesh": {"contentType": "application/octet-stream"},
                "silhouette": {"contentType": "image/png, image/jpeg, image/webp, image/tiff, image/bmp"},
                "camera": {"contentType": "application/json"},
                "options": {"contentType": "application/json"},
                "views": {"contentType": "application/json"},
                "webhook": {"contentType": "application/json"},
                "metadata": {"contentType": "application/json"},
            },
            "example": {"mesh": "(file)", "silhouette": "(file)", "camera": _CAMERA, "options": _OPTIONS},
        },
        "application/json": {
            "schema": _of(RefinementRequest),
            "example": {
                "mesh": "diAwIDAgMAo=",
                "silhouette": "iVBORw0KGgo=",
                "mesh_format": "obj",
                "camera": _CAMERA,
                "options": _OPTIONS,
            },
        },
    },
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The error answers of a route: problem details, with an example for each reason of the status."""
    return {status: _problem(status) for status in statuses}


def without_content(answers: dict[int | str, dict[str, Any]]) -> dict[int | str, dict[str, Any]]:
    """The same answers to HEAD."""
    return {status: {"description": answer["description"]} for status, answer in answers.items()}


def _problem(status: int) -> dict[str, Any]:
    reasons = [reason for reason, row in TABLE.items() if row.http == status]
    answer: dict[str, Any] = {
        "description": ", ".join(reasons),
        "content": {
            "application/problem+json": {
                "schema": _of(ProblemDetails),
                "examples": {reason: {"value": _example(reason)} for reason in reasons},
            }
        },
    }
    if status in (429, 503):
        answer["headers"] = {"Retry-After": {"schema": {"type": "integer"}, "description": "Seconds."}}
    return answer


def _example(reason: str) -> dict[str, Any]:
    error = error_class(reason)("expected ..., got ...; what to do next")
    return error.problem(request_id="6f1d").model_dump(mode="json", exclude_none=True)


def describe(app: FastAPI) -> Callable[[], dict[str, Any]]:
    """The replacement of `app.openapi`: adds the models that are named only by reference."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(
                title=app.title,
                version=app.version,
                description=app.description,
                routes=app.routes,
                servers=app.servers,
                contact=app.contact,
                license_info=app.license_info,
            )
            _, definitions = models_json_schema(_MODELS, ref_template=_REFERENCE)
            schemas = document.setdefault("components", {}).setdefault("schemas", {})
            document["components"]["schemas"] = {**definitions["$defs"], **schemas}
            for unused in ("HTTPValidationError", "ValidationError"):  # FastAPI's own; ours are problems
                document["components"]["schemas"].pop(unused, None)
            app.openapi_schema = document
        return app.openapi_schema

    return openapi
