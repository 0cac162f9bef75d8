"""A rig that is killed outright leaves no process behind: a receiver's priority is no ordinary process's."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.repository import ROOT

PATIENCE_S = 20.0
HELD = """
import sys, time
from pathlib import Path
from verification.faults.plan import DEFAULT_PLAN
from verification.faults.rig import Rig
with Rig(Path(sys.argv[1]), DEFAULT_PLAN, None) as rig:
    print(rig.pid, rig.engine_pid, rig.receiver.process.pid, rig.watchman.pid, flush=True)
    time.sleep(600)
"""

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="a small file system is mounted, which takes root"),
    pytest.mark.waiting,
]


def test_killing_a_rig_ends_its_service_its_engine_its_receiver_and_its_watchman(tmp_path):
    rig = subprocess.Popen([sys.executable, "-c", HELD, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    with rig:
        try:
            pids = [int(word) for word in rig.stdout.readline().split()]
            assert len(pids) == 4
            rig.send_signal(signal.SIGKILL)
            rig.wait()
            end_s = time.monotonic() + PATIENCE_S
            while any(_lives(pid) for pid in pids):
                assert time.monotonic() < end_s, [pid for pid in pids if _lives(pid)]
                time.sleep(0.05)
        finally:
            rig.kill()
            subprocess.run(["umount", "--lazy", str(tmp_path / "data")], check=False, capture_output=True)


def _lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"  # its new parent has not reaped it yet
