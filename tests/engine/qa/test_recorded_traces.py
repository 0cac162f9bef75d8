import re

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, RecordingError
from engine.qa.recorded_traces import read_trace
from tests.support.repository import DATA

MARKERS = DATA / "markers"
RPM = DATA / "rpm" / "PT01_PT09-2_13112021.vxp"
QA = DATA / "qa"

MARKER_HEAD = '"Frame";"Timestamp";"x";"y";"z"'
MARKER_ROWS = [f"{6 * i};{100 * i};-490,{i % 10};4,1;{60 + i % 7},5" for i in range(30)]
RPM_HEAD = [
    "[Header]",
    "CRC=1",
    "Version=1.6",
    "Data_layout=amplitude,phase,timestamp,validflag,ttlin,mark,ttlout",
    "Scale_factor=10.0",
    "[Data]",
]
RPM_ROWS = [f"{0.26 + 0.01 * (i % 9):.4f},3.1,{185_000 + 40 * i},0,1,,0" for i in range(40)]
LATE_ROWS = [f"{6 * i};{100 * i + 2000};-490,1;4,1;{60 + i % 7},5" for i in range(15, 19)] + MARKER_ROWS[19:]
QA_ROWS = [f"{0.2 * i:g} 0.5 4.4 {0.1 * (i % 11):.2f} 0 0 0" for i in range(30)]


def written(tmp_path, lines, name="trace.txt"):
    path = tmp_path / name
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def refusal(path):
    with pytest.raises(RecordingError) as caught:
        read_trace(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "seconds", "samples"),
    [
        ("201205101522-LAC-1-N-138-6.csv", 138.317, 1384),
        ("201205101522-UCC-1-N-138-6.csv", 138.317, 1384),
        ("201205101541-LAC-1-N-130-6.csv", 130.717, 1308),
    ],
)
def test_marker_files_are_read_to_their_last_sample_and_no_summary(name, seconds, samples):
    trace = read_trace(MARKERS / name)
    assert (trace.kind, trace.axis) == ("markers", "z")
    assert trace.seconds == pytest.approx(seconds, abs=1e-6)
    assert len(trace.time_s) == pytest.approx(samples, abs=2)
    assert np.all(np.diff(trace.time_s) > 0)
    assert 2.0 < np.ptp(trace.motion_mm) < 30.0


def test_a_marker_that_rises_is_an_inhale():
    trace = read_trace(MARKERS / "201205101522-LAC-1-N-138-6.csv")
    # The file's first samples: z goes from 64.3 up to 78.8 mm within two seconds.
    assert trace.motion_mm[20] - trace.motion_mm[0] == pytest.approx(14.5)


def test_an_rpm_value_falls_on_inhale_and_is_scaled_and_starts_at_zero():
    trace = read_trace(RPM)
    assert (trace.kind, trace.axis) == ("rpm", "amplitude")
    assert trace.time_s[0] == 0.0
    assert trace.seconds == pytest.approx(152.857, abs=1e-6)
    assert trace.motion_mm[10] - trace.motion_mm[0] == pytest.approx(-10 * (0.2899 - 0.2617))
    # Five samples are lost; those that are not periodic stay.
    lines = RPM.read_text().splitlines()
    assert len(trace.time_s) == len(lines) - lines.index("[Data]") - 1 - 5


@pytest.mark.parametrize("name", ["LiverTraj_BreathHold1_robot.txt", "LiverTraj_LargeSIandAP70s_robot.txt"])
def test_qa_motion_is_its_anterior_posterior_column(name):
    trace = read_trace(QA / name)
    column = np.loadtxt(QA / name)[:, 3]
    assert (trace.kind, trace.axis, trace.seconds) == ("qa", "z", pytest.approx(202.2))
    assert np.ptp(trace.motion_mm - column) < 1e-9
    assert np.ptp(read_trace(QA / name, axis="y").motion_mm) == pytest.approx(np.ptp(np.loadtxt(QA / name)[:, 2]))


def test_motion_between_samples_never_overshoots():
    trace = read_trace(QA / "LiverTraj_LargeSIandAP70s_robot.txt")
    fine = trace.at(np.arange(-3.0, 210.0, 0.013))
    assert fine.min() >= trace.motion_mm.min()
    assert fine.max() <= trace.motion_mm.max()
    assert trace.at(trace.time_s) == pytest.approx(trace.motion_mm)


def test_a_turned_marker_session_is_reported_by_the_axis_that_moves(tmp_path):
    rows = [f"{6 * i};{100 * i};-490,1;{10 + i % 7},5;60,{i % 2}" for i in range(30)]
    path = written(tmp_path, [MARKER_HEAD, *rows])
    assert read_trace(path).axis == "y"
    assert read_trace(path, axis="z").axis == "z"
    with pytest.raises(InvalidValueError, match="axis is 'w': must be x, y, z or auto"):
        read_trace(path, axis="w")


@pytest.mark.parametrize("summaries", [["0;0;0;0;0"], ["13311;221850;1;2;3", "0;0;0;0;0"], ["0;0;0;0;0", "1;1;1;1;1"]])
def test_one_or_two_summary_lines_at_the_end_are_no_samples(tmp_path, summaries):
    whole = read_trace(written(tmp_path, [MARKER_HEAD, *MARKER_ROWS]))
    kept = 30 if summaries[0].startswith("0") else 31
    if kept == 31:
        summaries = ["180;3000;-490,1;4,1;61,5", summaries[-1]]
    trace = read_trace(written(tmp_path, [MARKER_HEAD, *MARKER_ROWS, *summaries]))
    assert len(trace.time_s) == kept
    assert trace.motion_mm[:5] - trace.motion_mm[0] == pytest.approx(whole.motion_mm[:5] - whole.motion_mm[0])


def test_interpolated_samples_get_the_time_of_their_frame(tmp_path):
    trace = read_trace(MARKERS / "201205101541-LAC-1-N-130-6.csv")
    assert trace.restored == 3
    # The line says 166,8 between 83300 and 83500: the sum of its neighbours in seconds.
    at = int(np.searchsorted(trace.time_s, 83.35))
    assert trace.time_s[at - 1 : at + 2] == pytest.approx([83.3, 83.4, 83.5], abs=0.02)
    path = written(tmp_path, [MARKER_HEAD, *changed(MARKER_ROWS, 9, ";900;", ";1,7;")])
    assert read_trace(path).time_s == pytest.approx(0.1 * np.arange(30))


def changed(rows, index, old, new):
    copy = list(rows)
    assert old in copy[index]
    copy[index] = copy[index].replace(old, new, 1)
    return copy


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([MARKER_HEAD, *changed(MARKER_ROWS, 4, "4,1", "4.1")], "line 6: y is '4.1': must be a number with a decimal"),
        ([MARKER_HEAD, *changed(MARKER_ROWS, 4, ";4,1", ";")], "line 6: y is '': must be a number"),
        ([MARKER_HEAD, *changed(MARKER_ROWS, 4, ";4,1", "")], "line 6: has 4 fields: must have 5"),
        ([MARKER_HEAD, *changed(MARKER_ROWS, 9, "54;", "47;")], "line 11: Frame is '47': must be later than 48"),
        ([MARKER_HEAD, *MARKER_ROWS[:15], *LATE_ROWS], "line 17: Timestamp is '3500': must be near 1500 ms"),
        ([MARKER_HEAD, *MARKER_ROWS[:12], "", *MARKER_ROWS[12:]], "line 14: has 1 fields: must have 5"),
        ([MARKER_HEAD, *MARKER_ROWS[:6]], "has 6 samples: must have at least 10"),
        ([MARKER_HEAD], "has 0 samples: must have at least 10"),
        ([*RPM_HEAD, *changed(RPM_ROWS, 3, "0.29", "nan")], "line 10: amplitude is 'nan.*': must be a number"),
        ([*RPM_HEAD, *changed(RPM_ROWS, 3, ",3.1,", ",")], "line 10: has 6 fields: must have 7"),
        ([*RPM_HEAD, *RPM_ROWS[:20], *RPM_ROWS[:20]], "line 27: timestamp is '185000': must be later than 185760"),
        ([*RPM_HEAD[:3], *RPM_HEAD[4:], *RPM_ROWS], "has no data_layout"),
        ([*RPM_HEAD[:4], *RPM_HEAD[5:], *RPM_ROWS], "has no scale_factor"),
        ([*RPM_HEAD[:5], *RPM_ROWS], "line 6: is .*: must be key=value or"),
        (RPM_HEAD[:5], "has no .Data."),
        (changed(RPM_HEAD, 4, "10.0", "-1") + RPM_ROWS, "line 5: Scale_factor is '-1': must be over 0"),
        (changed(RPM_HEAD, 3, "amplitude", "phase") + RPM_ROWS, "line 4: Data_layout is .*: must be a list with one"),
        (changed(QA_ROWS, 7, " 4.4 ", " 1e999 "), "line 8: y is '1e999': must be a (finite )?number"),
        (changed(QA_ROWS, 7, " 4.4 ", " four "), "line 8: y is 'four': must be a number"),
        (changed(QA_ROWS, 7, " 0 0 0", " 0 0"), "line 8: has 6 fields: must have 7"),
        (QA_ROWS[:10] + QA_ROWS[9:], "line 11: t is '1.8': must be later than 1.8"),
        (changed(QA_ROWS, 29, "5.8 ", "50.8 "), "has a gap of 45.2 s: must be at most 5 s"),
        (changed(QA_ROWS, 12, "0.10 0", "99.10 0"), "z moves by 99 mm: must be at most 80 mm"),
        (["version https://git-lfs.github.com/spec/v1"], "line 1 is 'version"),
        ([], "line 1 is ''|is empty"),
    ],
)
def test_a_damaged_trace_is_refused_by_file_line_and_field(tmp_path, lines, words):
    message = refusal(written(tmp_path, lines))
    assert message.startswith("trace.txt: ")
    assert re.search(words, message), message


def test_what_is_no_text_or_not_there_is_refused(tmp_path):
    path = tmp_path / "trace.vxp"
    assert "cannot be read" in refusal(path)
    path.write_bytes(b"\xff\xfe\x00\x01" * 50)
    assert "is not UTF-8 text" in refusal(path)
    path.write_bytes(b"")
    assert "is empty" in refusal(path)
    assert "cannot be read" in refusal(tmp_path)
