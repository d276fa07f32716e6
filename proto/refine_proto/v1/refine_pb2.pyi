import datetime

from google.protobuf import empty_pb2 as _empty_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class RefinementOptions(_message.Message):
    __slots__ = ("preset", "iterations", "seed", "symmetry_normal", "symmetry_offset", "silhouette_threshold", "timeout_s", "symmetry", "topology", "correct_camera", "checks", "subdivide", "priority", "ignore_grey")
    class Preset(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        PRESET_UNSPECIFIED: _ClassVar[RefinementOptions.Preset]
        PAPER: _ClassVar[RefinementOptions.Preset]
        DEFAULT: _ClassVar[RefinementOptions.Preset]
        FAST: _ClassVar[RefinementOptions.Preset]
    PRESET_UNSPECIFIED: RefinementOptions.Preset
    PAPER: RefinementOptions.Preset
    DEFAULT: RefinementOptions.Preset
    FAST: RefinementOptions.Preset
    class Symmetry(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        SYMMETRY_UNSPECIFIED: _ClassVar[RefinementOptions.Symmetry]
        AUTO: _ClassVar[RefinementOptions.Symmetry]
        PLANE: _ClassVar[RefinementOptions.Symmetry]
        NONE: _ClassVar[RefinementOptions.Symmetry]
    SYMMETRY_UNSPECIFIED: RefinementOptions.Symmetry
    AUTO: RefinementOptions.Symmetry
    PLANE: RefinementOptions.Symmetry
    NONE: RefinementOptions.Symmetry
    class Topology(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        TOPOLOGY_UNSPECIFIED: _ClassVar[RefinementOptions.Topology]
        OPEN: _ClassVar[RefinementOptions.Topology]
        FIXED: _ClassVar[RefinementOptions.Topology]
    TOPOLOGY_UNSPECIFIED: RefinementOptions.Topology
    OPEN: RefinementOptions.Topology
    FIXED: RefinementOptions.Topology
    class Checks(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        CHECKS_UNSPECIFIED: _ClassVar[RefinementOptions.Checks]
        STRICT: _ClassVar[RefinementOptions.Checks]
        WARN: _ClassVar[RefinementOptions.Checks]
        OFF: _ClassVar[RefinementOptions.Checks]
    CHECKS_UNSPECIFIED: RefinementOptions.Checks
    STRICT: RefinementOptions.Checks
    WARN: RefinementOptions.Checks
    OFF: RefinementOptions.Checks
    class Priority(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        PRIORITY_UNSPECIFIED: _ClassVar[RefinementOptions.Priority]
        LOW: _ClassVar[RefinementOptions.Priority]
        NORMAL: _ClassVar[RefinementOptions.Priority]
        HIGH: _ClassVar[RefinementOptions.Priority]
    PRIORITY_UNSPECIFIED: RefinementOptions.Priority
    LOW: RefinementOptions.Priority
    NORMAL: RefinementOptions.Priority
    HIGH: RefinementOptions.Priority
    PRESET_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SYMMETRY_NORMAL_FIELD_NUMBER: _ClassVar[int]
    SYMMETRY_OFFSET_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_THRESHOLD_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_S_FIELD_NUMBER: _ClassVar[int]
    SYMMETRY_FIELD_NUMBER: _ClassVar[int]
    TOPOLOGY_FIELD_NUMBER: _ClassVar[int]
    CORRECT_CAMERA_FIELD_NUMBER: _ClassVar[int]
    CHECKS_FIELD_NUMBER: _ClassVar[int]
    SUBDIVIDE_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    IGNORE_GREY_FIELD_NUMBER: _ClassVar[int]
    preset: RefinementOptions.Preset
    iterations: int
    seed: int
    symmetry_normal: _containers.RepeatedScalarFieldContainer[float]
    symmetry_offset: float
    silhouette_threshold: float
    timeout_s: float
    symmetry: RefinementOptions.Symmetry
    topology: RefinementOptions.Topology
    correct_camera: bool
    checks: RefinementOptions.Checks
    subdivide: bool
    priority: RefinementOptions.Priority
    ignore_grey: int
    def __init__(self, preset: _Optional[_Union[RefinementOptions.Preset, str]] = ..., iterations: _Optional[int] = ..., seed: _Optional[int] = ..., symmetry_normal: _Optional[_Iterable[float]] = ..., symmetry_offset: _Optional[float] = ..., silhouette_threshold: _Optional[float] = ..., timeout_s: _Optional[float] = ..., symmetry: _Optional[_Union[RefinementOptions.Symmetry, str]] = ..., topology: _Optional[_Union[RefinementOptions.Topology, str]] = ..., correct_camera: bool = ..., checks: _Optional[_Union[RefinementOptions.Checks, str]] = ..., subdivide: bool = ..., priority: _Optional[_Union[RefinementOptions.Priority, str]] = ..., ignore_grey: _Optional[int] = ...) -> None: ...

class CameraSpec(_message.Message):
    __slots__ = ("look_at", "matrix", "pytorch3d", "network", "estimate")
    LOOK_AT_FIELD_NUMBER: _ClassVar[int]
    MATRIX_FIELD_NUMBER: _ClassVar[int]
    PYTORCH3D_FIELD_NUMBER: _ClassVar[int]
    NETWORK_FIELD_NUMBER: _ClassVar[int]
    ESTIMATE_FIELD_NUMBER: _ClassVar[int]
    look_at: LookAtCamera
    matrix: MatrixCamera
    pytorch3d: PyTorch3DCamera
    network: NetworkCamera
    estimate: EstimatedCamera
    def __init__(self, look_at: _Optional[_Union[LookAtCamera, _Mapping]] = ..., matrix: _Optional[_Union[MatrixCamera, _Mapping]] = ..., pytorch3d: _Optional[_Union[PyTorch3DCamera, _Mapping]] = ..., network: _Optional[_Union[NetworkCamera, _Mapping]] = ..., estimate: _Optional[_Union[EstimatedCamera, _Mapping]] = ...) -> None: ...

class LookAtCamera(_message.Message):
    __slots__ = ("azimuth_degrees", "elevation_degrees", "distance", "fov_y_degrees", "fov_x_degrees", "roll_degrees")
    AZIMUTH_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ELEVATION_DEGREES_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    FOV_Y_DEGREES_FIELD_NUMBER: _ClassVar[int]
    FOV_X_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ROLL_DEGREES_FIELD_NUMBER: _ClassVar[int]
    azimuth_degrees: float
    elevation_degrees: float
    distance: float
    fov_y_degrees: float
    fov_x_degrees: float
    roll_degrees: float
    def __init__(self, azimuth_degrees: _Optional[float] = ..., elevation_degrees: _Optional[float] = ..., distance: _Optional[float] = ..., fov_y_degrees: _Optional[float] = ..., fov_x_degrees: _Optional[float] = ..., roll_degrees: _Optional[float] = ...) -> None: ...

class MatrixCamera(_message.Message):
    __slots__ = ("convention", "world_to_camera", "camera_to_world", "intrinsics", "fov_y_degrees", "projection", "fov_x_degrees")
    class Convention(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        CONVENTION_UNSPECIFIED: _ClassVar[MatrixCamera.Convention]
        OPENCV: _ClassVar[MatrixCamera.Convention]
        OPENGL: _ClassVar[MatrixCamera.Convention]
        PYTORCH3D: _ClassVar[MatrixCamera.Convention]
    CONVENTION_UNSPECIFIED: MatrixCamera.Convention
    OPENCV: MatrixCamera.Convention
    OPENGL: MatrixCamera.Convention
    PYTORCH3D: MatrixCamera.Convention
    class Projection(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        PROJECTION_UNSPECIFIED: _ClassVar[MatrixCamera.Projection]
        PERSPECTIVE: _ClassVar[MatrixCamera.Projection]
        ORTHOGRAPHIC: _ClassVar[MatrixCamera.Projection]
    PROJECTION_UNSPECIFIED: MatrixCamera.Projection
    PERSPECTIVE: MatrixCamera.Projection
    ORTHOGRAPHIC: MatrixCamera.Projection
    CONVENTION_FIELD_NUMBER: _ClassVar[int]
    WORLD_TO_CAMERA_FIELD_NUMBER: _ClassVar[int]
    CAMERA_TO_WORLD_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    FOV_Y_DEGREES_FIELD_NUMBER: _ClassVar[int]
    PROJECTION_FIELD_NUMBER: _ClassVar[int]
    FOV_X_DEGREES_FIELD_NUMBER: _ClassVar[int]
    convention: MatrixCamera.Convention
    world_to_camera: _containers.RepeatedScalarFieldContainer[float]
    camera_to_world: _containers.RepeatedScalarFieldContainer[float]
    intrinsics: Intrinsics
    fov_y_degrees: float
    projection: MatrixCamera.Projection
    fov_x_degrees: float
    def __init__(self, convention: _Optional[_Union[MatrixCamera.Convention, str]] = ..., world_to_camera: _Optional[_Iterable[float]] = ..., camera_to_world: _Optional[_Iterable[float]] = ..., intrinsics: _Optional[_Union[Intrinsics, _Mapping]] = ..., fov_y_degrees: _Optional[float] = ..., projection: _Optional[_Union[MatrixCamera.Projection, str]] = ..., fov_x_degrees: _Optional[float] = ...) -> None: ...

class PyTorch3DCamera(_message.Message):
    __slots__ = ("R", "T", "intrinsics", "fov_y_degrees", "fov_x_degrees")
    R_FIELD_NUMBER: _ClassVar[int]
    T_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    FOV_Y_DEGREES_FIELD_NUMBER: _ClassVar[int]
    FOV_X_DEGREES_FIELD_NUMBER: _ClassVar[int]
    R: _containers.RepeatedScalarFieldContainer[float]
    T: _containers.RepeatedScalarFieldContainer[float]
    intrinsics: Intrinsics
    fov_y_degrees: float
    fov_x_degrees: float
    def __init__(self, R: _Optional[_Iterable[float]] = ..., T: _Optional[_Iterable[float]] = ..., intrinsics: _Optional[_Union[Intrinsics, _Mapping]] = ..., fov_y_degrees: _Optional[float] = ..., fov_x_degrees: _Optional[float] = ...) -> None: ...

class NetworkCamera(_message.Message):
    __slots__ = ("name", "azimuth_degrees", "elevation_degrees", "distance", "fov_y_degrees")
    class Name(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        NAME_UNSPECIFIED: _ClassVar[NetworkCamera.Name]
        TRIPOSR: _ClassVar[NetworkCamera.Name]
        SF3D: _ClassVar[NetworkCamera.Name]
        INSTANTMESH: _ClassVar[NetworkCamera.Name]
        TRELLIS: _ClassVar[NetworkCamera.Name]
        HUNYUAN3D: _ClassVar[NetworkCamera.Name]
        PIXEL2MESH: _ClassVar[NetworkCamera.Name]
        OCCNET: _ClassVar[NetworkCamera.Name]
    NAME_UNSPECIFIED: NetworkCamera.Name
    TRIPOSR: NetworkCamera.Name
    SF3D: NetworkCamera.Name
    INSTANTMESH: NetworkCamera.Name
    TRELLIS: NetworkCamera.Name
    HUNYUAN3D: NetworkCamera.Name
    PIXEL2MESH: NetworkCamera.Name
    OCCNET: NetworkCamera.Name
    NAME_FIELD_NUMBER: _ClassVar[int]
    AZIMUTH_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ELEVATION_DEGREES_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    FOV_Y_DEGREES_FIELD_NUMBER: _ClassVar[int]
    name: NetworkCamera.Name
    azimuth_degrees: float
    elevation_degrees: float
    distance: float
    fov_y_degrees: float
    def __init__(self, name: _Optional[_Union[NetworkCamera.Name, str]] = ..., azimuth_degrees: _Optional[float] = ..., elevation_degrees: _Optional[float] = ..., distance: _Optional[float] = ..., fov_y_degrees: _Optional[float] = ...) -> None: ...

class EstimatedCamera(_message.Message):
    __slots__ = ("fov_y_degrees", "fov_x_degrees", "azimuth_degrees", "elevation_degrees", "roll_degrees")
    FOV_Y_DEGREES_FIELD_NUMBER: _ClassVar[int]
    FOV_X_DEGREES_FIELD_NUMBER: _ClassVar[int]
    AZIMUTH_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ELEVATION_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ROLL_DEGREES_FIELD_NUMBER: _ClassVar[int]
    fov_y_degrees: float
    fov_x_degrees: float
    azimuth_degrees: float
    elevation_degrees: float
    roll_degrees: float
    def __init__(self, fov_y_degrees: _Optional[float] = ..., fov_x_degrees: _Optional[float] = ..., azimuth_degrees: _Optional[float] = ..., elevation_degrees: _Optional[float] = ..., roll_degrees: _Optional[float] = ...) -> None: ...

class Intrinsics(_message.Message):
    __slots__ = ("fx", "fy", "cx", "cy", "width", "height")
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    def __init__(self, fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ..., width: _Optional[int] = ..., height: _Optional[int] = ...) -> None: ...

class RefinementSpec(_message.Message):
    __slots__ = ("camera", "options", "mesh_format", "views", "webhook", "metadata")
    class MeshFormat(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        MESH_FORMAT_UNSPECIFIED: _ClassVar[RefinementSpec.MeshFormat]
        GLB: _ClassVar[RefinementSpec.MeshFormat]
        GLTF: _ClassVar[RefinementSpec.MeshFormat]
        OBJ: _ClassVar[RefinementSpec.MeshFormat]
        PLY: _ClassVar[RefinementSpec.MeshFormat]
        STL: _ClassVar[RefinementSpec.MeshFormat]
        OFF: _ClassVar[RefinementSpec.MeshFormat]
        ZIP: _ClassVar[RefinementSpec.MeshFormat]
        BINVOX: _ClassVar[RefinementSpec.MeshFormat]
        NPZ: _ClassVar[RefinementSpec.MeshFormat]
    MESH_FORMAT_UNSPECIFIED: RefinementSpec.MeshFormat
    GLB: RefinementSpec.MeshFormat
    GLTF: RefinementSpec.MeshFormat
    OBJ: RefinementSpec.MeshFormat
    PLY: RefinementSpec.MeshFormat
    STL: RefinementSpec.MeshFormat
    OFF: RefinementSpec.MeshFormat
    ZIP: RefinementSpec.MeshFormat
    BINVOX: RefinementSpec.MeshFormat
    NPZ: RefinementSpec.MeshFormat
    class MetadataEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    MESH_FORMAT_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    WEBHOOK_FIELD_NUMBER: _ClassVar[int]
    METADATA_FIELD_NUMBER: _ClassVar[int]
    camera: CameraSpec
    options: RefinementOptions
    mesh_format: RefinementSpec.MeshFormat
    views: _containers.RepeatedCompositeFieldContainer[View]
    webhook: Webhook
    metadata: _containers.ScalarMap[str, str]
    def __init__(self, camera: _Optional[_Union[CameraSpec, _Mapping]] = ..., options: _Optional[_Union[RefinementOptions, _Mapping]] = ..., mesh_format: _Optional[_Union[RefinementSpec.MeshFormat, str]] = ..., views: _Optional[_Iterable[_Union[View, _Mapping]]] = ..., webhook: _Optional[_Union[Webhook, _Mapping]] = ..., metadata: _Optional[_Mapping[str, str]] = ...) -> None: ...

class View(_message.Message):
    __slots__ = ("camera",)
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    camera: CameraSpec
    def __init__(self, camera: _Optional[_Union[CameraSpec, _Mapping]] = ...) -> None: ...

class Webhook(_message.Message):
    __slots__ = ("url", "events")
    class Event(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        EVENT_UNSPECIFIED: _ClassVar[Webhook.Event]
        SUCCEEDED: _ClassVar[Webhook.Event]
        FAILED: _ClassVar[Webhook.Event]
        CANCELLED: _ClassVar[Webhook.Event]
    EVENT_UNSPECIFIED: Webhook.Event
    SUCCEEDED: Webhook.Event
    FAILED: Webhook.Event
    CANCELLED: Webhook.Event
    URL_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    url: str
    events: _containers.RepeatedScalarFieldContainer[Webhook.Event]
    def __init__(self, url: _Optional[str] = ..., events: _Optional[_Iterable[_Union[Webhook.Event, str]]] = ...) -> None: ...

class Refinement(_message.Message):
    __slots__ = ("id", "state", "options", "progress", "error", "artifacts", "created_at", "started_at", "finished_at", "expires_at", "queue_position", "silhouette_iou", "attempt", "urls", "outcome", "warnings", "mirror_plane", "camera_correction", "camera", "checks", "metadata", "eta_s", "webhook_deliveries", "mesh_counts")
    class State(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        STATE_UNSPECIFIED: _ClassVar[Refinement.State]
        QUEUED: _ClassVar[Refinement.State]
        RUNNING: _ClassVar[Refinement.State]
        CANCELLING: _ClassVar[Refinement.State]
        SUCCEEDED: _ClassVar[Refinement.State]
        FAILED: _ClassVar[Refinement.State]
        CANCELLED: _ClassVar[Refinement.State]
        EXPIRED: _ClassVar[Refinement.State]
    STATE_UNSPECIFIED: Refinement.State
    QUEUED: Refinement.State
    RUNNING: Refinement.State
    CANCELLING: Refinement.State
    SUCCEEDED: Refinement.State
    FAILED: Refinement.State
    CANCELLED: Refinement.State
    EXPIRED: Refinement.State
    class Outcome(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        OUTCOME_UNSPECIFIED: _ClassVar[Refinement.Outcome]
        REFINED: _ClassVar[Refinement.Outcome]
        FITTED: _ClassVar[Refinement.Outcome]
        KEPT: _ClassVar[Refinement.Outcome]
    OUTCOME_UNSPECIFIED: Refinement.Outcome
    REFINED: Refinement.Outcome
    FITTED: Refinement.Outcome
    KEPT: Refinement.Outcome
    class MetadataEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    ARTIFACTS_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    STARTED_AT_FIELD_NUMBER: _ClassVar[int]
    FINISHED_AT_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_AT_FIELD_NUMBER: _ClassVar[int]
    QUEUE_POSITION_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_IOU_FIELD_NUMBER: _ClassVar[int]
    ATTEMPT_FIELD_NUMBER: _ClassVar[int]
    URLS_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    MIRROR_PLANE_FIELD_NUMBER: _ClassVar[int]
    CAMERA_CORRECTION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    CHECKS_FIELD_NUMBER: _ClassVar[int]
    METADATA_FIELD_NUMBER: _ClassVar[int]
    ETA_S_FIELD_NUMBER: _ClassVar[int]
    WEBHOOK_DELIVERIES_FIELD_NUMBER: _ClassVar[int]
    MESH_COUNTS_FIELD_NUMBER: _ClassVar[int]
    id: str
    state: Refinement.State
    options: RefinementOptions
    progress: Progress
    error: ProblemDetails
    artifacts: _containers.RepeatedCompositeFieldContainer[Artifact]
    created_at: _timestamp_pb2.Timestamp
    started_at: _timestamp_pb2.Timestamp
    finished_at: _timestamp_pb2.Timestamp
    expires_at: _timestamp_pb2.Timestamp
    queue_position: int
    silhouette_iou: SilhouetteIou
    attempt: int
    urls: RefinementUrls
    outcome: Refinement.Outcome
    warnings: _containers.RepeatedScalarFieldContainer[str]
    mirror_plane: MirrorPlane
    camera_correction: CameraCorrection
    camera: CameraEstimate
    checks: _containers.RepeatedCompositeFieldContainer[Finding]
    metadata: _containers.ScalarMap[str, str]
    eta_s: float
    webhook_deliveries: _containers.RepeatedCompositeFieldContainer[WebhookDelivery]
    mesh_counts: MeshCounts
    def __init__(self, id: _Optional[str] = ..., state: _Optional[_Union[Refinement.State, str]] = ..., options: _Optional[_Union[RefinementOptions, _Mapping]] = ..., progress: _Optional[_Union[Progress, _Mapping]] = ..., error: _Optional[_Union[ProblemDetails, _Mapping]] = ..., artifacts: _Optional[_Iterable[_Union[Artifact, _Mapping]]] = ..., created_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., started_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., finished_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., expires_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., queue_position: _Optional[int] = ..., silhouette_iou: _Optional[_Union[SilhouetteIou, _Mapping]] = ..., attempt: _Optional[int] = ..., urls: _Optional[_Union[RefinementUrls, _Mapping]] = ..., outcome: _Optional[_Union[Refinement.Outcome, str]] = ..., warnings: _Optional[_Iterable[str]] = ..., mirror_plane: _Optional[_Union[MirrorPlane, _Mapping]] = ..., camera_correction: _Optional[_Union[CameraCorrection, _Mapping]] = ..., camera: _Optional[_Union[CameraEstimate, _Mapping]] = ..., checks: _Optional[_Iterable[_Union[Finding, _Mapping]]] = ..., metadata: _Optional[_Mapping[str, str]] = ..., eta_s: _Optional[float] = ..., webhook_deliveries: _Optional[_Iterable[_Union[WebhookDelivery, _Mapping]]] = ..., mesh_counts: _Optional[_Union[MeshCounts, _Mapping]] = ...) -> None: ...

class WebhookDelivery(_message.Message):
    __slots__ = ("attempt", "time", "status", "error", "next_attempt_at")
    ATTEMPT_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    NEXT_ATTEMPT_AT_FIELD_NUMBER: _ClassVar[int]
    attempt: int
    time: _timestamp_pb2.Timestamp
    status: int
    error: str
    next_attempt_at: _timestamp_pb2.Timestamp
    def __init__(self, attempt: _Optional[int] = ..., time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., status: _Optional[int] = ..., error: _Optional[str] = ..., next_attempt_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...

class Finding(_message.Message):
    __slots__ = ("code", "severity", "message", "reading")
    class Severity(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        SEVERITY_UNSPECIFIED: _ClassVar[Finding.Severity]
        WARNING: _ClassVar[Finding.Severity]
        REFUSED: _ClassVar[Finding.Severity]
    SEVERITY_UNSPECIFIED: Finding.Severity
    WARNING: Finding.Severity
    REFUSED: Finding.Severity
    CODE_FIELD_NUMBER: _ClassVar[int]
    SEVERITY_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    READING_FIELD_NUMBER: _ClassVar[int]
    code: str
    severity: Finding.Severity
    message: str
    reading: Reading
    def __init__(self, code: _Optional[str] = ..., severity: _Optional[_Union[Finding.Severity, str]] = ..., message: _Optional[str] = ..., reading: _Optional[_Union[Reading, _Mapping]] = ...) -> None: ...

class Reading(_message.Message):
    __slots__ = ("name", "silhouette_iou", "camera")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_IOU_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    name: str
    silhouette_iou: float
    camera: CameraSpec
    def __init__(self, name: _Optional[str] = ..., silhouette_iou: _Optional[float] = ..., camera: _Optional[_Union[CameraSpec, _Mapping]] = ...) -> None: ...

class Progress(_message.Message):
    __slots__ = ("iteration", "total", "percent", "eta_s", "losses", "silhouette_iou")
    class LossesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    ITERATION_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    PERCENT_FIELD_NUMBER: _ClassVar[int]
    ETA_S_FIELD_NUMBER: _ClassVar[int]
    LOSSES_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_IOU_FIELD_NUMBER: _ClassVar[int]
    iteration: int
    total: int
    percent: float
    eta_s: float
    losses: _containers.ScalarMap[str, float]
    silhouette_iou: float
    def __init__(self, iteration: _Optional[int] = ..., total: _Optional[int] = ..., percent: _Optional[float] = ..., eta_s: _Optional[float] = ..., losses: _Optional[_Mapping[str, float]] = ..., silhouette_iou: _Optional[float] = ...) -> None: ...

class SilhouetteIou(_message.Message):
    __slots__ = ("before", "after")
    BEFORE_FIELD_NUMBER: _ClassVar[int]
    AFTER_FIELD_NUMBER: _ClassVar[int]
    before: float
    after: float
    def __init__(self, before: _Optional[float] = ..., after: _Optional[float] = ...) -> None: ...

class MirrorPlane(_message.Message):
    __slots__ = ("normal", "offset", "error")
    NORMAL_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    normal: _containers.RepeatedScalarFieldContainer[float]
    offset: float
    error: float
    def __init__(self, normal: _Optional[_Iterable[float]] = ..., offset: _Optional[float] = ..., error: _Optional[float] = ...) -> None: ...

class CameraCorrection(_message.Message):
    __slots__ = ("turn_degrees",)
    TURN_DEGREES_FIELD_NUMBER: _ClassVar[int]
    turn_degrees: float
    def __init__(self, turn_degrees: _Optional[float] = ...) -> None: ...

class CameraEstimate(_message.Message):
    __slots__ = ("camera", "silhouette_iou", "azimuth_degrees", "elevation_degrees", "alternatives")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_IOU_FIELD_NUMBER: _ClassVar[int]
    AZIMUTH_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ELEVATION_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ALTERNATIVES_FIELD_NUMBER: _ClassVar[int]
    camera: CameraSpec
    silhouette_iou: float
    azimuth_degrees: float
    elevation_degrees: float
    alternatives: _containers.RepeatedCompositeFieldContainer[CameraAlternative]
    def __init__(self, camera: _Optional[_Union[CameraSpec, _Mapping]] = ..., silhouette_iou: _Optional[float] = ..., azimuth_degrees: _Optional[float] = ..., elevation_degrees: _Optional[float] = ..., alternatives: _Optional[_Iterable[_Union[CameraAlternative, _Mapping]]] = ...) -> None: ...

class CameraAlternative(_message.Message):
    __slots__ = ("camera", "silhouette_iou", "azimuth_degrees", "elevation_degrees", "mirror_ambiguous")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_IOU_FIELD_NUMBER: _ClassVar[int]
    AZIMUTH_DEGREES_FIELD_NUMBER: _ClassVar[int]
    ELEVATION_DEGREES_FIELD_NUMBER: _ClassVar[int]
    MIRROR_AMBIGUOUS_FIELD_NUMBER: _ClassVar[int]
    camera: CameraSpec
    silhouette_iou: float
    azimuth_degrees: float
    elevation_degrees: float
    mirror_ambiguous: bool
    def __init__(self, camera: _Optional[_Union[CameraSpec, _Mapping]] = ..., silhouette_iou: _Optional[float] = ..., azimuth_degrees: _Optional[float] = ..., elevation_degrees: _Optional[float] = ..., mirror_ambiguous: bool = ...) -> None: ...

class MeshCounts(_message.Message):
    __slots__ = ("vertices", "faces", "source_vertices", "optimised_vertices", "optimised_faces", "refined_vertices", "refined_faces", "removed_faces")
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    FACES_FIELD_NUMBER: _ClassVar[int]
    SOURCE_VERTICES_FIELD_NUMBER: _ClassVar[int]
    OPTIMISED_VERTICES_FIELD_NUMBER: _ClassVar[int]
    OPTIMISED_FACES_FIELD_NUMBER: _ClassVar[int]
    REFINED_VERTICES_FIELD_NUMBER: _ClassVar[int]
    REFINED_FACES_FIELD_NUMBER: _ClassVar[int]
    REMOVED_FACES_FIELD_NUMBER: _ClassVar[int]
    vertices: int
    faces: int
    source_vertices: int
    optimised_vertices: int
    optimised_faces: int
    refined_vertices: int
    refined_faces: int
    removed_faces: int
    def __init__(self, vertices: _Optional[int] = ..., faces: _Optional[int] = ..., source_vertices: _Optional[int] = ..., optimised_vertices: _Optional[int] = ..., optimised_faces: _Optional[int] = ..., refined_vertices: _Optional[int] = ..., refined_faces: _Optional[int] = ..., removed_faces: _Optional[int] = ...) -> None: ...

class Artifact(_message.Message):
    __slots__ = ("name", "media_type", "size_bytes", "sha256", "url")
    NAME_FIELD_NUMBER: _ClassVar[int]
    MEDIA_TYPE_FIELD_NUMBER: _ClassVar[int]
    SIZE_BYTES_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    URL_FIELD_NUMBER: _ClassVar[int]
    name: str
    media_type: str
    size_bytes: int
    sha256: str
    url: str
    def __init__(self, name: _Optional[str] = ..., media_type: _Optional[str] = ..., size_bytes: _Optional[int] = ..., sha256: _Optional[str] = ..., url: _Optional[str] = ...) -> None: ...

class RefinementUrls(_message.Message):
    __slots__ = ("refinement", "events", "cancel")
    REFINEMENT_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    CANCEL_FIELD_NUMBER: _ClassVar[int]
    refinement: str
    events: str
    cancel: str
    def __init__(self, refinement: _Optional[str] = ..., events: _Optional[str] = ..., cancel: _Optional[str] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("sequence", "type", "time", "state", "progress", "refinement")
    class Type(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        TYPE_UNSPECIFIED: _ClassVar[Event.Type]
        STATE: _ClassVar[Event.Type]
        PROGRESS: _ClassVar[Event.Type]
        COMPLETED: _ClassVar[Event.Type]
    TYPE_UNSPECIFIED: Event.Type
    STATE: Event.Type
    PROGRESS: Event.Type
    COMPLETED: Event.Type
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    TYPE_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    REFINEMENT_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    type: Event.Type
    time: _timestamp_pb2.Timestamp
    state: Refinement.State
    progress: Progress
    refinement: Refinement
    def __init__(self, sequence: _Optional[int] = ..., type: _Optional[_Union[Event.Type, str]] = ..., time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., state: _Optional[_Union[Refinement.State, str]] = ..., progress: _Optional[_Union[Progress, _Mapping]] = ..., refinement: _Optional[_Union[Refinement, _Mapping]] = ...) -> None: ...

class Validation(_message.Message):
    __slots__ = ("accepted", "silhouette_iou", "warnings", "checks")
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_IOU_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    CHECKS_FIELD_NUMBER: _ClassVar[int]
    accepted: bool
    silhouette_iou: float
    warnings: _containers.RepeatedScalarFieldContainer[str]
    checks: _containers.RepeatedCompositeFieldContainer[Finding]
    def __init__(self, accepted: bool = ..., silhouette_iou: _Optional[float] = ..., warnings: _Optional[_Iterable[str]] = ..., checks: _Optional[_Iterable[_Union[Finding, _Mapping]]] = ...) -> None: ...

class RefinementPage(_message.Message):
    __slots__ = ("refinements", "next_cursor")
    REFINEMENTS_FIELD_NUMBER: _ClassVar[int]
    NEXT_CURSOR_FIELD_NUMBER: _ClassVar[int]
    refinements: _containers.RepeatedCompositeFieldContainer[Refinement]
    next_cursor: str
    def __init__(self, refinements: _Optional[_Iterable[_Union[Refinement, _Mapping]]] = ..., next_cursor: _Optional[str] = ...) -> None: ...

class ProblemDetails(_message.Message):
    __slots__ = ("type", "title", "status", "detail", "instance", "reason", "request_id", "retryable", "errors")
    TYPE_FIELD_NUMBER: _ClassVar[int]
    TITLE_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    RETRYABLE_FIELD_NUMBER: _ClassVar[int]
    ERRORS_FIELD_NUMBER: _ClassVar[int]
    type: str
    title: str
    status: int
    detail: str
    instance: str
    reason: str
    request_id: str
    retryable: bool
    errors: _containers.RepeatedCompositeFieldContainer[FieldError]
    def __init__(self, type: _Optional[str] = ..., title: _Optional[str] = ..., status: _Optional[int] = ..., detail: _Optional[str] = ..., instance: _Optional[str] = ..., reason: _Optional[str] = ..., request_id: _Optional[str] = ..., retryable: bool = ..., errors: _Optional[_Iterable[_Union[FieldError, _Mapping]]] = ...) -> None: ...

class FieldError(_message.Message):
    __slots__ = ("pointer", "detail")
    POINTER_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    pointer: str
    detail: str
    def __init__(self, pointer: _Optional[str] = ..., detail: _Optional[str] = ...) -> None: ...

class CreateRefinementRequest(_message.Message):
    __slots__ = ("header", "mesh_chunk", "silhouette_chunk", "file_chunk")
    class Header(_message.Message):
        __slots__ = ("request_id", "spec", "mesh_bytes", "silhouette_bytes", "file_urls")
        class FileUrlsEntry(_message.Message):
            __slots__ = ("key", "value")
            KEY_FIELD_NUMBER: _ClassVar[int]
            VALUE_FIELD_NUMBER: _ClassVar[int]
            key: str
            value: str
            def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
        REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
        SPEC_FIELD_NUMBER: _ClassVar[int]
        MESH_BYTES_FIELD_NUMBER: _ClassVar[int]
        SILHOUETTE_BYTES_FIELD_NUMBER: _ClassVar[int]
        FILE_URLS_FIELD_NUMBER: _ClassVar[int]
        request_id: str
        spec: RefinementSpec
        mesh_bytes: int
        silhouette_bytes: int
        file_urls: _containers.ScalarMap[str, str]
        def __init__(self, request_id: _Optional[str] = ..., spec: _Optional[_Union[RefinementSpec, _Mapping]] = ..., mesh_bytes: _Optional[int] = ..., silhouette_bytes: _Optional[int] = ..., file_urls: _Optional[_Mapping[str, str]] = ...) -> None: ...
    HEADER_FIELD_NUMBER: _ClassVar[int]
    MESH_CHUNK_FIELD_NUMBER: _ClassVar[int]
    SILHOUETTE_CHUNK_FIELD_NUMBER: _ClassVar[int]
    FILE_CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: CreateRefinementRequest.Header
    mesh_chunk: bytes
    silhouette_chunk: bytes
    file_chunk: FileChunk
    def __init__(self, header: _Optional[_Union[CreateRefinementRequest.Header, _Mapping]] = ..., mesh_chunk: _Optional[bytes] = ..., silhouette_chunk: _Optional[bytes] = ..., file_chunk: _Optional[_Union[FileChunk, _Mapping]] = ...) -> None: ...

class FileChunk(_message.Message):
    __slots__ = ("part", "data")
    PART_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    part: str
    data: bytes
    def __init__(self, part: _Optional[str] = ..., data: _Optional[bytes] = ...) -> None: ...

class GetRefinementRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class ListRefinementsRequest(_message.Message):
    __slots__ = ("limit", "cursor", "state", "metadata")
    class MetadataEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    CURSOR_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    METADATA_FIELD_NUMBER: _ClassVar[int]
    limit: int
    cursor: str
    state: _containers.RepeatedScalarFieldContainer[Refinement.State]
    metadata: _containers.ScalarMap[str, str]
    def __init__(self, limit: _Optional[int] = ..., cursor: _Optional[str] = ..., state: _Optional[_Iterable[_Union[Refinement.State, str]]] = ..., metadata: _Optional[_Mapping[str, str]] = ...) -> None: ...

class ExtendRefinementRequest(_message.Message):
    __slots__ = ("id", "lifetime_s")
    ID_FIELD_NUMBER: _ClassVar[int]
    LIFETIME_S_FIELD_NUMBER: _ClassVar[int]
    id: str
    lifetime_s: float
    def __init__(self, id: _Optional[str] = ..., lifetime_s: _Optional[float] = ...) -> None: ...

class WatchRefinementRequest(_message.Message):
    __slots__ = ("id", "after_sequence")
    ID_FIELD_NUMBER: _ClassVar[int]
    AFTER_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    id: str
    after_sequence: int
    def __init__(self, id: _Optional[str] = ..., after_sequence: _Optional[int] = ...) -> None: ...

class CancelRefinementRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class DeleteRefinementRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class DownloadArtifactRequest(_message.Message):
    __slots__ = ("id", "name", "offset_bytes")
    ID_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    OFFSET_BYTES_FIELD_NUMBER: _ClassVar[int]
    id: str
    name: str
    offset_bytes: int
    def __init__(self, id: _Optional[str] = ..., name: _Optional[str] = ..., offset_bytes: _Optional[int] = ...) -> None: ...

class ArtifactChunk(_message.Message):
    __slots__ = ("artifact", "data")
    ARTIFACT_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    artifact: Artifact
    data: bytes
    def __init__(self, artifact: _Optional[_Union[Artifact, _Mapping]] = ..., data: _Optional[bytes] = ...) -> None: ...
