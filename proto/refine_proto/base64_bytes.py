"""Bytes in JSON: base64 or a `data:` URI of it. What is neither is refused and never skipped over."""

from __future__ import annotations

import base64
import binascii
import re
from typing import Annotated

from pydantic import EncodedBytes, EncoderProtocol

from .strict import short

_DATA_URI = re.compile(rb"data:[^,]{0,256};base64,", re.IGNORECASE)
_BREAKS = b" \t\r\n"  # `base64 FILE` breaks its lines


class _Base64(EncoderProtocol):
    """RFC 4648 section 4, padded."""

    @classmethod
    def decode(cls, data: bytes) -> bytes:
        start = _DATA_URI.match(data)
        try:
            return base64.b64decode(
                data[start.end() if start else 0 :].translate(None, _BREAKS), validate=True
            )
        except binascii.Error as error:
            raise ValueError(
                f"expected base64 (RFC 4648, padded) or a data: URI of it, got {short(data[:60])}: {error}"
            ) from None

    @classmethod
    def encode(cls, value: bytes) -> bytes:
        return base64.b64encode(value)

    @classmethod
    def get_json_format(cls) -> str:
        return "base64"


Base64Bytes = Annotated[bytes, EncodedBytes(encoder=_Base64)]
