"""How warm the room's camera is from session to session, and a camera that runs on between two of them."""

import json
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest

from engine.capture import SourceDescription, drivers
from engine.core.clock import MonotonicClock
from engine.core.errors import FrameTimeoutError, SourceLostError
from engine.core.warmth import Warmth
from service.core.schemas.sessions import DeviceSource
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.camera_warmth import (
    NAME,
    CameraClaim,
    CameraKeeper,
    ClaimingSource,
    RunTime,
    WarmingSource,
    WarmthFile,
    machine_run_time,
    warm_up_s,
)
from service.engine_host.local_engine import LocalEngine
from service.engine_host.protocols import SessionPlan
from tests.support.capture.fake_driver import FakeDriver, use
from tests.support.repository import ROOT
from tests.support.service.api_calls import WINDOW, make_calibration
from tests.support.waiting import eventually

ADDRESS, OTHER = "realsense:1234", "orbbec:77"
SERIAL, OTHER_SERIAL = "1234", "77"
WARM_UP_S = 1800.0


class Times:
    """The run time of a machine; its wall clock is not asked."""

    def __init__(self):
        self.boot, self.seconds = "the first start", 5_000.0

    def __call__(self):
        return RunTime(self.boot, self.seconds)

    def later(self, seconds):
        self.seconds += seconds


@pytest.fixture
def times():
    return Times()


@pytest.fixture
def file(tmp_path, times):
    return WarmthFile(tmp_path, times)


def warm(share=0.0):
    return Warmth(WARM_UP_S, share)


def written(file, serial=SERIAL, address=ADDRESS, share=0.0, *, is_used=True):
    file.write(serial, warm(share), address=address, is_used=is_used)


def test_a_camera_cools_between_two_sessions_and_another_is_cold(file, times):
    written(file, share=0.02)
    times.later(600.0)
    expected = warm(0.02)
    expected.rest(600.0)
    assert file.read(SERIAL, WARM_UP_S).cold_share == pytest.approx(expected.cold_share)
    assert file.read(OTHER_SERIAL, WARM_UP_S).cold_share == 1.0


def test_another_camera_at_the_same_socket_is_cold_and_so_is_one_without_a_serial_number(file):
    written(file, address="1d27/0609@1/5")
    written(file, serial="", address="1d27/0609@1/5")
    for serial in (OTHER_SERIAL, ""):
        assert file.read(serial, WARM_UP_S).cold_share == 1.0


def test_after_the_machine_s_next_start_every_camera_is_cold_whatever_its_clock_says(file, times):
    """Its power may have been off for a night, and the battery of the clock dead."""
    written(file)
    assert file.read(SERIAL, WARM_UP_S).cold_share == 0.0
    times.boot = "the second start"
    assert file.read(SERIAL, WARM_UP_S).cold_share == 1.0
    assert file.newest() is None
    times.boot, times.seconds = "the first start", 4_999.0
    assert file.read(SERIAL, WARM_UP_S).cold_share == 1.0
    times.boot = ""
    assert file.read(SERIAL, WARM_UP_S).cold_share == 1.0


def test_the_run_time_of_this_machine_goes_on(tmp_path):
    first, second = machine_run_time(), machine_run_time()
    assert first.boot == second.boot != ""
    assert 0.0 < first.seconds <= second.seconds


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{",
        '{"1234": [0.0, "the first start", 5000.0]}',
        '{"1234": [-0.1, "the first start", 5000.0, 5000.0, "a"]}',
        '{"1234": [NaN, "the first start", 5000.0, 5000.0, "a"]}',
        '{"1234": [0.0, "the first start", "x", 5000.0, "a"]}',
        '{"1234": [0.0, "the first start", NaN, 5000.0, "a"]}',
        '{"1234": [0.0, "the first start", 5001.0, 5000.0, "a"]}',
    ],
    ids=["empty", "list", "cut", "short", "negative", "nan", "no number", "no time", "from the future"],
)
def test_what_cannot_be_read_is_cold(file, tmp_path, content):
    (tmp_path / NAME).write_text(content)
    assert file.read(SERIAL, WARM_UP_S).cold_share == 1.0


def test_a_full_disk_costs_warmth_and_no_session(tmp_path, times):
    written(WarmthFile(tmp_path / "absent", times))


def test_the_camera_of_the_newest_session_is_known(file, times):
    assert file.newest() is None
    written(file, OTHER_SERIAL, OTHER)
    times.later(60.0)
    written(file)
    times.later(60.0)
    written(file, OTHER_SERIAL, OTHER, is_used=False)  # kept running, not used
    times.later(60.0)
    assert file.newest() == (ADDRESS, 120.0)


def described(serial=SERIAL):
    sizes = {"depth_size": (640, 480), "color_size": (640, 480)}
    return SourceDescription(kind="fake", name="fake", fps=30.0, is_live=True, serial=serial, **sizes)


class Camera:
    """Delivers a frame a second, at once."""

    def __init__(self, ends_after=None):
        self.frames, self.is_open, self.ends_after = 0, False, ends_after
        self.is_free = True

    def open(self):
        self.is_open = True
        return described()

    def read(self, _timeout_s):
        if self.frames == self.ends_after:
            raise SourceLostError("unplugged")
        self.frames += 1
        if self.frames > 5000:
            threading.Event().wait(0.01)
            raise FrameTimeoutError("no frame")
        return SimpleNamespace(received_ns=self.frames * 10**9)

    def close(self):
        self.is_open = False


def test_a_session_s_frames_warm_its_camera_and_its_end_is_written(file, tmp_path):
    warmth, camera = warm(1.0), Camera()
    source = WarmingSource(camera, warmth, file, ADDRESS)
    assert source.open().cold_share == 1.0
    for _ in range(601):
        source.read(1.0)
    source.close()
    expected = warm(1.0)
    expected.run(600.0)
    assert json.loads((tmp_path / NAME).read_text())[SERIAL][0] == pytest.approx(expected.cold_share)
    assert not camera.is_open
    again = WarmingSource(Camera(), warm(1.0), file, ADDRESS)
    assert again.open().cold_share == pytest.approx(expected.cold_share)
    again.close()


@pytest.fixture
def cameras(monkeypatch):
    """Every camera that was opened by its address."""
    opened = {}

    def open_camera(address, **_others):
        opened[address] = Camera()
        return opened[address]

    monkeypatch.setattr(drivers, "open_camera", open_camera)
    monkeypatch.setattr(drivers, "listed_address", lambda address, _pinned="": address)
    monkeypatch.setattr("service.engine_host.camera_warmth.KEEP_FROM_S", 0.0)
    return opened


def test_the_camera_runs_on_between_two_sessions_until_the_next_one_needs_it(file, tmp_path, cameras):
    written(file, share=0.5)
    keeper = CameraKeeper(Settings(data_dir=tmp_path, keep_warm_min=60.0), file, MonotonicClock())
    keeper.start()
    eventually(lambda: ADDRESS in cameras and cameras[ADDRESS].frames > 1000)
    with keeper:
        assert not cameras[ADDRESS].is_open
        before = cameras.pop(ADDRESS)
    eventually(lambda: ADDRESS in cameras and cameras[ADDRESS].frames > 10)
    keeper.end()
    assert not cameras[ADDRESS].is_open
    assert file.read(SERIAL, WARM_UP_S).cold_share < 0.3
    assert before is not cameras[ADDRESS]
    keeper.start()  # after its end nothing takes the camera again
    assert not cameras[ADDRESS].is_open


def test_what_needs_the_camera_in_another_process_gets_it_and_the_keeper_takes_it_back(
    file, tmp_path, cameras, monkeypatch
):
    monkeypatch.setattr("service.engine_host.camera_warmth.RETRY_S", 0.05)
    written(file, share=0.5)
    keeper = CameraKeeper(Settings(data_dir=tmp_path), file, MonotonicClock())
    keeper.start()
    eventually(lambda: ADDRESS in cameras and cameras[ADDRESS].frames > 100)
    program = (
        "import sys; from pathlib import Path; from service.engine_host.camera_warmth import CameraClaim\n"
        "with CameraClaim(Path(sys.argv[1])).claimed():\n    print('mine', flush=True); sys.stdin.read()"
    )
    words = [sys.executable, "-c", program, str(tmp_path)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT) as other:
        assert other.stdout.readline() == b"mine\n"
        assert not cameras[ADDRESS].is_open
        first = cameras.pop(ADDRESS)
        threading.Event().wait(0.3)
        assert ADDRESS not in cameras  # not taken back while it is claimed
        other.kill()  # however it ends
    eventually(lambda: ADDRESS in cameras and cameras[ADDRESS].frames > 100)
    assert not first.is_open
    keeper.end()


def test_qa_claims_the_camera_from_its_opening_to_its_close(tmp_path):
    claim, camera = CameraClaim(tmp_path), Camera()
    source = ClaimingSource(camera, claim)
    assert not claim.is_wanted
    source.open()
    assert (camera.is_open, claim.is_wanted) == (True, True)
    source.close()
    assert (camera.is_open, claim.is_wanted) == (False, False)
    camera.open = lambda: (_ for _ in ()).throw(SourceLostError("unplugged"))
    with pytest.raises(SourceLostError):
        source.open()
    assert not claim.is_wanted


@pytest.mark.parametrize(
    ("settings", "minutes"),
    [
        ({"keep_warm_min": 0.0}, 0.0),
        ({"keep_warm_min": 60.0}, 61.0),
        ({"warm_up_min": 0.0}, 1.0),
        ({"camera_uri": "orbbec:"}, 1.0),
    ],
    ids=["not wanted", "too long ago", "needs none", "another room's"],
)
def test_no_camera_runs_on_where_the_site_does_not_want_it(file, tmp_path, times, cameras, settings, minutes):
    written(file)
    times.later(60.0 * minutes)
    keeper = CameraKeeper(Settings(data_dir=tmp_path, **settings), file, MonotonicClock())
    keeper.start()
    threading.Event().wait(0.2)
    keeper.end()
    assert cameras == {}


def test_the_site_s_warm_up_goes_before_the_kind_s():
    assert warm_up_s(ADDRESS, Settings()) == drivers.warm_up_s(ADDRESS) == 1800.0
    assert warm_up_s("orbbec:1", Settings()) == 2700.0
    assert warm_up_s("1d27/0601@1/7", Settings()) == 900.0
    assert warm_up_s(ADDRESS, Settings(warm_up_min=7.0)) == 420.0


class Exclusive(Camera):
    """A camera that only one can have open at a time."""

    holder: "Exclusive | None" = None

    def open(self):
        assert Exclusive.holder is None, "another has it"
        Exclusive.holder, self.is_open = self, True
        return described()

    def read(self, timeout_s):
        threading.Event().wait(min(timeout_s, 0.01))
        raise FrameTimeoutError("none")

    def close(self):
        if Exclusive.holder is self:
            Exclusive.holder, self.is_open = None, False


def test_a_session_gets_the_camera_that_was_kept_running(settings, monkeypatch):
    monkeypatch.setattr(Exclusive, "holder", None)
    monkeypatch.setattr("service.engine_host.camera_warmth.KEEP_FROM_S", 0.0)
    use(monkeypatch, FakeDriver(["1d27/0601@1/2"], make=Exclusive))
    settings.data_dir.mkdir(exist_ok=True)
    WarmthFile(settings.data_dir).write(SERIAL, Warmth(900.0, 0.5), address="1d27/0601@1/2", is_used=True)
    adapter = LocalEngine(settings)
    adapter.stand_by()
    eventually(lambda: Exclusive.holder is not None)
    kept = Exclusive.holder
    engine = adapter.open(
        SessionPlan(
            session_id="0" * 32,
            source=DeviceSource(kind="device"),
            recording=None,
            calibration=make_calibration(),
            window=Window.model_validate(WINDOW),
        )
    )
    try:
        eventually(lambda: Exclusive.holder not in {None, kept})
        assert not kept.is_open
    finally:
        engine.stop()
