"""When the service's own TLS certificate ends."""

from datetime import datetime
from pathlib import Path

from cryptography import x509

MOST_BYTES = 1024 * 1024


class CertificateWatch:
    """Reads the file again whenever it was replaced."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._found: tuple[tuple[int, int], datetime] | None = None

    @property
    def is_there(self) -> bool:
        """Whether the service speaks TLS itself."""
        return self._path is not None

    def ends_at(self) -> datetime | None:
        """Return when the first of a chain to end does; None without TLS.

        Raises
        ------
        OSError
            The file cannot be read.
        ValueError
            It holds no certificate.
        """
        if self._path is None:
            return None
        stat = self._path.stat()
        version = (stat.st_mtime_ns, stat.st_size)
        if self._found is None or self._found[0] != version:
            with self._path.open("rb") as file:
                chain = x509.load_pem_x509_certificates(file.read(MOST_BYTES))
            self._found = (version, min(one.not_valid_after_utc for one in chain))
        return self._found[1]
