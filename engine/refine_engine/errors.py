"""What can go wrong, as a tree. Every message says what was expected, what came and what to do next.

RefineError
├── InputError              the caller's data; running again will not help
│   ├── FormatUnsupported   FORMAT_UNSUPPORTED   not a format we read (Draco, external uri, unknown suffix)
│   ├── MeshInvalid         MESH_INVALID
│   ├── SilhouetteInvalid   SILHOUETTE_INVALID
│   ├── CameraInvalid       CAMERA_INVALID
│   ├── ObjectOutOfView     OBJECT_OUT_OF_VIEW
│   └── OptionsInvalid      OPTIONS_INVALID
├── Diverged                DIVERGED             the optimisation produced NaN or infinity
└── Cancelled               CANCELLED            the caller asked to stop
"""


class RefineError(Exception):
    """Base of all errors of the engine; `reason` is the machine-readable code used by every interface."""

    reason = "INTERNAL"


class InputError(RefineError):
    """The input cannot be used; the message says what was expected and what came."""

    reason = "INPUT_INVALID"


class FormatUnsupported(InputError):
    reason = "FORMAT_UNSUPPORTED"


class MeshInvalid(InputError):
    reason = "MESH_INVALID"


class SilhouetteInvalid(InputError):
    reason = "SILHOUETTE_INVALID"


class CameraInvalid(InputError):
    reason = "CAMERA_INVALID"


class ObjectOutOfView(InputError):
    reason = "OBJECT_OUT_OF_VIEW"


class OptionsInvalid(InputError):
    reason = "OPTIONS_INVALID"


class Diverged(RefineError):
    reason = "DIVERGED"


class Cancelled(RefineError):
    reason = "CANCELLED"
