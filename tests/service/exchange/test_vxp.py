"""RPM files, written and read again by the reader of recorded ones."""

from datetime import date

import numpy as np
import pytest

from engine.qa.recorded_traces import read_trace
from service.exchange.four_d_ct import places_in_breath
from service.exchange.vxp import vxp
from tests.support.exchange.breaths import breath
from tests.support.repository import ROOT

REAL = next((ROOT / "tests/data/rpm").glob("*.vxp"))


def rows_of(text):
    return [line.split(",") for line in text.split("[Data]\r\n")[1].split()]


@pytest.fixture
def given():
    at, motion = breath()
    motion[100:120] = np.nan
    return {
        "time_s": at,
        "motion_mm": motion,
        "place": places_in_breath(at, motion),
        "is_on": np.arange(len(at)) % 3 == 0,
        "patient_id": "P-0001\n",
        "day": date(2026, 11, 27),
    }


def test_motion_is_read_back_with_its_sign_and_scale(tmp_path, given):
    path = tmp_path / "curve.vxp"
    path.write_bytes(vxp(**given).encode())
    found = read_trace(path)
    known = np.isfinite(given["motion_mm"])
    motion = given["motion_mm"] - np.interp(0.0, [0.0], [0.0])
    shift = found.at(given["time_s"])[known] - motion[known]
    assert np.ptp(shift) < 0.01
    assert found.seconds == pytest.approx(given["time_s"][-1], abs=1e-3)


def test_the_header_is_that_of_a_real_file_without_the_checksum(given):
    head = vxp(**given).split("[Data]")[0].split()
    real = REAL.read_text().split("[Data]")[0].split()
    names = [line.partition("=")[0] for line in real if not line.startswith("CRC")]
    assert [line.partition("=")[0] for line in head] == names
    assert "Data_layout=amplitude,phase,timestamp,validflag,ttlin,mark,ttlout" in head
    assert "Patient_ID=P-0001" in head
    assert "Date=11-27-2026" in head


def test_flags_marks_and_the_gate(given):
    rows = rows_of(vxp(**given))
    flags = np.array([int(row[3]) for row in rows])
    assert (flags[100:120] == -1).all()
    first = np.flatnonzero(np.isfinite(given["place"]))[0]
    assert (flags[:first][:90] == -2).all()
    assert [int(row[6]) for row in rows] == given["is_on"].astype(int).tolist()
    marks = [(row[5], float(row[1]) / (2.0 * np.pi)) for row in rows if row[5]]
    assert {name for name, _ in marks} == {"Z", "P"}
    assert all(place < 0.05 for name, place in marks if name == "Z")
    assert all(0.5 <= place < 0.55 for name, place in marks if name == "P")


@pytest.mark.parametrize("is_low_active", [False, True])
def test_images_are_marked_at_the_nearest_value_in_either_polarity(given, is_low_active):
    rows = rows_of(vxp(**given, image_s=np.array([5.01, 7.99]), is_low_active=is_low_active))
    active = [i for i, row in enumerate(rows) if int(row[4]) != is_low_active]
    assert active == [150, 240]


def test_a_real_file_goes_in_and_out(tmp_path):
    trace = read_trace(REAL)
    place = places_in_breath(trace.time_s, trace.motion_mm)
    text = vxp(
        time_s=trace.time_s,
        motion_mm=trace.motion_mm,
        place=place,
        is_on=np.zeros(len(place), dtype=bool),
        patient_id="PT01",
    )
    path = tmp_path / "again.vxp"
    path.write_bytes(text.encode())
    again = read_trace(path)
    np.testing.assert_allclose(again.time_s, trace.time_s, atol=1e-3)
    assert np.ptp(again.motion_mm - trace.motion_mm) < 0.01
