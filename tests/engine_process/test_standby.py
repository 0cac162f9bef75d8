"""The process that stands by: there when it is wanted, replaced when it dies, gone with the service."""

import pytest

from service.engine_process import child, standby
from service.engine_process.port import CAMERA_IN_USE, ProcessEngine
from service.errors import EngineProcessError
from service.settings import Settings
from tests.engine_process.bench import eventually, is_there, make_plan


@pytest.fixture
def port(tmp_path):
    held = ProcessEngine(Settings(data_dir=tmp_path / "data"))
    yield held
    held.close()


def test_one_stands_by_is_replaced_when_it_dies_and_goes_with_the_service(port):
    assert port.trouble == standby.NONE_YET
    eventually(lambda: port.trouble is None)
    port._standby._ready.kill()
    eventually(lambda: port.processes_lost == 1)
    eventually(lambda: port.trouble is None)
    taken = port._standby.take()
    assert port.trouble is None, "none is wanted beside a session"
    assert port._standby._ready is None
    taken.kill()
    assert taken.bury() == -9
    port._standby.want()
    eventually(lambda: port._standby._ready is not None)
    pid = port._standby._ready.process.pid
    port.close()
    assert not is_there(pid)
    with pytest.raises(EngineProcessError, match="no session can begin"):
        port.open(make_plan())


def test_one_that_cannot_be_started_is_said_and_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(standby, "AGAIN_S", 0.05)
    monkeypatch.setattr(child, "MODULE", "tests.engine_process.no_such_module")
    port = ProcessEngine(Settings(data_dir=tmp_path / "data"))
    eventually(lambda: "ended before it was ready" in (port.trouble or ""))
    monkeypatch.setattr(child, "MODULE", "service.engine_process")
    eventually(lambda: port.trouble is None)
    port.close()


def test_a_camera_is_not_asked_about_itself_while_a_session_has_one(port, monkeypatch):
    before = port.devices()
    port._has_camera = True
    monkeypatch.setattr(port, "_adapter", None)  # whoever asked it now would fail
    during = port.devices()
    assert (during.items, during.detail) == (before.items, CAMERA_IN_USE)
