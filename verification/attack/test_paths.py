"""Names from outside never become paths: not out of the folders a site allows, and never to what is no plain file."""

import os
import socket
import threading

import pytest

from engine.calibration.camera_calibration import STRICT
from engine.capture.oni.reader import OniReader
from engine.core.errors import CalibrationError, ModelError, RecordingError
from engine.core.files import open_plain
from engine.motion.learning.model_file import load_model
from engine.qa.recorded_traces import read_trace
from engine.qa.trace import read_commanded
from lab.evaluation.instruments.flow_file import FlowFileError, read_flow
from service.core.errors import BoundError, NotFoundError
from service.engine_host.site_limits.recording_folders import find_recording

OUTSIDE = [
    "../secret.oni",
    "a/../../secret.oni",
    "./../secret.oni",
    "/etc/passwd",
    "/proc/self/environ",
    "/proc/self/root/etc/passwd",
    "/dev/zero",
    "/dev/stdin",
    "//etc/passwd",
    "link-out",
    "link-out-folder/secret.oni",
    "link-to-proc/environ",
]
NOWHERE = [
    "..",
    ".",
    "",
    "a",
    "pipe",
    "socket",
    "link-to-zero-inside",
    "circle",
    "circle/a.oni",
    "a.oni\0.png",
    "\0",
    "~/a.oni",
    "%2e%2e/secret.oni",
    "..\\secret.oni",
    "a.oni\n",
    "n" * 300,
    "n/" * 3000,
    "\ud800",
    "a\u0301.oni",
    "\uff0e\uff0e/secret.oni",
    "\u2025/secret.oni",
    "file:///etc/passwd",
    "a.oni;id",
    "$(id)",
]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "secret.oni").write_bytes(b"secret")
    allowed = tmp_path / "recordings"
    (allowed / "a").mkdir(parents=True)
    (allowed / "a.oni").write_bytes(b"recording")
    (allowed / "ünïcode.oni").write_bytes(b"recording")
    (allowed / "link-in").symlink_to(allowed / "a.oni")
    (allowed / "link-out").symlink_to(tmp_path / "secret.oni")
    (allowed / "link-out-folder").symlink_to(tmp_path)
    (allowed / "link-to-proc").symlink_to("/proc/self")
    (allowed / "link-to-zero-inside").symlink_to("/dev/zero")
    (allowed / "circle").symlink_to(allowed / "circle")
    os.mkfifo(allowed / "pipe")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(allowed / "socket"))
        yield allowed


@pytest.mark.parametrize("path", [*OUTSIDE, *NOWHERE])
def test_a_path_that_leads_out_or_to_no_plain_file_is_refused(folder, path):
    with pytest.raises((BoundError, NotFoundError)):
        find_recording(path, (folder,))


@pytest.mark.parametrize("path", OUTSIDE)
def test_nothing_is_revealed_of_paths_outside_not_even_their_existence(folder, path):
    with pytest.raises(BoundError) as refusal:
        find_recording(path, (folder,))
    with pytest.raises(BoundError) as other:
        find_recording("../not-there", (folder,))
    assert refusal.value.bound == other.value.bound


@pytest.mark.parametrize("path", ["a.oni", "./a.oni", "a/../a.oni", "a.oni/", "link-in", "ünïcode.oni"])
def test_a_recording_inside_is_found_by_any_of_its_names(folder, path):
    assert find_recording(path, (folder,)).read_bytes() == b"recording"


READERS = {
    "recording": (OniReader, RecordingError),
    "trace": (read_commanded, RecordingError),
    "breathing": (read_trace, RecordingError),
    "flow": (read_flow, FlowFileError),
    "model": (load_model, ModelError),
    "calibration": (STRICT.load, CalibrationError),
}
NO_FILES = ["pipe", "socket", "a", "link-to-zero-inside", "circle", "not-there", "n" * 300]


@pytest.mark.parametrize("name", NO_FILES)
@pytest.mark.parametrize("kind", READERS)
def test_no_reader_waits_for_a_pipe_or_reads_a_device(folder, kind, name):
    read, refusal = READERS[kind]
    ended = threading.Event()
    found = []

    def try_it() -> None:
        try:
            read(folder / name)
        except refusal as error:
            found.append(error)
        ended.set()

    threading.Thread(target=try_it, daemon=True).start()
    assert ended.wait(5.0), "still waiting"
    assert found, "read as if it were one"


def test_what_was_opened_is_looked_at_and_not_its_name(folder):
    with open_plain(folder / "link-in") as file:
        assert file.read() == b"recording"
    with pytest.raises(OSError, match="no plain file"):
        open_plain(folder / "pipe")
