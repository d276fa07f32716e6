"""The Helm chart: every profile renders, validates, and says to the program what it understands."""

from __future__ import annotations

import base64
import itertools
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

yaml = pytest.importorskip("yaml")

from custom_resources import check, is_of_others  # noqa: E402

from refine_client.cli import main  # noqa: E402
from refine_jobs.settings import JobSettings  # noqa: E402
from refine_service.settings import ServiceSettings  # noqa: E402
from refine_worker.port import PROBES  # noqa: E402
from refine_worker.settings import WorkerSettings  # noqa: E402

CHART = Path(__file__).parents[2] / "deploy/chart/refine"
PROFILES = [None, *sorted((CHART / "profiles").glob("*.yaml"))]
ALL_OF_OTHERS = [
    *(
        "--set",
        "worker.autoscaling.mode=keda",
        "--set",
        "worker.autoscaling.prometheus=http://prometheus:9090",
    ),
    *("--set", "monitoring.enabled=true", "--set", "gateway.enabled=true", "--set", "gateway.name=public"),
]


def tool(name: str) -> str:
    """Path of a program that scripts/test-deploy brings."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not on PATH; scripts/test-deploy brings it")
    return found


def helm(*words: str | Path) -> str:
    answer = subprocess.run([tool("helm"), *words], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


def given(profile: Path | None) -> list[str | Path]:
    return ["-f", profile] if profile else []


@pytest.fixture(params=PROFILES, ids=lambda profile: profile.stem if profile else "values")
def profile(request: pytest.FixtureRequest) -> Path | None:
    return request.param  # type: ignore[no-any-return]


@pytest.fixture
def rendered(profile: Path | None) -> str:
    return helm("template", "refine", CHART, "-n", "production", *given(profile))


def documents(text: str) -> list[dict[str, Any]]:
    return [document for document in yaml.safe_load_all(text) if document]


def test_lint(profile: Path | None) -> None:
    helm("lint", "--strict", CHART, *given(profile))


def test_package_holds_the_sample(tmp_path: Path) -> None:
    helm("package", CHART, "-d", tmp_path)
    (package,) = tmp_path.iterdir()
    shutil.unpack_archive(package, tmp_path)
    assert (tmp_path / "refine/files/sample/coarse.obj").stat().st_size > 10_000


def test_manifests_are_what_kubernetes_takes(rendered: str, tmp_path: Path) -> None:
    path = tmp_path / "manifests.yaml"
    kept = [document for document in documents(rendered) if not is_of_others(document)]
    path.write_text(yaml.safe_dump_all(kept))
    command = [tool("kubernetes-validate"), "--strict", "-k", "1.32", str(path)]
    answer = subprocess.run(command, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert "Couldn't find schema" not in answer.stdout + answer.stderr


def test_resources_of_others_are_what_their_owners_take(profile: Path | None) -> None:
    text = helm("template", "refine", CHART, "-n", "production", *given(profile), *ALL_OF_OTHERS)
    found = [document for document in documents(text) if is_of_others(document)]
    for document in found:
        check(document)
    kinds = {document["kind"] for document in found} - {"TriggerAuthentication"}  # only for a password
    assert kinds == {
        *("ScaledObject", "ServiceMonitor", "PodMonitor", "ScrapeConfig", "PrometheusRule"),
        *("HTTPRoute", "GRPCRoute"),
    }


def test_the_schemas_of_others_refuse_what_is_not_theirs() -> None:
    text = helm("template", "refine", CHART, *ALL_OF_OTHERS)
    for document in documents(text):
        if is_of_others(document):
            document["spec"]["interval"] = "soon"
            with pytest.raises(ValidationError):
                check(document)


def test_settings_are_settings_of_the_program(rendered: str) -> None:
    known = {
        "service": JobSettings.model_fields | ServiceSettings.model_fields,
        "worker": JobSettings.model_fields | WorkerSettings.model_fields,
    }
    seen = []
    for document in documents(rendered):
        if document["kind"] != "Deployment":
            continue
        (container,) = document["spec"]["template"]["spec"]["containers"]
        environment = {entry["name"]: entry.get("value", "") for entry in container["env"]}
        ours = {name.removeprefix("REFINE_").lower() for name in environment if name.startswith("REFINE_")}
        assert ours <= set(known[container["name"]])
        JobSettings.from_environment(environment)
        own = ServiceSettings if container["name"] == "service" else WorkerSettings
        own.from_environment(environment)
        seen.append(container["name"])
    assert sorted(seen) == ["service", "worker"]


def test_the_grace_period_is_longer_than_what_a_worker_needs(rendered: str) -> None:
    (worker,) = [
        document
        for document in documents(rendered)
        if document["kind"] == "Deployment" and document["metadata"]["name"] == "refine-worker"
    ]
    pod = worker["spec"]["template"]["spec"]
    (grace,) = [e["value"] for e in pod["containers"][0]["env"] if e["name"] == "REFINE_STOP_GRACE_S"]
    assert pod["terminationGracePeriodSeconds"] >= int(grace) + 15


def test_a_worker_is_probed_and_scraped_on_its_port() -> None:
    found = documents(helm("template", "refine", CHART, "--set", "monitoring.enabled=true"))
    by_name = {(document["kind"], document["metadata"]["name"]): document for document in found}
    pod = by_name["Deployment", "refine-worker"]["spec"]["template"]
    (container,) = pod["spec"]["containers"]
    environment = {entry["name"]: entry.get("value", "") for entry in container["env"]}
    (port,) = container["ports"]
    settings = WorkerSettings.from_environment(environment)
    assert (settings.worker_host, settings.worker_port) == ("0.0.0.0", port["containerPort"])
    probes = (container["livenessProbe"], container["readinessProbe"])
    assert [probe["httpGet"] for probe in probes] == [
        {"path": path, "port": port["name"]} for path in PROBES.values()
    ]
    monitor = by_name["PodMonitor", "refine-worker"]["spec"]
    assert monitor["selector"]["matchLabels"].items() <= pod["metadata"]["labels"].items()
    assert [endpoint["port"] for endpoint in monitor["podMetricsEndpoints"]] == [port["name"]]
    (rule,) = by_name["NetworkPolicy", "refine-worker"]["spec"]["ingress"]
    assert rule == {"ports": [{"port": port["containerPort"]}]}


def test_no_container_may_write_its_root_or_be_root(rendered: str) -> None:
    for document in documents(rendered):
        pod = document if document["kind"] == "Pod" else document.get("spec", {}).get("template")
        if pod is None:
            continue
        assert pod["spec"]["securityContext"]["runAsNonRoot"]
        for container in pod["spec"]["containers"]:
            assert container["securityContext"]["readOnlyRootFilesystem"]
            assert not container["securityContext"]["allowPrivilegeEscalation"]


def test_the_test_pod_calls_the_client_as_it_is(rendered: str, capsys: pytest.CaptureFixture[str]) -> None:
    (pod,) = [document for document in documents(rendered) if document["kind"] == "Pod"]
    (container,) = pod["spec"]["containers"]
    with pytest.raises(SystemExit) as ended:
        main([*container["args"], "--help"])
    assert ended.value.code == 0
    capsys.readouterr()


def test_helm_test_has_its_sample_before_its_pod(rendered: str) -> None:
    hooks = {
        document["kind"]: document
        for document in documents(rendered)
        if document["metadata"].get("annotations", {}).get("helm.sh/hook") == "test"
    }
    assert sorted(hooks) == ["ConfigMap", "Pod"]
    weights = {
        kind: int(hook["metadata"]["annotations"].get("helm.sh/hook-weight", 0))
        for kind, hook in hooks.items()
    }
    assert weights["ConfigMap"] < weights["Pod"]
    sample = {name: base64.b64decode(data) for name, data in hooks["ConfigMap"]["binaryData"].items()}
    assert sample == {name: (CHART / "files/sample" / name).read_bytes() for name in sample}
    spec = hooks["Pod"]["spec"]
    (mount,) = [mount for mount in spec["containers"][0]["volumeMounts"] if mount["mountPath"] == "/sample"]
    (volume,) = [volume for volume in spec["volumes"] if volume["name"] == mount["name"]]
    assert volume["configMap"]["name"] == hooks["ConfigMap"]["metadata"]["name"]
    given_files = [Path(word).name for word in spec["containers"][0]["args"] if word.startswith("/sample/")]
    assert sorted(given_files) == sorted(sample)


def test_redis_secrets_reach_url_and_autoscaler() -> None:
    text = helm("template", "refine", CHART, "-f", CHART / "profiles/s3-gpu.yaml")
    url = "rediss://refine:$(REDIS_PASSWORD)@redis.example:6379/0?ssl_ca_certs=/etc/refine/redis/ca.crt"
    assert text.count(url) == 2
    (scaled,) = [document for document in documents(text) if document["kind"] == "ScaledObject"]
    age, length = scaled["spec"]["triggers"]
    assert age["metadata"]["query"] == "max(refine_oldest_queued_job_age_seconds)"
    assert length["metadata"]["listName"] == "rq:queue:refine-default"
    assert length["metadata"]["address"] == "redis.example:6379"
    assert length["authenticationRef"] == {"name": "refine-worker"}
    assert scaled["spec"]["minReplicaCount"] == 0


def test_values_of_the_wrong_kind_are_refused() -> None:
    command = [tool("helm"), "template", str(CHART), "--set", "worker.autoscaling.mode=magic"]
    answer = subprocess.run(command, capture_output=True, text=True)
    assert answer.returncode != 0
    assert "worker.autoscaling.mode" in answer.stderr


def test_every_value_is_documented_and_in_the_schema() -> None:
    lines = (CHART / "values.yaml").read_text().splitlines()
    for before, line in itertools.pairwise(lines):
        if re.match(r" *\w+: *\S", line):
            assert before.strip().startswith("# -- "), line

    def names(values: dict[str, Any], schema: dict[str, Any]) -> None:
        for name, value in values.items():
            assert name in schema["properties"]
            if "properties" in schema["properties"][name]:
                names(value, schema["properties"][name])

    schema = json.loads((CHART / "values.schema.json").read_text())
    names(yaml.safe_load((CHART / "values.yaml").read_text()), schema)
