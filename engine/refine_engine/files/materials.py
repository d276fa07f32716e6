"""Materials and textures that an OBJ or a PLY file refers to, in the terms of glTF."""

from __future__ import annotations

import posixpath
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import numpy as np

from .beside import Beside
from .colour_scale import linear_light

_Statements = dict[str, list[str]]  # of one material: the words behind each keyword
_MAGIC = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}
_PLACES = {"map_kd": "baseColorTexture", "map_ke": "emissiveTexture", "norm": "normalTexture"}
_PLAIN = {"kd", "ka", "ks", "ke", "ns", "ni", "d", "tr", "tf", "illum", "pr", "pm", "map_ka"}
_NOT_THERE = "the {what} {{}} is not there: put it beside the mesh, or send all in a .zip"
_OPTIONS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2} | dict.fromkeys(  # of a texture, and how many words follow
    ("-blendu", "-blendv", "-boost", "-texres", "-clamp", "-bm", "-imfchan", "-type", "-cc", "-colorspace"), 1
)


@dataclass(frozen=True, eq=False)
class Material:
    """A glTF material, and its images (PNG or JPEG) by the names that their textures have in it."""

    json: Mapping[str, Any] = field(
        default_factory=lambda: {
            "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
            "doubleSided": True,
        }
    )
    images: Mapping[str, bytes] = field(default_factory=dict)

    def to_json(self, textures: Mapping[str, int]) -> dict[str, Any]:
        """The material with these indices of its textures."""
        made: dict[str, Any] = {**self.json}
        for name, index in textures.items():
            if name == "baseColorTexture":
                made["pbrMetallicRoughness"] = {**made["pbrMetallicRoughness"], name: {"index": index}}
            else:
                made[name] = {"index": index}
        return made


MATTE = Material()


def media_type(image: bytes) -> str | None:
    """That of an image which glTF can hold."""
    return next((kind for magic, kind in _MAGIC.items() if image.startswith(magic)), None)


class MaterialFiles:
    """Reads what a mesh file says of materials, and tells what was left out."""

    def __init__(self, beside: Beside) -> None:
        self._warnings: list[str] = []
        self._lost: dict[str, dict[str, None]] = {}  # files by what is wrong with them
        self._beside = beside
        self._files: dict[str, bytes | None] = {}  # by path: none is read twice, however often it is named

    def warnings(self) -> list[str]:
        """One for each kind of loss, however many files it took."""
        told = list(self._warnings)
        for words, names in self._lost.items():
            first, *others = names
            told.append(words.format(f"{first!r:.60}" + (f" and {len(others)} others" if others else "")))
        return told

    def textured(self, image: str) -> Material:
        """A material that is a texture and nothing else."""
        return Material(images=self._images({"map_kd": image}, ""))

    def named(self, names: Sequence[str], libraries: Sequence[str]) -> dict[str, Material]:
        """The materials of these names, as far as the files `libraries` have them."""
        wanted, found, left_out = set(names) - {""}, dict[str, Material](), dict[str, None]()
        present = list(self._present(libraries))
        for library in present:
            text = (self._read(library) or b"").decode("utf-8", "replace")
            for name, statements in _materials(text.splitlines()):
                if name in wanted and name not in found:
                    found[name] = self._material(name, statements, posixpath.dirname(library), left_out)
        if left_out:
            self._warnings.append(f"of the material files {', '.join(left_out)!s:.80} were left out")
        missing = sorted(wanted - found.keys())
        if missing and (present or not libraries):
            self._warnings.append(
                f"{len(missing)} of {len(wanted)} materials are in no material file "
                f"(first: {missing[0]!r:.40})"
            )
        return found

    def _present(self, libraries: Iterable[str]) -> Iterator[str]:
        """The paths of those that are there. A name may have spaces, and a line several names."""
        for line in dict.fromkeys(libraries):
            names = [line] if self._read(_path("", line)) is not None else line.split()
            for path in (_path("", name) for name in names):
                found = self._first_there([path, posixpath.basename(path)])
                if found is not None:
                    yield found
                else:
                    self._lose(_NOT_THERE.format(what="material file"), path)

    def _material(
        self, name: str, statements: _Statements, folder: str, left_out: dict[str, None]
    ) -> Material:
        images: dict[str, str] = {}
        for word, words in statements.items():
            if word in _PLACES or word == "map_d":
                images[word], plain = _image_name(words)
                if not plain:
                    left_out[f"options of {word}"] = None
            elif word not in _PLAIN:
                left_out[word] = None
        cut_out = images.get("map_d")
        if cut_out and cut_out != images.get("map_kd"):
            left_out["map_d"] = None
        found = self._images({word: images[word] for word in _PLACES if word in images}, folder)
        values = {word: _numbers(statements.get(word, [])) for word in ("kd", "ke", "d", "pm", "pr")}
        # Most writers leave any colour beside a texture, and some an opacity of 0.
        rgb = [1.0, 1.0, 1.0] if "baseColorTexture" in found else _linear(values["kd"]) or [1.0, 1.0, 1.0]
        opacity = (values["d"] or [1.0])[0] or 1.0
        made: dict[str, Any] = {
            "name": name,
            "pbrMetallicRoughness": {
                "baseColorFactor": [*rgb, opacity],
                "metallicFactor": (values["pm"] or [0.0])[0],
                "roughnessFactor": (values["pr"] or [1.0])[0],
            },
            "doubleSided": True,
        }
        emission = _linear(values["ke"])
        if "emissiveTexture" in found or any(emission):
            made["emissiveFactor"] = emission if any(emission) else [1.0, 1.0, 1.0]
        if opacity < 1 or (cut_out and "baseColorTexture" in found):
            made["alphaMode"] = "BLEND" if opacity < 1 else "MASK"
        return Material(made, found)

    def _images(self, names: Mapping[str, str], folder: str) -> dict[str, bytes]:
        """The images by the names that glTF has for them."""
        found: dict[str, bytes] = {}
        for word, name in names.items():
            bare = posixpath.basename(_path("", name))
            there = self._first_there([_path(folder, name), _path(folder, bare), bare])
            content = None if there is None else self._read(there)
            if content is None:
                self._lose(_NOT_THERE.format(what="texture"), name)
            elif media_type(content) is None:
                self._lose("expected a texture as PNG or JPEG, got {}: left out; convert it", name)
            else:
                found[_PLACES[word]] = content
        return found

    def _first_there(self, paths: Sequence[str]) -> str | None:
        """Where the writer's machine had the file, or else where its mere name leads on ours."""
        return next((path for path in paths if self._read(path) is not None), None)

    def _lose(self, words: str, name: str) -> None:
        self._lost.setdefault(words, {})[name] = None

    def _read(self, path: str) -> bytes | None:
        if path not in self._files:
            self._files[path] = self._beside(quote(path)) if path else None
        return self._files[path]


def _materials(lines: Iterable[str]) -> Iterator[tuple[str, _Statements]]:
    name, statements = "", _Statements()
    for line in lines:
        words = line.partition("#")[0].split() if "map_" not in line else line.split()
        if not words:
            continue
        if words[0].lower() == "newmtl":
            yield name, statements
            name, statements = " ".join(words[1:]), {}
        else:
            statements[words[0].lower()] = words[1:]
    yield name, statements


def _image_name(words: list[str]) -> tuple[str, bool]:
    """The file behind the options of a texture, and whether these leave the texture as it is."""
    at, plain = 0, True
    while at < len(words) - 1 and words[at] in _OPTIONS:
        option, first = words[at], at + 1
        at = first
        while (
            at < len(words) - 1 and at - first < _OPTIONS[option] and (at == first or _numbers([words[at]]))
        ):
            at += 1
        neutral = {"-o": 0.0, "-t": 0.0, "-s": 1.0}.get(option)
        plain = plain and (neutral is None or all(_is(word, neutral) for word in words[first:at]))
    return " ".join(words[at:]), plain


def _is(word: str, number: float) -> bool:
    try:
        return float(word) == number
    except ValueError:
        return False


def _numbers(words: Sequence[str]) -> list[float]:
    """The words as numbers from 0 to 1; none of them if one is no number."""
    try:
        values = np.array(words, np.float64)
    except ValueError:
        return []
    return [] if np.isnan(values).any() else np.clip(values, 0.0, 1.0).tolist()


def _linear(srgb: list[float]) -> list[float]:
    """Red, green and blue; one number is grey, none no colour."""
    rgb = srgb[:3] if len(srgb) >= 3 else srgb[:1] * 3
    linear: list[float] = linear_light(np.array(rgb, np.float64)).tolist()
    return linear


def _path(folder: str, name: str) -> str:
    path = posixpath.normpath(posixpath.join(folder, name.strip().strip('"').replace("\\", "/")))
    return "" if path == "." else path
