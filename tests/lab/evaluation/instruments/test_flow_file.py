"""A spirometer's file: read as it is, and refused by line and column when it cannot be."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from scipy.interpolate import make_interp_spline

from lab.evaluation.instruments.flow_file import FlowFileError, read_flow

TIMES = np.arange(25) * 0.04


def write(tmp_path, text):
    path = tmp_path / "flow.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def table(header="time_s,flow_l_per_s", separator=",", rows=None):
    rows = [f"{time:.2f}{separator}{0.1 * index:.1f}" for index, time in enumerate(TIMES)] if rows is None else rows
    return "\n".join([header, *rows]) + "\n"


def test_flow_in_litres_a_second_is_read(tmp_path):
    read = read_flow(write(tmp_path, table()))
    assert read.is_flow
    assert read.time_s == pytest.approx(TIMES)
    assert read.values == pytest.approx(0.1 * np.arange(25))


@pytest.mark.parametrize(
    ("text", "is_flow"),
    [
        (table("time_s;flow_l_per_s", ";").replace(".", ","), True),
        (table("time_s;volume_l", ";"), False),
        (table('"Time_s" , "Volume_L"'), False),
        ("\ufeff" + table(), True),
        (table().replace("\n", "\r\n") + "\r\n\r\n", True),
        (table("time_ms,flow_l_per_s", rows=[f"{1000 * t:.0f},{0.1 * i:.1f}" for i, t in enumerate(TIMES)]), True),
        (table("volume_l,time_s", rows=[f"{0.1 * i:.1f},{t:.2f}" for i, t in enumerate(TIMES)]), False),
    ],
    ids=["decimal comma", "semicolon", "quotes and spaces", "byte order mark", "Windows", "milliseconds", "swapped"],
)
def test_other_ways_to_write_the_same_are_read_alike(tmp_path, text, is_flow):
    read = read_flow(write(tmp_path, text))
    assert read.is_flow is is_flow
    assert read.time_s == pytest.approx(TIMES)
    assert read.values == pytest.approx(0.1 * np.arange(25))


def lines_with(index, line):
    rows = [f"{time:.2f},0.5" for time in TIMES]
    rows[index] = line
    return table(rows=rows)


@pytest.mark.parametrize(
    ("text", "field", "bound"),
    [
        ("", "flow.csv line 1", "a header"),
        (table("time,flow"), "line 1", "two columns"),
        (table("time_s,flow_l_per_s,volume_l"), "line 1", "two columns"),
        (table("time_s,time_ms"), "line 1", "two columns"),
        (lines_with(3, "0.12,half"), "flow.csv line 5, flow_l_per_s", "a number"),
        (lines_with(3, "0.12,0,5"), "flow.csv line 5", "2 columns"),
        (lines_with(3, "0.12"), "flow.csv line 5", "2 columns"),
        (lines_with(3, "0.12,1_0"), "flow.csv line 5, flow_l_per_s", "a number"),
        (lines_with(3, "0.08000001,0.5"), "flow.csv line 5, time_s", "later than the line before, by 0.0001"),
        (lines_with(3, "0.12,nan"), "flow.csv line 5, flow_l_per_s", "from -20 to 20"),
        (lines_with(3, "inf,0.5"), "flow.csv line 5, time_s", "from"),
        (lines_with(3, "0.12,21"), "flow.csv line 5, flow_l_per_s", "from -20 to 20"),
        (lines_with(3, "0.08,0.5"), "flow.csv line 5, time_s", "later than the line before"),
        (lines_with(24, "3.5,0.5"), "flow.csv line 26, time_s", "later than the line before, by 0.0001 to 1 s"),
        (table(rows=["0.0,1.0"] * 3), "flow.csv", "20 samples or more"),
        (b"time_s,flow_l_per_s\n\xff\xfe", "flow.csv", "text in UTF-8"),
    ],
)
def test_what_cannot_be_right_is_named_by_line_and_column(tmp_path, text, field, bound):
    with pytest.raises(FlowFileError) as caught:
        read_flow(write(tmp_path, text))
    assert caught.value.field == field
    assert bound in caught.value.bound


def test_lines_are_counted_over_empty_ones(tmp_path):
    text = lines_with(3, "0.08,0.5").replace("0.04,0.5\n", "0.04,0.5\n\n\n")
    with pytest.raises(FlowFileError, match=r"flow\.csv line 7, time_s"):
        read_flow(write(tmp_path, text))


@given(
    st.one_of(
        st.binary(max_size=200),
        st.lists(st.tuples(st.floats(), st.floats()), max_size=40).map(
            lambda rows: ("time_ms,volume_l\n" + "\n".join(f"{a},{b}" for a, b in rows)).encode()
        ),
        st.lists(st.tuples(st.floats(0.0, 0.9), st.floats(-90.0, 90.0)), min_size=20, max_size=40).map(
            lambda rows: (
                "time_s;volume_l\n"
                + "\n".join(f"{time};{row[1]}" for time, row in zip(np.cumsum([a for a, _ in rows]), rows, strict=True))
            ).encode()
        ),
    )
)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_whatever_is_in_a_file_it_is_read_or_refused(tmp_path, content):
    try:
        read = read_flow(write(tmp_path, content))
    except FlowFileError:
        return
    assert np.isfinite(read.values).all()
    assert np.diff(read.time_s).min() > 0.0
    make_interp_spline(read.time_s, read.values, k=3)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(FlowFileError, match="readable"):
        read_flow(tmp_path / "flow.csv")
    with pytest.raises(FlowFileError, match="readable"):
        read_flow(tmp_path)
