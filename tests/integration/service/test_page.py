"""The page and the API's description: files that need nothing from elsewhere."""

from __future__ import annotations

import gzip
import re

import httpx
import pytest

PAGE = "/", "/docs"


def loaded(document: str) -> list[str]:
    """What an HTML document loads, as addresses of the service."""
    return [f"/{path}" for path in re.findall(r'(?:src|href)="([^"#]+)"', document) if path != "docs"]


@pytest.mark.parametrize("path", PAGE)
def test_what_it_loads_is_there(rest: httpx.Client, path: str) -> None:
    answer = rest.get(path)
    assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
    files = loaded(answer.text)
    assert len(files) >= 4
    for file in files:
        assert rest.get(file).status_code == 200, file


def test_every_module_that_is_imported_is_there(rest: httpx.Client) -> None:
    left, seen = ["main.js"], set[str]()
    while left:
        name = left.pop()
        if name in seen:
            continue
        seen.add(name)
        answer = rest.get(f"/page/{name}")
        assert (answer.status_code, answer.headers["Content-Type"]) == (200, "text/javascript; charset=utf-8")
        left += re.findall(r'^(?:import .*|} )from "\./(.+)";$', answer.text, re.MULTILINE)
    assert "vendor/three.js" in seen
    assert len(seen) > 10


@pytest.mark.parametrize("path", [*PAGE, "/page/main.js"])
def test_the_policy_lets_nothing_in(rest: httpx.Client, path: str) -> None:
    policy = rest.get(path).headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
    assert "unsafe" not in policy
    assert "http" not in policy


@pytest.mark.parametrize("path", [*PAGE, "/page/vendor/three.js", "/page/vendor/swagger-ui-bundle.js"])
def test_it_comes_compressed_once_and_is_asked_about_after(rest: httpx.Client, path: str) -> None:
    plain = rest.get(path, headers={"Accept-Encoding": "identity"})
    with rest.stream("GET", path, headers={"Accept-Encoding": "gzip"}) as answer:
        assert answer.headers["Content-Encoding"] == "gzip"
        assert gzip.decompress(b"".join(answer.iter_raw())) == plain.content
    assert plain.headers["Cache-Control"] == "no-cache"
    again = rest.get(path, headers={"If-None-Match": plain.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert rest.head(path).headers["ETag"] == plain.headers["ETag"]


@pytest.mark.parametrize("name", ["chair", "airplane", "car"])
def test_samples_come_with_it(rest: httpx.Client, name: str) -> None:
    for file in ("coarse.obj", "silhouette.png", "camera.json"):
        assert rest.get(f"/page/samples/{name}/{file}").status_code == 200


@pytest.mark.parametrize("name", ["nothing.js", "../settings.py", "..%2fsettings.py", "vendor/", "page.py"])
def test_nothing_else_is_served(rest: httpx.Client, name: str) -> None:
    answer = rest.get(f"/page/{name}")
    assert (answer.status_code, answer.json()["reason"]) == (404, "NOT_FOUND")


def test_it_is_no_part_of_the_contract(rest: httpx.Client) -> None:
    paths = rest.get("/openapi.json").json()["paths"]
    assert not [path for path in paths if not path.startswith(("/v1/", "/livez", "/readyz", "/metrics"))]
