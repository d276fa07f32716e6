"""Resources of others that the chart makes, as far as it uses them.

Those of KEDA 2.10, the Prometheus operator 0.65, the Gateway API 1.1, or newer. A field that is not here is
refused, as Kubernetes refuses or drops one that it does not know.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

Name = Annotated[str, Field(pattern=r"^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$", max_length=253)]
Hostname = Annotated[
    str, Field(pattern=r"^(\*\.)?[a-z0-9]([-a-z0-9]*[a-z0-9])?(\.[a-z0-9]([-a-z0-9]*[a-z0-9])?)*$")
]
Label = Annotated[str, Field(pattern=r"^([A-Za-z0-9]([-A-Za-z0-9_.]*[A-Za-z0-9])?)?$", max_length=63)]
Labels = dict[str, Label]
PrometheusDuration = Annotated[
    str, Field(pattern=r"^(0|(\d+y)?(\d+w)?(\d+d)?(\d+h)?(\d+m)?(\d+s)?(\d+ms)?)$", min_length=1)
]
GatewayDuration = Annotated[str, Field(pattern=r"^(\d{1,5}(h|m|s|ms)){1,4}$")]
PortNumber = Annotated[int, Field(ge=1, le=65535)]
Digits = Annotated[str, Field(pattern=r"^\d+$")]  # KEDA takes strings only


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Metadata(Strict):
    name: Name
    namespace: Name | None = None
    labels: Labels


class Resource(Strict):
    metadata: Metadata


# -- KEDA --


class AuthenticationRef(Strict):
    name: Name


class PrometheusTriggerMetadata(Strict):
    serverAddress: Annotated[str, Field(pattern=r"^https?://")]
    query: str
    threshold: Digits


class PrometheusTrigger(Strict):
    type: Literal["prometheus"]
    metadata: PrometheusTriggerMetadata
    authenticationRef: AuthenticationRef | None = None


class RedisTriggerMetadata(Strict):
    address: Annotated[str, Field(pattern=r"^[^:/]+:\d+$")]
    listName: str
    listLength: Digits
    databaseIndex: Digits
    enableTLS: Literal["true", "false"]
    username: str | None = None


class RedisTrigger(Strict):
    type: Literal["redis"]
    metadata: RedisTriggerMetadata
    authenticationRef: AuthenticationRef | None = None


class ScaleTargetRef(Strict):
    name: Name


class ScalingRules(Strict):
    stabilizationWindowSeconds: Annotated[int, Field(ge=0, le=3600)]


class Behavior(Strict):
    scaleDown: ScalingRules


class HorizontalPodAutoscalerConfig(Strict):
    behavior: Behavior


class Advanced(Strict):
    horizontalPodAutoscalerConfig: HorizontalPodAutoscalerConfig


class ScaledObjectSpec(Strict):
    scaleTargetRef: ScaleTargetRef
    minReplicaCount: Annotated[int, Field(ge=0)]
    maxReplicaCount: Annotated[int, Field(ge=1)]
    pollingInterval: Annotated[int, Field(ge=1)]
    cooldownPeriod: Annotated[int, Field(ge=0)]
    advanced: Advanced
    triggers: Annotated[
        list[Annotated[PrometheusTrigger | RedisTrigger, Field(discriminator="type")]], Field(min_length=1)
    ]

    @model_validator(mode="after")
    def _ordered(self) -> ScaledObjectSpec:
        assert self.minReplicaCount <= self.maxReplicaCount
        return self


class ScaledObject(Resource):
    apiVersion: Literal["keda.sh/v1alpha1"]
    kind: Literal["ScaledObject"]
    spec: ScaledObjectSpec


class SecretTargetRef(Strict):
    parameter: Literal["password"]
    name: Name
    key: str


class TriggerAuthenticationSpec(Strict):
    secretTargetRef: Annotated[list[SecretTargetRef], Field(min_length=1)]


class TriggerAuthentication(Resource):
    apiVersion: Literal["keda.sh/v1alpha1"]
    kind: Literal["TriggerAuthentication"]
    spec: TriggerAuthenticationSpec


# -- Prometheus operator --


class Selector(Strict):
    matchLabels: Labels


class Endpoint(Strict):
    port: Name
    interval: PrometheusDuration


class ServiceMonitorSpec(Strict):
    selector: Selector
    endpoints: Annotated[list[Endpoint], Field(min_length=1)]


class ServiceMonitor(Resource):
    apiVersion: Literal["monitoring.coreos.com/v1"]
    kind: Literal["ServiceMonitor"]
    spec: ServiceMonitorSpec


class PodMonitorSpec(Strict):
    selector: Selector
    podMetricsEndpoints: Annotated[list[Endpoint], Field(min_length=1)]


class PodMonitor(Resource):
    apiVersion: Literal["monitoring.coreos.com/v1"]
    kind: Literal["PodMonitor"]
    spec: PodMonitorSpec


class StaticConfig(Strict):
    targets: Annotated[list[Annotated[str, Field(pattern=r"^[^:/]+:\d+$")]], Field(min_length=1)]
    labels: dict[str, str]


class ScrapeConfigSpec(Strict):
    metricsPath: Annotated[str, Field(pattern=r"^/")]
    scrapeInterval: PrometheusDuration
    staticConfigs: Annotated[list[StaticConfig], Field(min_length=1)]


class ScrapeConfig(Resource):
    apiVersion: Literal["monitoring.coreos.com/v1alpha1"]
    kind: Literal["ScrapeConfig"]
    spec: ScrapeConfigSpec


class AlertingRule(Strict):
    alert: Annotated[str, Field(min_length=1)]
    expr: str
    for_: Annotated[PrometheusDuration | None, Field(alias="for")] = None
    labels: dict[str, str]
    annotations: dict[str, str]


class RuleGroup(Strict):
    name: Annotated[str, Field(min_length=1)]
    rules: Annotated[list[AlertingRule], Field(min_length=1)]


class PrometheusRuleSpec(Strict):
    groups: Annotated[list[RuleGroup], Field(min_length=1)]


class PrometheusRule(Resource):
    apiVersion: Literal["monitoring.coreos.com/v1"]
    kind: Literal["PrometheusRule"]
    spec: PrometheusRuleSpec


# -- Gateway API --


class ParentRef(Strict):
    name: Name
    namespace: Name


class BackendRef(Strict):
    name: Name
    port: PortNumber


class PathMatch(Strict):
    type: Literal["Exact", "PathPrefix"]
    value: Annotated[str, Field(pattern=r"^/", max_length=1024)]


class HTTPMatch(Strict):
    path: PathMatch


class Timeouts(Strict):
    request: GatewayDuration


class HTTPRule(Strict):
    matches: Annotated[list[HTTPMatch], Field(min_length=1, max_length=64)]
    backendRefs: Annotated[list[BackendRef], Field(min_length=1)]
    timeouts: Timeouts


class GRPCRule(Strict):
    backendRefs: Annotated[list[BackendRef], Field(min_length=1)]


class HTTPRouteSpec(Strict):
    parentRefs: Annotated[list[ParentRef], Field(min_length=1)]
    hostnames: list[Hostname]
    rules: Annotated[list[HTTPRule], Field(min_length=1)]


class HTTPRoute(Resource):
    apiVersion: Literal["gateway.networking.k8s.io/v1"]
    kind: Literal["HTTPRoute"]
    spec: HTTPRouteSpec


class GRPCRouteSpec(Strict):
    parentRefs: Annotated[list[ParentRef], Field(min_length=1)]
    hostnames: list[Hostname]
    rules: Annotated[list[GRPCRule], Field(min_length=1)]


class GRPCRoute(Resource):
    apiVersion: Literal["gateway.networking.k8s.io/v1"]
    kind: Literal["GRPCRoute"]
    spec: GRPCRouteSpec


_RESOURCES: TypeAdapter[Any] = TypeAdapter(
    Annotated[
        ScaledObject
        | TriggerAuthentication
        | ServiceMonitor
        | PodMonitor
        | ScrapeConfig
        | PrometheusRule
        | HTTPRoute
        | GRPCRoute,
        Field(discriminator="kind"),
    ]
)
_GROUPS = ("keda.sh/", "monitoring.coreos.com/", "gateway.networking.k8s.io/")


def is_of_others(document: dict[str, Any]) -> bool:
    """Whether it is of a group that Kubernetes itself does not have."""
    return str(document["apiVersion"]).startswith(_GROUPS)


def check(document: dict[str, Any]) -> None:
    """Raises ValidationError."""
    _RESOURCES.validate_python(document)
