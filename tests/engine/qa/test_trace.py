"""What a phantom was reported: read strictly, and where it is between samples."""

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, RecordingError
from engine.qa.trace import CommandedTrace, read_commanded
from tests.support.repository import DATA

ROBOT = DATA / "qa" / "LiverTraj_LargeSIandAP70s_robot.txt"
TIMES = np.arange(0.0, 20.0, 0.1)


def csv_of(time_s=TIMES, position_mm=None):
    position_mm = 5.0 * np.sin(time_s) if position_mm is None else position_mm
    rows = (f"{t:.3f},{p:.6f}" for t, p in zip(time_s, position_mm, strict=True))
    return "time_s,position_mm\n" + "\n".join(rows) + "\n"


def read(tmp_path, text):
    path = tmp_path / "trace.csv"
    path.write_text(text)
    return read_commanded(path)


def test_a_trace_is_interpolated_between_its_samples(tmp_path):
    trace = read(tmp_path, csv_of())
    at = np.array([1.234, 9.876])
    assert trace.at(at) == pytest.approx(5.0 * np.sin(at), abs=1e-3)
    assert trace.span_s == (0.0, 19.9)
    assert trace.reach_mm == pytest.approx((-5.0, 5.0), abs=0.02)


def test_nothing_is_known_before_its_beginning_and_after_its_end(tmp_path):
    assert np.isnan(read(tmp_path, csv_of()).at(np.array([-0.01, 19.91]))).all()


def test_a_robot_s_file_is_read_along_its_anterior_axis():
    trace = read_commanded(ROBOT)
    rows = np.loadtxt(ROBOT)
    assert trace.at(rows[:, 0]) - trace.at(rows[:1, 0]) == pytest.approx(rows[:, 3] - rows[0, 3], abs=1e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time_s,position_mm,more\n0,1,2\n", "line 1"),
        (csv_of().replace("0.500,", "0.500,1,"), "line 7: has 3 fields"),
        (csv_of().replace("0.500,", "half,"), "line 7: time_s is 'half'"),
        (csv_of().replace("0.500,", "nan,"), "line 7: time_s is 'nan'"),
        ("", "trace.csv"),
        ("not a trace\n", "trace.csv"),
    ],
)
def test_a_damaged_file_is_refused_by_line_and_field(tmp_path, text, says):
    with pytest.raises(RecordingError, match=says):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("time_s", "position_mm"),
    [
        (TIMES[:5], np.sin(TIMES[:5])),
        (TIMES, np.zeros_like(TIMES)),
        (TIMES, 60.0 * TIMES),
        (TIMES[::-1].copy(), np.sin(TIMES)),
        (np.where(TIMES > 10.0, TIMES + 2.0, TIMES), np.sin(TIMES)),
        (np.append(TIMES[:-1], np.nan), np.sin(TIMES)),
        (TIMES, np.append(np.sin(TIMES[:-1]), np.inf)),
    ],
    ids=["few", "still", "far", "backwards", "gap", "no time", "no place"],
)
def test_a_trace_that_no_phantom_executed_is_refused(time_s, position_mm):
    with pytest.raises(InvalidValueError, match="trace"):
        CommandedTrace(time_s=time_s.copy(), position_mm=position_mm)


def test_a_folder_and_a_binary_are_refused_in_a_sentence(tmp_path):
    with pytest.raises(RecordingError):
        read_commanded(tmp_path)
    (tmp_path / "trace.bin").write_bytes(b"\xff\xfe\x00time_s")
    with pytest.raises(RecordingError, match="not UTF-8"):
        read_commanded(tmp_path / "trace.bin")


def test_another_kind_of_recording_is_refused_by_kind():
    with pytest.raises(RecordingError, match="is a recording of kind rpm"):
        read_commanded(next((ROBOT.parents[1] / "rpm").glob("*.vxp")))
