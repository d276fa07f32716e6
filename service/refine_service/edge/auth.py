"""Who calls, with which rights: bearer API keys, and how many calls of one owner are let through.

Keys live in a file, not in Redis: `refine keys` works before anything runs, sign-in does not depend on Redis,
who can write jobs cannot make keys, and several services share the file as a mounted secret. A key has 256
random bits, so one SHA-256 protects it; the file holds nothing that signs in. The secrets that sign webhooks
are in it as they are.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from refine_proto.errors import Forbidden, QuotaExceeded, Unauthenticated
from refine_proto.models import Priority
from refine_proto.webhook_messages import new_secret

from .call import Call

OWNER = r"^[A-Za-z0-9._@-]{1,64}$"
ANONYMOUS = "anonymous"  # the owner of what is submitted without a key
_BURST_S = 2.0  # a key that was quiet may make the calls of this long at once

log = logging.getLogger(__name__)


class Scope(StrEnum):
    """What a key lets its owner do."""

    SUBMIT = "submit"  # make, cancel and delete refinements
    READ = "read"  # see and download them
    ADMIN = "admin"  # scrape the metrics, where they need a key


class ApiKey(BaseModel):
    """What is kept of a key."""

    model_config = ConfigDict(frozen=True)

    id: str
    owner: str = Field(pattern=OWNER)
    sha256: str
    created_at: datetime
    max_priority: Priority = Priority.NORMAL
    expires_at: datetime | None = None
    scopes: tuple[Scope, ...] = (Scope.SUBMIT, Scope.READ)

    @property
    def expired(self) -> bool:
        """Whether it is refused by now."""
        return self.expires_at is not None and datetime.now(UTC) >= self.expires_at


class WebhookSecret(BaseModel):
    """A secret that signs an owner's webhooks. Several may, so that receivers can change over in between."""

    model_config = ConfigDict(frozen=True)

    owner: str = Field(pattern=OWNER)
    secret: str
    created_at: datetime
    until: datetime | None = None  # unset: the newest

    def signs(self, now: datetime) -> bool:
        """Whether it still does."""
        return self.until is None or now < self.until


class _File(BaseModel):
    keys: list[ApiKey] = []
    webhook_secrets: list[WebhookSecret] = []


class KeysFileInvalid(Exception):
    """The file of keys cannot be read; the message says why."""


class ApiKeys:
    """The keys in a file, read again when it has changed; a damaged one leaves those of before in force."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._version: tuple[int, int, int] | None = None
        self._keys: dict[str, ApiKey] = {}  # by sha256
        self._webhook_secrets: list[WebhookSecret] = []

    def all(self) -> list[ApiKey]:
        """Every key, oldest first."""
        return self._read().keys

    def _read(self) -> _File:
        try:
            return _File.model_validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return _File()
        except ValidationError as error:
            raise KeysFileInvalid(
                f"expected a file written by `refine keys`, {self._path}: {error}"
            ) from error

    def add(
        self,
        owner: str,
        scopes: Sequence[Scope] = (),
        expires_at: datetime | None = None,
        max_priority: Priority = Priority.NORMAL,
    ) -> tuple[ApiKey, str]:
        """A new key of `owner`: what is kept, and the key itself, which nobody can show again."""
        key, secret = _new_key(owner)
        rights = {
            "expires_at": expires_at,
            "scopes": tuple(scopes) or key.scopes,
            "max_priority": max_priority,
        }
        key = key.model_copy(update=rights)
        with self._locked():
            file = self._read()
            self._write(file.model_copy(update={"keys": [*file.keys, key]}))
        return key, secret

    def rotate(self, key_id: str, overlap: timedelta) -> tuple[ApiKey, str] | None:
        """A new key in the place of one that goes on for `overlap`; None if there is none with this id."""
        with self._locked():
            file = self._read()
            old = next((key for key in file.keys if key.id == key_id), None)
            if old is None:
                return None
            new, secret = _new_key(old.owner)
            new = new.model_copy(update={"scopes": old.scopes, "max_priority": old.max_priority})
            end = datetime.now(UTC) + overlap
            ending = old.model_copy(update={"expires_at": min(old.expires_at or end, end)})
            kept = [ending if key is old else key for key in file.keys]
            self._write(file.model_copy(update={"keys": [*kept, new]}))
        return new, secret

    def revoke(self, key_id: str) -> bool:
        """Whether there was a key with this id; running services refuse it from now on."""
        with self._locked():
            file = self._read()
            kept = [key for key in file.keys if key.id != key_id]
            self._write(file.model_copy(update={"keys": kept}))
        return len(kept) < len(file.keys)

    def add_webhook_secret(self, owner: str, overlap: timedelta) -> str:
        """A new secret of `owner`, whose earlier ones sign beside it for `overlap` more."""
        now = datetime.now(UTC)
        new = WebhookSecret(owner=owner, secret=new_secret(), created_at=now)
        with self._locked():
            file = self._read()
            kept = [
                old.model_copy(update={"until": min(old.until or now + overlap, now + overlap)})
                if old.owner == owner
                else old
                for old in file.webhook_secrets
                if old.signs(now)
            ]
            self._write(file.model_copy(update={"webhook_secrets": [*kept, new]}))
        return new.secret

    def webhook_secrets(self, owner: str) -> list[str]:
        """What signs the owner's webhooks now, newest first."""
        self._refresh_if_good()
        now = datetime.now(UTC)
        found = [each.secret for each in self._webhook_secrets if each.owner == owner and each.signs(now)]
        return found[::-1]

    def find(self, secret: str) -> ApiKey | None:
        """What is kept of a key, expired or not, or None."""
        self._refresh_if_good()
        return self._keys.get(_sha256(secret))

    def _refresh_if_good(self) -> None:
        try:
            self.refresh()
        except (OSError, KeysFileInvalid) as error:
            log.error("the API keys of before stay in force: %s", error)

    def refresh(self) -> None:
        """Read the file if it has changed; raises KeysFileInvalid and OSError, once for each change."""
        try:
            stat = self._path.stat()
        except FileNotFoundError:
            self._version, self._keys, self._webhook_secrets = None, {}, []
            return
        version = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
        if version != self._version:
            self._version = version
            file = self._read()
            self._keys = {key.sha256: key for key in file.keys}
            self._webhook_secrets = file.webhook_secrets

    @contextmanager
    def _locked(self) -> Iterator[None]:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _write(self, content: _File) -> None:
        with tempfile.NamedTemporaryFile("w", dir=self._path.parent, delete=False) as file:  # mode 0600
            file.write(content.model_dump_json(indent=2))
        os.replace(file.name, self._path)


class CallRate:
    """A token bucket per owner, in this process."""

    def __init__(self, calls_per_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate = calls_per_s
        self._capacity = max(1.0, calls_per_s * _BURST_S)
        self._clock = clock
        self._buckets: dict[str, tuple[float, float]] = {}  # owner -> tokens left, at this time

    def take(self, owner: str) -> None:
        """Let one call through or raise QuotaExceeded."""
        now = self._clock()
        tokens, since = self._buckets.get(owner, (self._capacity, now))
        tokens = min(self._capacity, tokens + (now - since) * self._rate)
        if tokens < 1:
            raise QuotaExceeded(
                f"expected at most {self._rate:g} calls per second with this key, got more; slow down",
                retry_after_s=(1 - tokens) / self._rate,
            )
        self._buckets[owner] = (tokens - 1, now)


class Auth:
    """Turns the Authorization header into an owner and what that may ask for."""

    def __init__(self, keys: ApiKeys, rate: CallRate, required: bool) -> None:
        self._keys, self._rate, self._required = keys, rate, required

    def sign_in(self, call: Call, authorization: str | None, scope: Scope) -> None:
        """Write into `call` whose it is and what it may; raises Unauthenticated, Forbidden, QuotaExceeded."""
        key = self.identify(authorization)
        if key is None:
            call.owner, call.max_priority = ANONYMOUS, Priority.HIGH  # who has no key has nobody beside
            return
        if scope not in key.scopes:
            raise Forbidden(
                f"expected an API key with the scope {scope}, got one with {', '.join(key.scopes)}; ask the "
                "operator for another key"
            )
        self._rate.take(key.owner)
        call.owner, call.max_priority = key.owner, key.max_priority

    def identify(self, authorization: str | None) -> ApiKey | None:
        """The key, or None where none is needed; raises Unauthenticated. A wrong key is never anonymous."""
        if not authorization and not self._required:
            return None
        scheme, _, secret = (authorization or "").partition(" ")
        if scheme.lower() != "bearer" or not secret:
            raise Unauthenticated(
                "expected the header `Authorization: Bearer <API key>`; ask the operator for a key"
            )
        key = self._keys.find(secret.strip())
        if key is None:
            raise Unauthenticated("expected a valid API key, got an unknown or revoked one")
        if key.expired:
            raise Unauthenticated("expected a valid API key, got an expired one; ask for a new one")
        return key

    def webhook_secrets(self, owner: str) -> list[str]:
        """What signs the owner's webhooks, newest first; none: the owner cannot have any."""
        return self._keys.webhook_secrets(owner)


def _new_key(owner: str) -> tuple[ApiKey, str]:
    secret = f"refine_{secrets.token_urlsafe(32)}"
    digest = _sha256(secret)
    return ApiKey(id=digest[:12], owner=owner, sha256=digest, created_at=datetime.now(UTC)), secret


def _sha256(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
