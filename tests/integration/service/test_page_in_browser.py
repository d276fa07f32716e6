"""The page in a real browser, against the real service; the worker is played by hand."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import chromium, visit
from playwright.sync_api import Browser, Page, Route, expect
from service_process import CAMERA, MESH, PNG, Hand, Service, run_service

from refine_proto.models import Progress
from refine_service.edge.auth import ApiKeys


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, service: Service) -> Iterator[Page]:
    with visit(browser, service.rest_url) as page:
        yield page


def submit(service: Service) -> str:
    """The id of a refinement that waits."""
    with service.client("rest") as client:
        return client.submit(MESH, PNG, CAMERA, mesh_format="obj").id


def error_of(page: Page) -> str:
    """What the page says went wrong."""
    line = page.locator(".error[role=alert]:not(:empty)")
    expect(line).to_have_count(1)
    return line.inner_text()


def test_progress_and_losses_come_as_they_are_told(page: Page, service: Service, hand: Hand) -> None:
    job_id = submit(service)
    page.goto(f"{service.rest_url}/#/refinements/{job_id}")
    expect(page.locator(".state")).to_have_text("Waiting for a free worker.")
    job = hand.start(job_id)
    expect(page.locator(".state")).to_have_text("Running.")
    for iteration, loss in ((3, 0.5), (6, 0.25)):
        losses = {"silhouette": loss, "total": 2 * loss}
        told = Progress(
            iteration=iteration, total=10, percent=10.0 * iteration, losses=losses, silhouette_iou=0.75
        )
        hand.store.report(job, told)
        expect(page.locator(".progress-words")).to_have_text(f"Iteration {iteration} of 10, 2D IoU 0.750.")
    assert page.get_by_role("progressbar", name="Progress").get_attribute("value") == "60"
    chart = page.get_by_role("img", name="Losses: silhouette from 0.5 to 0.25, total from 1 to 0.5")
    expect(chart).to_be_visible()


def test_a_stream_that_breaks_is_taken_up_again(page: Page, service: Service, hand: Hand) -> None:
    """The second call asks for what came after the last event of the first."""
    job_id = submit(service)
    job = hand.start(job_id)
    after: list[str] = []

    def cut(route: Route) -> None:
        after.append(route.request.headers["last-event-id"])
        if len(after) == 1:
            event = {"sequence": 1, "type": "state", "state": "cancelling"}
            route.fulfill(body=f"id: 1\ndata: {json.dumps(event)}\n\n", content_type="text/event-stream")
        else:
            route.continue_()

    page.route("**/events", cut)
    page.goto(f"{service.rest_url}/#/refinements/{job_id}")
    expect(page.locator(".state")).to_have_text("Stopping.")
    hand.report(job, 4)
    expect(page.locator(".progress-words")).to_have_text("Iteration 4 of 10.")
    assert after == ["0", "1"]


def test_cancel(page: Page, service: Service) -> None:
    page.goto(f"{service.rest_url}/#/refinements/{submit(service)}")
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator(".state")).to_have_text("It was cancelled.")


def test_a_refinement_whose_time_is_over(page: Page, service: Service, hand: Hand) -> None:
    job_id = submit(service)
    hand.run(job_id, {"report.json": b"{}"})
    hand.expire(job_id)
    page.goto(f"{service.rest_url}/#/refinements/{job_id}")
    assert "expired" in error_of(page)


def test_a_refinement_that_nobody_knows(page: Page, service: Service) -> None:
    page.goto(f"{service.rest_url}/#/refinements/{'0' * 32}")
    assert "0" * 32 in error_of(page)


def test_the_list_shows_deletes_and_goes_on(page: Page, service: Service, hand: Hand) -> None:
    ended = submit(service)
    hand.run(ended, {"refined.glb": b"glTF" * 1000})
    others = [submit(service) for _ in range(20)]
    page.get_by_role("link", name="Refinements", exact=True).click()
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(20)
    expect(rows.first).to_contain_text(others[-1][:8])
    page.get_by_role("button", name="Older ones").click()
    expect(rows).to_have_count(21)
    for words in (ended[:8], "succeeded", "default", "0.50 → 0.90", "3.91 KiB"):
        expect(rows.last).to_contain_text(words)
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name=f"Delete refinement {ended[:8]}").click()
    expect(rows).to_have_count(20)
    with service.client("rest") as client:
        assert ended not in [refinement.id for refinement in client.list(limit=100).refinements]


def test_the_service_is_away_and_comes_back(page: Page, service: Service) -> None:
    page.route("**/v1/**", lambda route: route.abort())
    page.get_by_role("link", name="Refinements", exact=True).click()
    assert error_of(page) == "The service does not answer. Is it running?"
    page.unroute("**/v1/**")
    page.reload()
    expect(page.get_by_text("There are none yet.")).to_be_visible()


def test_sign_in(browser: Browser, redis_url: str, tmp_path: Path) -> None:
    _, key = ApiKeys(tmp_path / "keys.json").add("ann")
    settings = {"require_key": "true"}
    with run_service(redis_url, tmp_path, settings) as service, visit(browser, service.rest_url) as page:
        page.get_by_role("link", name="Refinements", exact=True).click()
        dialog = page.get_by_role("dialog", name="Sign in")
        expect(dialog).to_be_visible()
        for given in ("wrong", key):
            dialog.get_by_label("API key").fill(given)
            dialog.get_by_role("button", name="Sign in").click()
            if given == "wrong":
                expect(page.locator(".error")).to_have_text(re.compile("unknown or revoked"))
                expect(dialog).to_be_visible()
        expect(page.get_by_text("There are none yet.")).to_be_visible()
        kept = {
            place: page.evaluate(f"JSON.stringify({place})") for place in ("sessionStorage", "localStorage")
        }
        assert key in kept["sessionStorage"]
        assert json.loads(kept["localStorage"]) == {}
        assert key not in page.url
        page.get_by_role("button", name="Sign out").click()
        expect(dialog).to_be_visible()
        assert key not in page.evaluate("JSON.stringify(sessionStorage)")


def test_the_description_of_the_api_needs_nothing_from_elsewhere(page: Page, service: Service) -> None:
    page.get_by_role("link", name="API").click()
    expect(page.locator(".opblock")).not_to_have_count(0)
    page.get_by_role("button", name="post /v1/refinements", exact=False).first.click()
    expect(page.get_by_text("Submit a mesh, its silhouette and the camera.")).to_be_visible()


def test_files_are_dropped_anywhere_and_sorted_by_their_names(page: Page) -> None:
    files = {"a.obj": MESH.decode(), "camera.json": json.dumps(CAMERA), "notes.txt": "nothing"}
    transfer = page.evaluate_handle(
        """files => {
          const transfer = new DataTransfer();
          for (const [name, text] of Object.entries(files)) transfer.items.add(new File([text], name));
          return transfer;
        }""",
        files,
    )
    page.locator("h1").dispatch_event("drop", {"dataTransfer": transfer})
    for kind, name in (("mesh", "a.obj"), ("camera", "camera.json")):
        expect(page.locator(f".drop[data-kind={kind}]")).to_contain_text(name)
    assert page.get_by_role("spinbutton", name="Azimuth").input_value() == "30"
    expect(page.locator("[data-error=files]")).to_have_text(
        "notes.txt: expected a mesh, an image or a camera as JSON"
    )


def test_by_keyboard(page: Page) -> None:
    page.get_by_role("link", name="Refinements", exact=True).press("Enter")
    expect(page.get_by_role("heading", name="Refinements")).to_be_visible()
    page.reload()
    page.keyboard.press("Tab")
    skip = page.get_by_role("link", name="Skip to the content")
    expect(skip).to_be_focused()
    skip.press("Enter")
    expect(page.get_by_role("main")).to_be_focused()
    expect(page.get_by_role("heading", name="Refinements")).to_be_visible()
    page.get_by_role("link", name="New").press("Enter")
    page.get_by_role("button", name="Chair", exact=True).focus()
    page.keyboard.press("Enter")
    expect(page.locator("#iou")).to_have_text(re.compile(r"0\.\d{3}"))
    before = page.locator("#iou").inner_text()
    page.get_by_role("slider", name="Azimuth, degrees").focus()
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    assert page.get_by_role("spinbutton", name="Azimuth").input_value() == "82"
    expect(page.locator("#iou")).not_to_have_text(before)
