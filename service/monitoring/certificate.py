"""Expiry of the service's own TLS certificate."""

from datetime import datetime
from pathlib import Path

from cryptography import x509

MAX_BYTES = 1024 * 1024


class CertificateWatch:
    """Reads the certificate's expiry; reads the file again after it was replaced."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._found: tuple[tuple[int, int], datetime] | None = None

    @property
    def is_there(self) -> bool:
        """Whether the service terminates TLS itself."""
        return self._path is not None

    def ends_at(self) -> datetime | None:
        """Return the earliest expiry in the certificate chain (UTC); None without TLS.

        Raises
        ------
        OSError
            The file cannot be read.
        ValueError
            The file contains no certificate.
        """
        if self._path is None:
            return None
        stat = self._path.stat()
        version = (stat.st_mtime_ns, stat.st_size)
        if self._found is None or self._found[0] != version:
            with self._path.open("rb") as file:
                chain = x509.load_pem_x509_certificates(file.read(MAX_BYTES))
            self._found = (version, min(one.not_valid_after_utc for one in chain))
        return self._found[1]
