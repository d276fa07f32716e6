"""Base64 in JSON is read strictly, and data URIs are read at all."""

from __future__ import annotations

import base64

import pytest
from pydantic import TypeAdapter, ValidationError

from refine_proto.base64_bytes import Base64Bytes

BYTES: TypeAdapter[bytes] = TypeAdapter(Base64Bytes)
DATA = bytes(range(256))
TEXT = base64.b64encode(DATA).decode()


@pytest.mark.parametrize(
    "text",
    [TEXT, base64.encodebytes(DATA).decode(), f"data:image/png;base64,{TEXT}", f"data:;base64,{TEXT}",
     f"data:model/gltf-binary;charset=x;base64,{TEXT}"],
)  # fmt: skip
def test_what_is_read(text: str) -> None:
    assert BYTES.validate_python(text) == DATA
    assert BYTES.dump_python(DATA, mode="json") == TEXT


@pytest.mark.parametrize(
    "text",
    ["****", TEXT[:-1], TEXT + "!", "AA=A", base64.urlsafe_b64encode(DATA).decode(), "data:image/png,abc"],
)
def test_what_is_refused(text: str) -> None:
    with pytest.raises(ValidationError, match="expected base64"):
        BYTES.validate_python(text)
