"""A real PACS: Debian's Orthanc in a process of its own, with a folder that outlives it."""

import base64
import json
import socket
import ssl
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.support.service.processes import free_port
from tests.support.waiting import eventually

TITLE = "ARCHIVE"
HEAD = {"Authorization": "Basic " + base64.b64encode(b"test:test").decode()}


@dataclass
class Orthanc:
    """Where it listens, and what is in it."""

    folder: Path
    dicom_port: int = field(default_factory=free_port)
    http_port: int = field(default_factory=free_port)
    tls: tuple[Path, Path, Path] | None = None
    commit_port: int | None = None

    @property
    def place(self) -> str:
        return f"{TITLE}@localhost:{self.dicom_port}"

    def ask(self, path: str) -> Any:
        request = urllib.request.Request(f"http://127.0.0.1:{self.http_port}/{path}", headers=HEAD)
        with urllib.request.urlopen(request, timeout=10.0) as answer:
            content = answer.read()
        return json.loads(content) if answer.headers["Content-Type"].startswith("application/json") else content

    def files(self) -> list[bytes]:
        """Every stored file, as it is given out again."""
        return [self.ask(f"instances/{one}/file") for one in self.ask("instances")]

    @contextmanager
    def running(self) -> Iterator["Orthanc"]:
        settings = {
            "Name": "archive",
            "StorageDirectory": str(self.folder / "storage"),
            "IndexDirectory": str(self.folder / "storage"),
            "DicomAet": TITLE,
            "DicomPort": self.dicom_port,
            "HttpPort": self.http_port,
            "RegisteredUsers": {"test": "test"},
            "DicomAlwaysAllowStore": True,
        }
        if self.commit_port is not None:
            settings["DicomModalities"] = {"gating": ["TIDEGATE", "127.0.0.1", self.commit_port]}
        if self.tls is not None:
            certificate, key, authorities = map(str, self.tls)
            settings |= {
                "DicomTlsEnabled": True,
                "DicomTlsCertificate": certificate,
                "DicomTlsPrivateKey": key,
                "DicomTlsTrustedCertificates": authorities,
                "DicomTlsRemoteCertificateRequired": False,
            }
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "orthanc.json").write_text(json.dumps(settings))
        with (self.folder / "log").open("ab") as log:
            process = subprocess.Popen(["Orthanc", str(self.folder / "orthanc.json")], stdout=log, stderr=log)
        try:
            eventually(lambda: self._is_up(process), detail=lambda: (self.folder / "log").read_text()[-2000:])
            yield self
        finally:
            process.terminate()
            process.wait(30.0)

    def _is_up(self, process: subprocess.Popen[bytes]) -> bool:
        assert process.poll() is None, (self.folder / "log").read_text()[-2000:]
        try:
            self.ask("system")
            with socket.create_connection(("127.0.0.1", self.dicom_port), timeout=1.0):
                return True
        except (OSError, ssl.SSLError):
            return False
