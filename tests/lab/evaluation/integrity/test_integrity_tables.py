"""The verdict on falsified recordings, by construction."""

import re

import numpy as np
import pytest

from lab.evaluation.integrity.bench import integrity_table, verdict
from lab.evaluation.integrity.cases import Case, cases
from lab.evaluation.integrity.session import FPS, SIGNALS, Session
from lab.phantom.falsifications import Falsification
from tests.support.repository import ROOT

FRAMES = 60
CAUSES = ("camera_moved", "patient_shifted")


def session(*, is_rigid=False, errors=(), lost=(), held=(), on=(), outside=(), first_s=None):
    """A session of two seconds; each argument holds slices of frames, ``errors`` with their size in the last signal."""
    shape = (FRAMES, len(SIGNALS))
    error_mm, outside_mm = np.zeros(shape), np.zeros(shape)
    is_measured, is_held, is_on = np.ones(FRAMES, bool), np.zeros(FRAMES, bool), np.zeros(shape, bool)
    for frames, size_mm in errors:
        error_mm[frames, -1] = size_mm
    for frames in lost:
        is_measured[frames], error_mm[frames] = False, np.nan
    for frames in held:
        is_held[frames] = True
    for frames in on:
        is_on[frames, 0] = True
    for frames in outside:
        outside_mm[frames, 0] = 1.5
    return Session(
        case=Case(kind="k", size="s", falsification=Falsification(start_s=3.0), is_rigid=is_rigid, causes=CAUSES),
        seconds=np.arange(FRAMES) / FPS,
        is_measured=is_measured,
        is_held=is_held,
        error_mm=error_mm,
        is_on=is_on,
        outside_mm=outside_mm,
        reasons=("marker_lost: 3 of 4 markers found",) if lost else (),
        first_s=first_s or {},
    )


def test_an_honest_session_has_no_error_and_is_not_detected():
    found = verdict([session(on=[slice(0, 30)])])
    assert (found.wrong_percent, found.longest_wrong_s, found.detected_s) == (0.0, 0.0, None)
    assert (found.measured_percent, found.on_s, found.wrong_on_s) == (100.0, 1.0, 0.0)


def test_a_wrong_signal_counts_while_it_is_measured_and_its_longest_run_is_reported():
    found = verdict([session(errors=[(slice(0, 40), -1.2)], lost=[slice(10, 20)])])
    assert found.longest_wrong_s == pytest.approx(20 / FPS)
    assert found.wrong_percent == pytest.approx(50.0)
    assert found.largest_mm == pytest.approx(1.2)
    assert found.measured_percent == pytest.approx(100 * 50 / 60)
    assert found.detected_s == pytest.approx(10 / FPS)


def test_a_hold_is_a_detection_and_one_volunteer_without_one_leaves_it_open():
    held = session(held=[slice(6, 8)])
    assert verdict([held]).detected_s == pytest.approx(0.2)
    assert verdict([held, session()]).detected_s is None


def test_the_cause_is_named_by_the_first_of_its_codes_and_late_where_one_volunteer_s_is():
    early = session(first_s={"marker_lost": 0.0, "patient_shifted": 0.4, "camera_moved": 0.2})
    found = verdict([early, session(first_s={"patient_shifted": 0.6})])
    assert (found.named_s, found.named) == (0.6, "camera_moved, patient_shifted")
    assert verdict([early, session(first_s={"marker_lost": 0.1})]).named_s is None


def test_every_case_that_is_false_has_codes_that_name_it():
    nameless = {case.kind for case in cases(is_slow=True) if not case.causes}
    assert nameless == {
        "honest",
        "marker hidden",
        "holes that roll",
        "stickers slide with the breath",
        "feet first",
        "a person leans over the couch",
    }


def test_every_case_that_is_false_tries_a_hazard_of_the_page():
    known = set(
        re.findall(r"^### ([A-Z]\d+):", (ROOT / "docs" / "2-clinical" / "hazards.md").read_text(), re.MULTILINE)
    )
    assert {case.hazard for case in cases(is_slow=True)} - known == {""}
    assert {case.kind for case in cases(is_slow=True) if not case.hazard} == {"honest", "marker hidden"}


def test_beam_on_outside_is_that_with_the_true_motion_far_outside():
    found = verdict([session(on=[slice(0, 30)], outside=[slice(15, 60)])])
    assert (found.on_s, found.wrong_on_s) == (1.0, 0.5)


def test_a_row_fails_with_a_long_error_or_a_rigid_move_that_is_not_named():
    brief, long = session(errors=[(slice(0, 15), 2.0)]), session(errors=[(slice(0, 16), 2.0)])
    unnamed, late, otherwise, named = (
        session(is_rigid=True, held=[slice(20, 60)], first_s=first_s)
        for first_s in ({}, {"camera_moved": 1.1}, {"residual_high": 0.1}, {"residual_high": 0.1, "camera_moved": 0.9})
    )
    table = integrity_table([[brief], [long], [unnamed], [late], [otherwise], [named]])
    assert table.failed == {1, 2, 3, 4}
    assert [row[-1] for row in table.rows] == [None, "stands", "not named", "not named", "not named", None]
    assert integrity_table([[session(lost=[slice(0, 3)])]]).rows[0][-2] == "marker_lost"


def test_the_catalogue_has_every_kind_once_in_each_size():
    names = [case.name for case in cases(is_slow=True)]
    assert len(names) == len(set(names)) > 60
    kinds = {case.kind.split(",")[0].split(" over ")[0] for case in cases()}
    assert kinds >= {"honest", "sheet laid", "marker re-attached", "body raised", "camera lowered", "frozen picture"}
    assert not any(case.seconds > 20.0 for case in cases() if not case.is_honest)


@pytest.mark.parametrize(("lost", "is_failed"), [(0, False), (1, False), (2, True)])
def test_an_honest_recording_of_which_more_than_one_per_cent_is_lost_fails(lost, is_failed):
    honest = next(case for case in cases() if case.is_honest)
    shape = (150, len(SIGNALS))
    one = Session(
        case=honest,
        seconds=np.arange(150) / 30.0,
        is_measured=np.arange(150) >= lost,
        is_held=np.zeros(150, bool),
        error_mm=np.zeros(shape),
        is_on=np.zeros(shape, bool),
        outside_mm=np.zeros(shape),
        reasons=(),
    )
    assert bool(integrity_table([[one]]).failed) is is_failed
