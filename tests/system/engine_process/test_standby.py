"""The process that stands by: there when it is wanted, asked about cameras, replaced when it dies, gone in the end."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from engine.capture.openni import c_api
from engine.core.errors import CommandRefusedError, InvalidValueError, SourceLostError
from service.core.errors import EngineProcessError
from service.core.schemas import sessions
from service.core.settings.settings import Settings
from service.engine_host.process import messages, process_engine, process_engine as port_module
from service.engine_host.process.process_engine import LISTED_EARLIER, NEVER_LISTED, ProcessEngine
from tests.support.engine_process import two_cameras_program
from tests.support.engine_process.bench import PATIENCE_S, eventually, is_there, line_at, make_plan
from tests.support.engine_process.real_time_program import LINE
from tests.support.repository import ROOT

pytestmark = pytest.mark.waiting


@pytest.fixture
def port(tmp_path):
    held = ProcessEngine(Settings(data_dir=tmp_path / "data"))
    yield held
    held.close()


def test_one_stands_by_is_replaced_when_it_dies_and_goes_with_the_service(port):
    assert port.trouble == process_engine.NONE_YET
    eventually(lambda: port.trouble is None)
    port._standby._ready.kill()
    eventually(lambda: port.processes_lost == 1)
    eventually(lambda: port.trouble is None)
    taken = port._standby.take()
    assert port.trouble is None, "none is wanted beside a session"
    assert port._standby._ready is None
    taken.kill()
    assert taken.reap() == -9
    port._standby.want()
    eventually(lambda: port._standby._ready is not None)
    pid = port._standby._ready.process.pid
    port.close()
    assert not is_there(pid)
    with pytest.raises(EngineProcessError, match="no session can begin"):
        port.open(make_plan())


def test_one_that_cannot_be_started_is_stated_and_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(process_engine, "AGAIN_S", 0.05)
    monkeypatch.setattr(messages, "MODULE", "tests.service.engine_host.process.no_such_module")
    port = ProcessEngine(Settings(data_dir=tmp_path / "data"))
    eventually(lambda: "ended before it was ready" in (port.trouble or ""))
    monkeypatch.setattr(messages, "MODULE", "service.engine_host.process")
    eventually(lambda: port.trouble is None)
    port.close()


@pytest.fixture
def line(tmp_path):
    with line_at(tmp_path / "line") as held:
        yield held


@pytest.fixture
def asked(tmp_path, line, monkeypatch):
    """A port whose processes see cameras; this one must not even look."""
    monkeypatch.setattr(messages, "MODULE", "tests.support.engine_process.two_cameras_program")
    monkeypatch.setenv(LINE, str(line.path))
    monkeypatch.setattr(c_api, "runtime", lambda: pytest.fail("the service's process asks the runtime"))
    held = ProcessEngine(Settings(data_dir=tmp_path / "data"))
    yield held
    held.close()


def answering(listed):
    """The process that listed them: the cameras are called by its number."""
    return {one.name for one in listed.items}


def test_who_would_open_a_camera_is_asked_about_it_and_stands_by_again(asked):
    listed = asked.devices()
    assert [one.uri for one in listed.items] == list(two_cameras_program.ALL)
    pid = asked._standby._ready.process.pid
    assert answering(listed) == {f"Virtual {pid}"}
    assert asked.built_in_calibration(two_cameras_program.REGISTERED).is_device_registration
    assert answering(asked.devices()) == {f"Virtual {pid}"}
    assert (asked.trouble, asked.processes_lost) == (None, 0)


@pytest.mark.parametrize(
    ("uri", "error", "words"),
    [
        (two_cameras_program.PLAIN, InvalidValueError, "calibration_id"),
        ("virtual/away", SourceLostError, "no such camera"),
    ],
)
def test_what_a_camera_is_refused_for_crosses_and_the_process_stands_by_again(asked, uri, error, words):
    with pytest.raises(error, match=words):
        asked.built_in_calibration(uri)
    assert (asked.trouble, asked.processes_lost) == (None, 0)


@pytest.mark.parametrize(
    ("uri", "cause"),
    [(two_cameras_program.DYING, f"status {two_cameras_program.DEATH}"), (two_cameras_program.HUNG, "signal 9")],
    ids=["dies", "hangs"],
)
def test_one_that_does_not_answer_about_a_camera_is_ended_and_another_stands_by(asked, monkeypatch, uri, cause):
    eventually(lambda: asked.trouble is None)
    monkeypatch.setattr(port_module, "ASK_S", 0.5)
    with pytest.raises(EngineProcessError, match=cause):
        asked.built_in_calibration(uri)
    monkeypatch.setattr(port_module, "ASK_S", PATIENCE_S)
    assert asked.processes_lost == 1
    assert [one.uri for one in asked.devices().items] == list(two_cameras_program.ALL)


def test_a_session_s_camera_is_listed_before_it_begins_and_not_asked_about_while_it_runs(asked):
    source = sessions.DeviceSource(kind="device", uri=two_cameras_program.PLAIN)
    engine = asked.open(make_plan(source=source, recording=None))
    during = asked.devices()
    assert (answering(during), during.detail) == ({f"Virtual {engine.process_id}"}, LISTED_EARLIER)
    with pytest.raises(CommandRefusedError, match="a session is running"):
        asked.built_in_calibration(two_cameras_program.REGISTERED)
    assert asked._standby._ready is None, "none is started beside a session, whatever is asked"
    engine.stop()
    assert asked.built_in_calibration(two_cameras_program.REGISTERED).is_device_registration
    assert answering(asked.devices()) != answering(during)


def test_beside_a_session_without_a_camera_none_is_searched_for(asked):
    engine = asked.open(make_plan())
    during = asked.devices()
    assert (during.items, during.detail) == ([], NEVER_LISTED)
    engine.stop()
    assert [one.uri for one in asked.devices().items] == list(two_cameras_program.ALL)


def test_listing_cameras_does_not_wait_behind_a_query_that_hangs(asked, monkeypatch):
    before = asked.devices()
    monkeypatch.setattr(port_module, "LIST_TURN_S", 0.0)
    monkeypatch.setattr(port_module, "OPEN_TURN_S", 0.0)
    with asked._turn(PATIENCE_S):
        assert asked.devices() == before.model_copy(update={"detail": LISTED_EARLIER})
        with pytest.raises(EngineProcessError, match="try again in a moment"):
            asked.built_in_calibration(two_cameras_program.REGISTERED)
        with pytest.raises(EngineProcessError, match="try again in a moment"):
            asked.open(make_plan())


@pytest.fixture
def no_list(monkeypatch):
    monkeypatch.setenv(two_cameras_program.LIST_FAILS, "1")


def test_a_session_begins_though_no_camera_could_be_listed(no_list, asked):
    engine = asked.open(
        make_plan(source=sessions.DeviceSource(kind="device", uri=two_cameras_program.PLAIN), recording=None)
    )
    assert asked.devices().detail == NEVER_LISTED
    engine.stop()


def test_none_is_started_beside_a_session_because_the_one_before_it_ends_late(asked):
    engine = asked.open(make_plan())
    asked._process_ended(0, is_lost=False)
    assert not asked._standby._is_wanted
    engine.stop()
    eventually(lambda: asked.trouble is None)


def hung_in_a_question(asked):
    """Ask what is not answered, in a thread; returns that and the process that was asked."""
    eventually(lambda: asked.trouble is None)
    pid = asked._standby._ready.process.pid
    pool = ThreadPoolExecutor(1)
    answer = pool.submit(asked.built_in_calibration, two_cameras_program.HUNG)
    pool.shutdown(wait=False)
    eventually(lambda: asked._standby._ready is None)
    return answer, pid


def test_one_that_hangs_in_a_question_ends_with_the_service(asked, monkeypatch):
    monkeypatch.setattr(port_module, "ASK_S", 10 * PATIENCE_S)
    answer, pid = hung_in_a_question(asked)
    asked.close()
    with pytest.raises(EngineProcessError, match="signal 9"):
        answer.result(PATIENCE_S)
    assert not is_there(pid)


ASKING = """
import sys, tests.system.engine_process.test_standby as these
from service.engine_host.process import messages as child
child.MODULE = "tests.support.engine_process.two_cameras_program"
print(these.hung_in_a_question(these.ProcessEngine(these.Settings(data_dir=sys.argv[1])))[1], flush=True)
"""


def test_one_that_hangs_in_a_question_ends_with_a_service_that_is_killed(tmp_path, line, monkeypatch):
    monkeypatch.setenv(LINE, str(line.path))
    command = [sys.executable, "-c", ASKING, str(tmp_path / "data")]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as service:
        pid = int(service.stdout.readline())
        assert is_there(pid)
        service.kill()
    eventually(lambda: not is_there(pid))


def test_one_stands_by_where_two_are_offered(port):
    eventually(lambda: port.trouble is None)
    first, second = port._standby.take(), messages.start_child()
    port._standby.give_back(first)
    port._standby.give_back(second)
    assert port._standby._ready is first
    assert not second.is_alive
