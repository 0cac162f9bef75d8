"""An SDK is asked again when a device came or went, or after a time: each asking is a process."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from engine.capture.camera_process import source
from engine.capture.camera_process.source import listed

FOUND = {"uri": "sdk:1", "vendor": "maker", "name": "camera"}


@pytest.fixture
def bus(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(source, "USB", tmp_path)
    monkeypatch.setattr(source, "_LISTED", {})
    plug(tmp_path, "1-1", "4")
    return tmp_path


@pytest.fixture
def asked(monkeypatch) -> list[str]:
    modules: list[str] = []
    monkeypatch.setattr(
        source, "_asked", lambda module, _label, _word: modules.append(module) or {"answer": [FOUND] * len(modules)}
    )
    return modules


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    at_s = [100.0]
    monkeypatch.setattr(source, "time", SimpleNamespace(monotonic=lambda: at_s[0]))
    return at_s


def plug(bus: Path, port: str, number: str) -> None:
    (bus / port).mkdir(exist_ok=True)
    (bus / port / "devnum").write_text(number)


def test_until_a_device_comes_or_goes_an_answer_is_kept_a_minute(bus, asked, clock):
    assert len(listed("sdk", "SDK")) == 1
    clock[0] += 5.0
    assert len(listed("sdk", "SDK")) == 2, "the bus had not settled"
    clock[0] += 59.0
    assert len(listed("sdk", "SDK")) == 2
    clock[0] += 1.1
    assert len(listed("sdk", "SDK")) == 3


@pytest.mark.parametrize("number", ["5", None])
def test_a_device_that_comes_goes_or_is_plugged_again_is_looked_for_at_once_and_until_it_has_settled(
    bus, asked, clock, number
):
    listed("sdk", "SDK")
    clock[0] += 6.0
    listed("sdk", "SDK")
    plug(bus, "1-1" if number else "1-2", number or "7")
    for _ in range(4):
        before = len(asked)
        listed("sdk", "SDK")
        assert len(asked) == before + 1
        clock[0] += 2.0
    before = len(asked)
    listed("sdk", "SDK")
    assert len(asked) == before


def test_where_the_bus_cannot_be_read_an_answer_is_kept_ten_seconds(bus, asked, clock, monkeypatch):
    monkeypatch.setattr(source, "USB", bus / "none")
    for step_s, count in ((0.0, 1), (5.0, 2), (9.0, 2), (1.1, 3)):
        clock[0] += step_s
        assert len(listed("sdk", "SDK")) == count


def test_each_sdk_has_its_own_answer(bus, asked, clock):
    listed("one", "SDK")
    clock[0] += 6.0
    listed("one", "SDK")
    listed("other", "SDK")
    assert asked == ["one", "one", "other"]
