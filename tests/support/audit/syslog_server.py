"""A real syslog daemon over TLS, as a hospital runs one: Debian's rsyslog, with certificates of the tests' own.

It runs with the department's file (docker/department/rsyslog.conf); only folders, certificates and port are replaced.
"""

import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Self

import pytest

from tests.support.audit.syslog_certificates import Pair
from tests.support.repository import ROOT

DAEMON = shutil.which("rsyslogd") or "/usr/sbin/rsyslogd"
CONFIG = ROOT / "docker/department/rsyslog.conf"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class SyslogDaemon:
    """A daemon that can be stopped, killed and started again at the same place."""

    def __init__(self, folder: Path, *, ca_file: Path, pair: Pair) -> None:
        assert Path(DAEMON).exists(), "rsyslog is not installed: make test-system"
        self.port = free_port()
        self.out = folder / "received"
        self._config, self._pid_file = folder / "rsyslog.conf", folder / "rsyslog.pid"
        own = {
            "/var/spool/rsyslog": folder,
            "/run/secrets/site_ca": ca_file,
            "/run/secrets/tls_cert": pair.cert,
            "/run/secrets/collector_tls_key": pair.key,
            'port="6514"': f'address="127.0.0.1" port="{self.port}"',
            "/var/log/tidegate": self.out,
        }
        text = CONFIG.read_text(encoding="utf-8")
        for shipped, mine in own.items():
            assert shipped in text, shipped
            text = text.replace(shipped, str(mine))
        self._config.write_text(text)
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> Self:
        self._pid_file.unlink(missing_ok=True)
        arguments = [DAEMON, "-n", "-f", str(self._config), "-i", str(self._pid_file)]
        self._process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end_s = time.monotonic() + 20.0
        while time.monotonic() < end_s:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return self
            assert self._process.poll() is None, "rsyslogd ended at once"
            time.sleep(0.02)
        self.stop()
        pytest.fail("rsyslogd did not listen in time")

    def stop(self, number: int = signal.SIGTERM) -> None:
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait(10.0)
        self._process = None

    def messages(self) -> list[bytes]:
        files = sorted(self.out.rglob("*.log"))
        return [line for file in files for line in file.read_bytes().split(b"\n") if line]
