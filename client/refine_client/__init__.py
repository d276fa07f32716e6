"""The SDK: `RefineClient` and `AsyncRefineClient`, over REST or gRPC as the server's address says.

    with RefineClient("http://127.0.0.1:8000") as client:
        refined = client.refine("coarse.glb", "silhouette.png", camera, "out")

Values are those of `refine_proto.models`, errors those of `refine_proto.errors`. `cli` is `refine`.
"""

from refine_proto.camera_files import read_camera_file
from refine_proto.webhook_messages import WebhookInvalid, WebhookMessage, verify_webhook

from .aio import AsyncRefineClient
from .cases import Case, read_cases
from .client import RefineClient
from .errors import ConnectionLost, DownloadCorrupt
from .refined import Refined
from .retry import RetryPolicy
from .upload import View

__all__ = [
    "AsyncRefineClient",
    "Case",
    "ConnectionLost",
    "DownloadCorrupt",
    "RefineClient",
    "Refined",
    "RetryPolicy",
    "View",
    "WebhookInvalid",
    "WebhookMessage",
    "read_camera_file",
    "read_cases",
    "verify_webhook",
]
