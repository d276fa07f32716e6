"""Pages of other sites: refused where no key is needed, let in only by a setting; headers for browsers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from service_process import CAMERA, MESH, PNG, Service, run_service

APP = "https://app.example"
SECURITY = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'",
    "cache-control": "no-store",
}


@pytest.fixture(scope="module")
def shared_service(redis_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with run_service(redis_url, tmp_path_factory.mktemp("service")) as service:
        yield service


@pytest.fixture(scope="module")
def with_app(redis_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    settings = {"cors_origins": f"{APP}, https://other.example"}
    with run_service(redis_url, tmp_path_factory.mktemp("with_app"), settings) as service:
        yield service


def submit(rest: httpx.Client, headers: dict[str, str]) -> httpx.Response:
    """As a form of a page would."""
    files = {"mesh": ("m.obj", MESH), "silhouette": ("s.png", PNG)}
    return rest.post("/v1/refinements", files=files, data={"camera": json.dumps(CAMERA)}, headers=headers)


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Host": "evil.example:8000"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
        {"Host": "localhost.evil.example"},
    ],
)
def test_other_sites_are_refused_without_keys(rest: httpx.Client, headers: dict[str, str]) -> None:
    answer = submit(rest, headers)
    assert (answer.status_code, answer.json()["reason"]) == (403, "FORBIDDEN")
    assert rest.get("/v1/refinements").json()["refinements"] == []


def test_names_of_this_machine_and_its_own_page(service: Service, rest: httpx.Client) -> None:
    own = service.rest_url
    port = service.http_address[1]
    for headers in ({}, {"Origin": own}, {"Host": f"localhost:{port}"}, {"Host": f"[::1]:{port}"}):
        assert submit(rest, headers).status_code == 202


def test_where_keys_are_needed_any_name_will_do(redis_url: str, tmp_path: Path) -> None:
    with run_service(redis_url, tmp_path, {"require_key": "true"}) as service, service.rest() as rest:
        assert rest.get("/livez", headers={"Host": "refine.example"}).status_code == 200
        assert submit(rest, {"Host": "refine.example", "Origin": APP}).status_code == 401


def preflight(service: Service, origin: str) -> httpx.Response:
    headers = {
        "Origin": origin,
        "Access-Control-Request-Method": "POST",
        "Access-Control-Request-Headers": "authorization, idempotency-key",
    }
    with service.rest() as rest:
        return rest.options("/v1/refinements", headers=headers)


def test_cors_is_closed_unless_a_setting_names_the_origin(service: Service, with_app: Service) -> None:
    for closed in (preflight(service, APP), preflight(with_app, "https://evil.example")):
        assert closed.status_code >= 400
        assert "access-control-allow-origin" not in closed.headers
    opened = preflight(with_app, APP)
    assert (opened.status_code, opened.headers["access-control-allow-origin"]) == (200, APP)
    with with_app.rest() as rest:
        answer = submit(rest, {"Origin": APP})
    assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (202, APP)
    assert "Location" in answer.headers["access-control-expose-headers"]


@pytest.mark.parametrize("path", ["/livez", "/v1/refinements", "/nothing", "/openapi.json"])
def test_security_headers(rest: httpx.Client, path: str) -> None:
    assert SECURITY.items() <= dict(rest.get(path).headers).items()


@pytest.mark.parametrize("path", ["/", "/docs"])
def test_pages_have_their_own_policy(rest: httpx.Client, path: str) -> None:
    headers = rest.get(path).headers
    assert "script-src 'self'" in headers["content-security-policy"]
    assert headers["x-frame-options"] == "DENY"
