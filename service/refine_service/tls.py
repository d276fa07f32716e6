"""The certificate of both transports, read again when its file has changed."""

from __future__ import annotations

import logging
import ssl
from pathlib import Path

import grpc

from .settings import ServiceSettings

log = logging.getLogger(__name__)


class Tls:
    """A certificate chain and its key, in PEM; the last good pair is used while the files do not fit."""

    def __init__(self, certificate: Path, key: Path) -> None:
        """Raises OSError if they cannot be used."""
        self._certificate, self._key = certificate, key
        self._version = self._files_version()
        self._context = self._load()
        self._pem = self._read()

    @classmethod
    def from_settings(cls, settings: ServiceSettings) -> Tls | None:
        """None without the two settings."""
        if settings.tls_certificate is None or settings.tls_key is None:
            return None
        return cls(settings.tls_certificate, settings.tls_key)

    def context(self) -> ssl.SSLContext:
        """For one more connection over HTTP."""
        self._refresh()
        return self._context

    def grpc_credentials(self) -> grpc.ServerCredentials:
        """For the gRPC server, which asks for a newer pair at every connection."""

        def newest() -> grpc.ServerCertificateConfiguration:
            self._refresh()
            return grpc.ssl_server_certificate_configuration([self._pem])

        return grpc.dynamic_ssl_server_credentials(newest(), newest)

    def _refresh(self) -> None:
        try:
            version = self._files_version()
            if version == self._version:
                return
            self._version = version
            self._context, self._pem = self._load(), self._read()
            log.info("the TLS certificate has been read again")
        except OSError as error:
            log.error("the TLS certificate in use stays: %s", error)

    def _load(self) -> ssl.SSLContext:
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)  # TLS 1.2 or newer
        try:
            context.load_cert_chain(self._certificate, self._key)
        except OSError as error:  # ssl.SSLError is one
            raise OSError(
                f"expected a certificate chain and its key in PEM, {self._certificate} and {self._key}, "
                f"got: {error}"
            ) from error
        return context

    def _read(self) -> tuple[bytes, bytes]:
        return self._key.read_bytes(), self._certificate.read_bytes()

    def _files_version(self) -> tuple[tuple[int, int, int], ...]:
        stats = [file.stat() for file in (self._certificate, self._key)]
        return tuple((stat.st_mtime_ns, stat.st_size, stat.st_ino) for stat in stats)
