"""Cameras by their drivers: whose an address is, what may be opened, and what is said where nothing is there."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest

import engine
from engine.capture import drivers
from engine.capture.openni.driver import OpenNiDriver
from engine.capture.source import RegisteredView
from engine.core.clock import ManualClock
from engine.core.errors import RuntimeMissingError, SourceLostError
from engine.core.plug_ins import PlugInError
from tests.support.capture.fake_driver import FakeDriver, use

CODE = Path(engine.__file__).parents[1]
OUTSIDE = re.compile(r"engine\.capture\.openni|OpenNiSource|OpenNiDevice")


@pytest.fixture
def two(monkeypatch):
    """Two SDKs: one whose addresses have a prefix, and the one for all others."""
    named = FakeDriver(["other:7", "other:8"], prefix="other:", make=object)
    plain = FakeDriver(["1d27/0609@1/4", "1d27/0609@2/7"], make=object)
    use(monkeypatch, named, plain)
    return named, plain


@pytest.mark.parametrize(("uri", "owner"), [("other:7", 0), ("1d27/0609@1/4", 1), (None, 1)])
def test_an_address_is_opened_by_its_driver(two, uri, owner):
    drivers.open_camera(uri, clock=ManualClock(), use_registration=True)
    assert [len(driver.opened) for driver in two] == [1 - owner, owner]
    assert two[owner].opened == [{"uri": uri, "use_registration": True, "record_to": None}]


def test_cameras_of_all_drivers_are_listed_in_their_order(two):
    assert [one.uri for one in drivers.list_cameras()] == ["other:7", "other:8", "1d27/0609@1/4", "1d27/0609@2/7"]


def test_an_sdk_that_is_missing_hides_no_other(monkeypatch):
    use(monkeypatch, FakeDriver(["other:7"], prefix="other:", is_here=False), FakeDriver(["1d27/0609@1/4"]))
    assert [one.uri for one in drivers.list_cameras()] == ["1d27/0609@1/4"]
    assert drivers.is_any_available()
    assert drivers.is_any_installed()


def test_without_any_sdk_what_is_missing_is_stated(monkeypatch):
    use(monkeypatch, FakeDriver(is_here=False))
    assert not drivers.is_any_available()
    assert not drivers.is_any_installed()
    with pytest.raises(RuntimeMissingError, match="the fake SDK is missing: nothing helps"):
        drivers.list_cameras()
    with pytest.raises(RuntimeMissingError):
        drivers.recording_source(__file__, clock=ManualClock(), record_to=Path("x.oni"))
    assert drivers.real_time_player(Path("x.oni"), clock=ManualClock()) is None


class FakePlugIn(NamedTuple):
    name: str
    driver: object
    label: str = "acme 1.0"

    def load(self):
        return self.driver


def test_two_cameras_of_one_distribution_are_added_once_each(two, monkeypatch):
    monkeypatch.setattr(drivers, "PLUG_INS", {})
    added = [FakePlugIn(name, FakeDriver([f"{name}:1"], prefix=f"{name}:")) for name in ("near", "far")]
    drivers.add_cameras(added)
    drivers.add_cameras(added)
    assert [one.prefix for one in drivers.CAMERAS] == ["far:", "near:", "other:", ""]
    assert [kind.plug_in for kind in drivers.kinds()] == ["acme 1.0", "acme 1.0", "", ""]


@pytest.mark.parametrize(
    ("driver", "said"),
    [
        (object(), "lacks prefix, label"),
        (FakeDriver(prefix="other:"), "has the prefix 'other:': must be letters and a colon, of no other driver"),
        (FakeDriver(prefix=""), "has the prefix ''"),
    ],
)
def test_a_plug_in_that_is_no_camera_is_refused_by_name(two, monkeypatch, driver, said):
    monkeypatch.setattr(drivers, "PLUG_INS", {})
    with pytest.raises(PlugInError, match=rf"the camera plug-in acme \(acme 1.0\) {said}"):
        drivers.add_cameras([FakePlugIn("acme", driver)])


def test_a_room_opens_its_own_camera_and_no_other(two):
    assert drivers.listed_address(None) == "other:7"
    assert drivers.listed_address(None, "1d27/0609@2") == "1d27/0609@2/7"
    assert drivers.listed_address("1d27/0609@2/7", "1d27/0609@2") == "1d27/0609@2/7"
    with pytest.raises(SourceLostError, match="no such camera"):
        drivers.listed_address("1d27/0609@1/4", "1d27/0609@2")
    with pytest.raises(SourceLostError, match="no such camera"):
        drivers.listed_address("/a/file.oni")
    with pytest.raises(SourceLostError, match="the beginning of 2 cameras"):
        drivers.listed_address(None, "1d27/0609")


def test_a_camera_that_comes_back_at_another_address_is_looked_for_among_the_room_s_own(two):
    lost = "1d27/0609@2/6"
    assert {drivers.address_in_turn(turn, lost, "1d27/0609@2") for turn in range(4)} == {"1d27/0609@2/7"}
    assert {drivers.address_in_turn(turn, lost) for turn in range(8)} == set(two[1].cameras)
    two[1].cameras.pop()
    with pytest.raises(SourceLostError, match="sees no camera"):
        drivers.address_in_turn(0, lost, "1d27/0609@2")


def test_a_camera_that_is_known_by_its_serial_number_is_looked_for_there_and_no_other_sdk_is_asked(two, monkeypatch):
    monkeypatch.setattr(two[1], "list_cameras", lambda: pytest.fail("the other SDK was asked"))
    assert {drivers.address_in_turn(turn, "other:8") for turn in range(4)} == {"other:8"}
    two[0].cameras.remove("other:8")
    with pytest.raises(SourceLostError, match="sees no camera"):
        drivers.address_in_turn(0, "other:8")


def test_a_registered_view_is_asked_of_the_camera_s_driver(monkeypatch):
    view = RegisteredView(name="x", size_px=(640, 480), field_of_view_rad=(1.0, 0.75))
    use(monkeypatch, FakeDriver(prefix="other:", view=lambda _uri: view), FakeDriver())
    assert drivers.registered_view("other:7") == view
    assert drivers.registered_view("1d27/0609@1/4") is None


def test_a_recording_s_source_is_a_camera_unless_it_is_a_file(two, tmp_path):
    drivers.recording_source("other:8", clock=ManualClock(), record_to=tmp_path / "x.oni")
    assert two[0].opened == [{"uri": "other:8", "use_registration": False, "record_to": tmp_path / "x.oni"}]


def test_the_driver_without_a_prefix_is_the_last():
    assert [driver.prefix for driver in drivers.CAMERAS].index("") == len(drivers.CAMERAS) - 1
    assert isinstance(drivers.CAMERAS[-1], OpenNiDriver)


def test_no_module_outside_of_its_folder_names_the_sdk():
    allowed = {CODE / "engine/capture/drivers.py"}
    named = [
        path
        for root in ("engine", "service")
        for path in (CODE / root).rglob("*.py")
        if "openni" not in path.parts and path not in allowed and OUTSIDE.search(path.read_text(encoding="utf-8"))
    ]
    assert named == []


def test_each_kind_warms_up_for_its_own_time():
    assert drivers.warm_up_s("realsense:0123") == 1800.0
    assert drivers.warm_up_s("orbbec:CL8F") == 2700.0
    assert [drivers.most_noise_mm(one) for one in ("realsense:0123", "orbbec:CL8F", None)] == [30.0, 8.0, 12.0]
    assert drivers.warm_up_s("1d27/0601@1/7") == drivers.warm_up_s(None) == 900.0


def test_every_kind_is_listed_with_what_installs_it():
    found = {one.label: one.install_hint for one in drivers.kinds()}
    assert found == {
        "the RealSense SDK": "pip install 'tidegate[realsense]'",
        "the Orbbec SDK": "pip install --no-deps pyorbbecsdk2",
        "the OpenNI2 runtime": "apt-get install libopenni2-0",
    }
