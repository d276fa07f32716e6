"""How much an untrusted mesh file may ask for. Checked from headers, before anything of that size is
allocated."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from refine_proto import formats

from ..errors import FormatUnsupported, InputError, MeshInvalid


@dataclass(frozen=True)
class MeshLimits:
    """The largest mesh that is read. How many bytes a file may have is up to whoever receives it.

    `max_vertices` counts the vertices that are optimised, after welding. A closed triangle mesh has about six
    corners per vertex, so a file in which every triangle has its own three vertices (STL, flat-shaded GLB)
    holds about six times as many: `max_source_vertices` is what a file may hold before welding.
    """

    max_vertices: int = 500_000
    max_faces: int = 2_000_000

    @property
    def max_source_vertices(self) -> int:
        return 6 * self.max_vertices

    def check_source(self, vertices: int, faces: int) -> None:
        """Refuse what a header announces, or what the file turned out to hold before welding."""
        if vertices > self.max_source_vertices:
            raise MeshInvalid(
                f"expected at most {self.max_source_vertices} vertices in the file "
                f"({self.max_vertices} after welding), got {vertices}; simplify the mesh first"
            )
        if faces > self.max_faces:
            raise MeshInvalid(
                f"expected at most {self.max_faces} triangles, got {faces}; simplify the mesh first"
            )

    def check_welded(self, vertices: int) -> None:
        if vertices > self.max_vertices:
            raise MeshInvalid(
                f"expected at most {self.max_vertices} vertices after welding, got {vertices}; "
                "simplify the mesh first"
            )


@contextmanager
def refused_as(damaged: type[InputError]) -> Iterator[None]:
    """Tell what `refine_proto.formats` refuses as FormatUnsupported or as `damaged`."""
    try:
        yield
    except formats.Unsupported as error:
        raise FormatUnsupported(str(error)) from None
    except formats.Damaged as error:
        raise damaged(str(error)) from None


def one_line(error: Exception) -> str:
    """A parser's complaint, short and on one line, for use inside our own message."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:120]
