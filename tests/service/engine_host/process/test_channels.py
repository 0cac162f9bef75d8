"""What crosses between the two processes arrives as what it was."""

import dataclasses
import os
import pickle
import socket
import threading

import numpy as np
import pytest

import service.web.app  # noqa: F401 - for the errors of all it is made of
from engine.core.commands import ActivateModel, Arm
from engine.core.errors import InvalidValueError, ModelMismatchError, TidegateError, TrainingRefusedError
from engine.core.learning_status import PatientMatch
from service.engine_host.process.channels import (
    LARGE_BYTES,
    PICTURE_BYTES,
    PICTURES,
    BulkChannel,
    ChannelClosedError,
    ControlChannel,
    SharedPage,
    pack,
)
from service.engine_host.process.messages import CommandMessage, EngineFailedError, portable
from tests.support.engine_process.bench import make_plan

pytestmark = pytest.mark.waiting

OTHER_ARGUMENTS = {
    InvalidValueError: ("window.lower_mm", 3.0, "less than 2"),
    ModelMismatchError: ("model.patient", "P-1", "P-2", "learn a new one"),
    TrainingRefusedError: ("training.amplitude", 0.2, "at least 0.6", "breathe"),
}


def _all_errors():
    """Every error that the engine's process knows, and more: what was imported here is all of the service."""
    waiting, found = [TidegateError], []
    while waiting:
        kind = waiting.pop()
        found.append(kind)
        waiting += kind.__subclasses__()
    return [kind for kind in dict.fromkeys(found) if not kind.__module__.startswith("tests")]


def _made(kind):
    """An error of this class, however its constructor is called."""
    known = next((OTHER_ARGUMENTS[one] for one in kind.__mro__ if one in OTHER_ARGUMENTS), None)
    for arguments in (known, ("what was wrong",), (), (3,), ("a", "b"), ("a", "b", "c")):
        if arguments is None:
            continue
        try:
            return kind(*arguments)
        except (TypeError, AttributeError):
            continue
    return _bare(kind)


def _bare(kind):
    error = kind.__new__(kind)
    error.args = ("what was wrong",)
    error.field = "a field"
    return error


@pytest.fixture
def channels():
    here, there = socket.socketpair()
    ends = BulkChannel(here), BulkChannel(there)
    yield ends
    for end in ends:
        end.close()


def _crossed(message, channels):
    here, there = channels
    sending = threading.Thread(target=here.send, args=(message,), daemon=True)
    sending.start()
    found = there.receive()
    sending.join()
    return found


@pytest.fixture(scope="module")
def errors():
    return _all_errors()


def test_every_error_of_ours_arrives_as_its_class_with_its_fields(channels, errors):
    assert len(errors) > 40
    for kind in errors:
        error = _made(kind)
        found = _crossed(error, channels)
        assert type(found) is kind
        assert (str(found), found.args, found.__dict__, found.code) == (
            str(error),
            error.args,
            error.__dict__,
            kind.code,
        )


def test_an_unexpected_error_arrives_by_its_kind_alone():
    found = portable(KeyError("P-0001"))
    assert type(found) is EngineFailedError
    assert str(found) == "KeyError", "its message may be about a patient"
    ours = InvalidValueError("a", 1, "2")
    assert portable(ours) is ours


def test_an_error_inside_of_a_value_crosses_too(channels):
    refusal = ModelMismatchError("model.shift", "9 mm", "at most 6 mm", "learn a new one")
    likeness = PatientMatch(
        frames=3,
        explained_share=1.0,
        residual_mm=None,
        shift_mm=(9.0, 0.0, 0.0),
        tilt_deg=0.0,
        shape_mm=0.0,
        refusal=refusal,
    )
    found = _crossed(likeness, channels)
    assert str(found.refusal) == str(refusal)
    assert dataclasses.replace(found, refusal=None) == dataclasses.replace(likeness, refusal=None)


@pytest.mark.parametrize("size", [0, 7, LARGE_BYTES // 8 - 1, LARGE_BYTES // 8, 200_000])
@pytest.mark.parametrize("is_whole", [True, False])
def test_arrays_of_any_size_arrive_whole_and_read_only(channels, size, is_whole):
    array = np.arange(2.0 * size)[:: 1 if is_whole else 2].reshape(2, -1) if size % 2 == 0 else np.arange(float(size))
    found = _crossed({"array": array, "empty": np.empty((0, 3)), "flags": np.array([True, False])}, channels)
    assert np.array_equal(found["array"], array)
    assert (found["array"].dtype, found["array"].shape) == (array.dtype, array.shape)
    assert not found["array"].flags.writeable
    assert found["empty"].shape == (0, 3)
    assert found["flags"].tolist() == [True, False]


def test_a_large_array_is_not_copied_into_its_message():
    array = np.zeros((3, 350, 200), np.float32)
    body, beside = pack({"model": array})
    assert len(body) < 1_000
    assert [one.nbytes for one in beside] == [array.nbytes]
    assert np.shares_memory(np.frombuffer(beside[0], np.float32), array)


def test_a_plan_arrives_as_it_was(channels):
    plan = make_plan()
    found = _crossed(plan, channels)
    assert found.calibration.sha256 == plan.calibration.sha256
    assert (found.window, found.regions, found.source) == (plan.window, plan.regions, plan.source)


def test_a_control_message_that_does_not_fit_is_dropped_without_waiting():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    control, other = ControlChannel(here), ControlChannel(there)
    order = CommandMessage(number=1, slot=0, command=Arm(operator="ann"), submitted_ns=0)
    sent = 0
    while control.send(order):
        sent += 1
    assert sent > 50
    for _ in range(sent):
        assert other.receive().command == order.command
    assert control.send(order)
    control.close()
    assert other.receive().number == 1
    with pytest.raises(ChannelClosedError):
        other.receive()
    assert not other.send(order)
    other.close()


def test_a_disconnect_is_noticed_at_once(channels):
    here, there = channels
    here.close()
    with pytest.raises(ChannelClosedError):
        there.receive()
    with pytest.raises(ChannelClosedError):
        there.send(ActivateModel(operator="ann", model=None))


@pytest.fixture
def pages():
    """The engine's page and the service's, of one memory."""
    file = SharedPage.make()
    made = SharedPage(file), OvertakenPage(file)
    os.close(file)
    yield made
    for page in made:
        page.close()


class OvertakenPage(SharedPage):
    """Stands still after it looked for the newest picture, until newer ones were written over that one."""

    def __init__(self, file: int) -> None:
        super().__init__(file)
        self.overtake = []

    def _newest_number(self) -> int:
        number = super()._newest_number()
        if self.overtake:
            self.overtake.pop()()
        return number


def picture_of(frame_index: int) -> np.ndarray:
    return np.full((48, 64, 3), frame_index % 256, np.uint8)


def test_the_newest_picture_is_read_with_the_index_of_its_frame(pages):
    writing, reading = pages
    assert reading.read_picture() is None
    for frame_index in (7, 8, 11, 12, 13):
        assert writing.write_picture(frame_index, picture_of(frame_index))
        found, picture = reading.read_picture()
        assert (found, picture.flags.writeable) == (frame_index, False)
        assert np.array_equal(picture, picture_of(frame_index))
    assert not writing.write_picture(14, np.zeros((PICTURE_BYTES + 1, 1, 1), np.uint8))
    assert reading.read_picture()[0] == 13


def test_a_reader_that_is_overtaken_reads_the_newest_then_however_often(pages):
    writing, reading = pages
    frames = iter(range(1_000))

    def write_over_it() -> None:
        for _ in range(PICTURES):
            index = next(frames)
            assert writing.write_picture(index, picture_of(index))

    write_over_it()
    reading.overtake = [write_over_it] * 50
    found, picture = reading.read_picture()
    assert found == 51 * PICTURES - 1
    assert np.array_equal(picture, picture_of(found)), "none is shown half"


def test_a_reader_that_is_overtaken_for_ever_gives_up(pages, monkeypatch):
    monkeypatch.setattr("service.engine_host.process.channels.READ_S", 0.0)
    writing, reading = pages
    reading.overtake = [lambda: [writing.write_picture(index, picture_of(index)) for index in range(PICTURES)]] * 5
    writing.write_picture(0, picture_of(0))
    assert reading.read_picture() is None


def test_a_cancelled_command_is_seen_on_the_other_side(pages):
    writing, reading = pages
    assert not reading.is_cancelled(3)
    writing.mark_cancelled(3)
    assert reading.is_cancelled(3)
    writing.clear(3)
    assert not reading.is_cancelled(3)


def test_nothing_that_leaves_a_process_is_read_by_a_plain_pickle_of_errors():
    """Why errors need a way of their own: the plain one calls their constructor with a message."""
    with pytest.raises(TypeError):
        pickle.loads(pickle.dumps(InvalidValueError("a", 1, "2")))
