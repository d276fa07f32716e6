"""REFINE_* settings of the service; those that it shares with the worker are in refine_jobs.settings."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from refine_jobs.settings import EnvironmentSettings

_MIB = 2**20
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def _split(value: Any) -> Any:
    return [word.strip() for word in value.split(",")] if isinstance(value, str) else value


def _words(value: Any) -> Any:
    return [word.strip().rstrip("/") for word in value.split(",")] if isinstance(value, str) else value


class ServiceSettings(EnvironmentSettings):
    """Where the service listens and what it lets in."""

    host: str = Field("127.0.0.1", description="Address to listen on; 0.0.0.0 for all.")
    http_port: int = Field(8000, ge=0, le=65535, description="0: any free one.")
    grpc_port: int = Field(50051, ge=0, le=65535, description="0: any free one.")
    keys_file: Path | None = Field(None, description="API keys, hashed; unset: keys.json in the data folder.")
    require_key: bool | None = Field(
        None, description="Whether every call needs an API key; unset: unless only this machine can connect."
    )
    metrics_need_key: bool = Field(False, description="Whether /metrics needs a key with the scope admin.")
    requests_per_s: float = Field(50, gt=0, description="Calls of one API key to one service process.")
    max_mesh_bytes: int = Field(256 * _MIB, ge=1, description="Largest mesh file.")
    max_silhouette_bytes: int = Field(
        64 * _MIB, ge=1, description="Silhouettes and ignore masks of one request."
    )
    max_json_bytes: int = Field(
        16 * _MIB, ge=1, description="Largest JSON body: base64 in it is held in memory."
    )
    max_connections: int = Field(1024, ge=8, description="Open connections over HTTP, and as many over gRPC.")
    max_connections_per_address: int = Field(
        256, ge=1, description="Over HTTP from one address; of a proxy in front: all that it opens."
    )
    max_uploads: int = Field(
        128, ge=1, description="Bodies of submissions that are read at a time; of one owner three quarters."
    )
    max_watchers: int = Field(1000, ge=1, description="Event streams at a time; of one owner three quarters.")
    max_header_bytes: int = Field(64 * 1024, ge=1024, description="Largest head of one HTTP request.")
    head_timeout_s: float = Field(
        10, gt=0, description="From a connection or the last answer until the next request has its head."
    )
    write_timeout_s: float = Field(
        60, gt=0, description="How long a caller over HTTP may take nothing of an answer that waits for it."
    )
    log_lines_per_s: int = Field(1000, ge=1, description="Of warnings and errors, and of the other lines.")
    upload_timeout_s: float = Field(300, gt=0, description="Longest time that one upload may take.")
    answer_timeout_s: float = Field(
        20, gt=0, description="How long a call waits for a worker slot that answers a question."
    )
    reachable_networks: Annotated[tuple[Network, ...], BeforeValidator(_split)] = Field(
        (),
        description="Private networks that callers may name, also over http: 10.1.0.0/16,127.0.0.1",
    )
    grace_s: float = Field(20, gt=0, description="From SIGTERM until calls that still run are cut off.")
    cors_origins: Annotated[tuple[str, ...], BeforeValidator(_words)] = Field(
        (), description="Origins whose pages may call, with commas: https://app.example; none."
    )
    tls_certificate: Path | None = Field(None, description="Certificate chain (PEM) of REST and gRPC.")
    tls_key: Path | None = Field(None, description="Its private key (PEM).")
    grpc_reflection: bool = Field(False, description="Let gRPC clients list services and messages.")

    @model_validator(mode="after")
    def _certificate_with_key(self) -> Self:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("expected both REFINE_TLS_CERTIFICATE and REFINE_TLS_KEY, or none")
        return self

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can connect."""
        return _is_loopback(self.host)

    @property
    def key_required(self) -> bool:
        """require_key, or whether another machine can connect."""
        return not self.is_loopback if self.require_key is None else self.require_key

    def keys_path(self, data_folder: Path) -> Path:
        """keys_file, or its place in the data folder."""
        return self.keys_file or data_folder / "keys.json"


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
