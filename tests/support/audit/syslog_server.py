"""Real syslog daemons, as a hospital runs them: Debian's rsyslog, with certificates of the tests' own.

They run with the files that are shipped (docker/department/rsyslog.conf and docker/room/rsyslog.conf); only folders,
certificates, names and ports are replaced.
"""

import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import pytest

from tests.support.audit.syslog_certificates import Pair
from tests.support.repository import ROOT

DAEMON = shutil.which("rsyslogd") or "/usr/sbin/rsyslogd"
COLLECTOR, SENDER = ROOT / "docker/department/rsyslog.conf", ROOT / "docker/room/rsyslog.conf"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class SyslogDaemon:
    """A daemon that can be stopped, killed and started again at the same place."""

    def __init__(self, folder: Path, shipped: Path, own: Mapping[str, object], before: str = "") -> None:
        assert Path(DAEMON).exists(), "rsyslog is not installed: make test-system"
        folder.mkdir(parents=True, exist_ok=True)
        self._config, self._pid_file = folder / "rsyslog.conf", folder / "rsyslog.pid"
        text = shipped.read_text(encoding="utf-8")
        for theirs, mine in own.items():
            assert theirs in text, theirs
            text = text.replace(theirs, str(mine))
        self._config.write_text(before + text)
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> Self:
        self._pid_file.unlink(missing_ok=True)
        arguments = [DAEMON, "-n", "-f", str(self._config), "-i", str(self._pid_file)]
        self._process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end_s = time.monotonic() + 20.0
        while time.monotonic() < end_s:
            if self.is_up():
                return self
            assert self._process.poll() is None, "rsyslogd ended at once"
            time.sleep(0.02)
        self.stop()
        pytest.fail("rsyslogd did not start in time")

    def is_up(self) -> bool:
        return self._pid_file.exists()

    def stop(self, number: int = signal.SIGTERM) -> None:
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait(10.0)
        self._process = None


class Collector(SyslogDaemon):
    """The department's collector: keeps what it receives."""

    def __init__(self, folder: Path, *, ca_file: Path, pair: Pair) -> None:
        self.port, self.out = free_port(), folder / "received"
        own = {
            "/var/spool/rsyslog": folder,
            "/run/secrets/site_ca": ca_file,
            "/run/secrets/tls_cert": pair.cert,
            "/run/secrets/collector_tls_key": pair.key,
            'port="6514"': f'address="127.0.0.1" port="{self.port}"',
            "/var/log/tidegate": self.out,
        }
        super().__init__(folder, COLLECTOR, own)

    def is_up(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def messages(self) -> list[bytes]:
        files = sorted(self.out.rglob("*.log"))
        return [line for file in files for line in file.read_bytes().split(b"\n") if line]


class Sender(SyslogDaemon):
    """The room's daemon: follows the audit's log file and sends its lines to the collector."""

    def __init__(self, folder: Path, log: Path, port: int, *, name: str, ca_file: Path, pair: Pair) -> None:
        own = {
            "/var/lib/tidegate/audit/": f"{log}/",
            'target="collector.example" port="6514"': f'target="127.0.0.1" port="{port}"',
            "collector.example": name,
            "/etc/tidegate/site-ca.pem": ca_file,
            "/etc/tidegate/cert.pem": pair.cert,
            "/etc/tidegate/key.pem": pair.key,
        }
        super().__init__(folder, SENDER, own, before=f'global(workDirectory="{folder}" maxMessageSize="64k")\n')
