"""The page says in its own language what the rest of the project says in Python."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from refine_engine.files.colour_scale import VIRIDIS
from refine_proto.formats import ARTIFACTS, MESH_SUFFIXES, SILHOUETTE_THRESHOLD
from refine_proto.models import Preset, State

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "service/refine_service/page"


def text(name: str) -> str:
    return (PAGE / name).read_text()


def test_the_colour_scale_is_the_engines() -> None:
    [table] = re.findall(r"const VIRIDIS = `([^`]+)`", text("colours.js"))
    assert bytes.fromhex(table) == VIRIDIS


def test_the_silhouettes_threshold_is_the_contracts() -> None:
    assert f"threshold = {SILHOUETTE_THRESHOLD}" in text("files.js")


def test_every_state_and_every_artifact_has_words() -> None:
    words = re.search(r"const STATES = {(.+?)^};", text("words.js"), re.DOTALL | re.MULTILINE)
    assert words
    assert re.findall(r"^  (\w+):", words[1], re.MULTILINE) == list(State)
    ended = re.search(r"const ENDED = (\[.+?\]);", text("one.js"))
    assert ended
    assert set(re.findall(r'"(\w+)"', ended[1])) == {state for state in State if state.terminal}
    assert [name for name in ARTIFACTS if f'"{name}":' not in text("one.js")] == []


def test_it_offers_every_preset_and_every_mesh_format() -> None:
    assert set(re.findall(r'<option value="(default|fast|paper)">', text("index.html"))) == set(Preset)
    assert f'accept="{",".join(MESH_SUFFIXES)}"' in text("index.html")


def test_an_installation_carries_its_samples() -> None:
    [names] = re.findall(r"const SAMPLES = \[(.+?)\];", text("try.js"))
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    for name in re.findall(r'"(\w+)"', names):
        assert wheel["force-include"][f"examples/samples/{name}"] == f"refine_service/samples/{name}"
