"""REFINE_* settings that service and worker share. Built once in `main` and passed down."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, SecretStr

OWNER_ONLY = 0o077
"""The umask of our processes: what they write (files 0600, folders 0700) is their user's alone."""


class EnvironmentSettings(BaseModel):
    """Base of settings: field `redis_url` is read from REFINE_REDIS_URL; unset and empty mean the default."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Self:
        """The settings; pydantic's ValidationError names the field that cannot be read."""
        named = {field: environment.get(f"REFINE_{field.upper()}") for field in cls.model_fields}
        return cls.model_validate({field: value for field, value in named.items() if value})


class JobSettings(EnvironmentSettings):
    """Where jobs live and how long."""

    redis_url: SecretStr | None = Field(None, description="redis://, rediss:// or unix://; unset: embedded.")
    data_folder: Path = Field(Path("refine-data"), description="Embedded Redis, and blobs without blob_url.")
    blob_url: str | None = Field(
        None, description="s3://bucket/prefix (credentials and endpoint: the usual AWS_* variables)."
    )
    pool: str = Field("default", pattern="^[a-z0-9-]+$", description="Workers of one pool share one queue.")
    retention_s: float = Field(86_400, gt=0, description="From the end of a job to the removal of its data.")
    max_retention_s: float = Field(
        30 * 86_400, gt=0, description="Longest lifetime, from now on, that a caller may ask for."
    )
    tombstone_s: float = Field(7 * 86_400, gt=0, description="How long an expired id still answers 410.")
    idempotency_s: float = Field(86_400, gt=0, description="How long an idempotency key is remembered.")
    sync_submissions: bool = Field(
        True, description="Accept a submission only once Redis has it in its append-only file."
    )
    max_queued: int = Field(10_000, ge=1, description="Queued jobs of all owners; more: QUEUE_FULL.")
    max_queued_per_owner: int = Field(1_000, ge=1, description="Queued jobs of one; more: QUOTA_EXCEEDED.")
    max_attempts: int = Field(3, ge=1, description="Attempts that one job may lose before it fails.")
    job_timeout_s: float = Field(
        3_600, gt=0, description="Longest run of one attempt that a caller may ask for."
    )
    lease_s: float = Field(15, gt=0, description="A slot that does not renew for this long has lost its job.")

    @property
    def blob_location(self) -> str:
        """blob_url, or the folder for blobs."""
        return self.blob_url or str(self.data_folder / "blobs")
