"""A real syslog daemon over TLS, as a hospital runs one: Debian's rsyslog, with certificates of the tests' own."""

import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Self

import pytest

from tests.support.audit.syslog_certificates import Pair

DAEMON = shutil.which("rsyslogd") or "/usr/sbin/rsyslogd"
CONFIG = """
global(workDirectory="{folder}" maxMessageSize="64k" defaultNetstreamDriver="ossl"
  defaultNetstreamDriverCAFile="{ca}" defaultNetstreamDriverCertFile="{cert}" defaultNetstreamDriverKeyFile="{key}")
module(load="imtcp" streamDriver.name="ossl" streamDriver.mode="1" streamDriver.authMode="x509/name"
  permittedPeer=["tidegate.test"])
template(name="whole" type="string" string="%rawmsg%\\n")
ruleset(name="audit") {{ action(type="omfile" file="{out}" template="whole" fileCreateMode="0600") }}
input(type="imtcp" port="{port}" address="127.0.0.1" ruleset="audit")
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class SyslogDaemon:
    """A daemon that can be stopped, killed and started again at the same place."""

    def __init__(self, folder: Path, *, ca_file: Path, pair: Pair) -> None:
        assert Path(DAEMON).exists(), "rsyslog is not installed: make test-system"
        self.port = free_port()
        self.out = folder / "received.log"
        self._config, self._pid_file = folder / "rsyslog.conf", folder / "rsyslog.pid"
        values = {"folder": folder, "ca": ca_file, "cert": pair.cert, "key": pair.key}
        self._config.write_text(CONFIG.format(out=self.out, port=self.port, **values))
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
        return [line for line in self.out.read_bytes().split(b"\n") if line] if self.out.exists() else []
