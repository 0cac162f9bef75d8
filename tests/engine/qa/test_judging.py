"""How a figure becomes a verdict, what a site may choose, and that the table of checks is one."""

import math
from itertools import pairwise

import pytest

from engine.core.errors import InvalidValueError
from engine.qa.bounds import BASELINE_BOUNDS, QaBaseline, QaBounds
from engine.qa.checks import CHECKS, check_of, checks_of, needs_of
from engine.qa.results import QaBound, QaFigure, QaKind, QaNeed, QaReport, QaVerdict, Sidedness, judge
from engine.qa.run import _total, judge_all

OFFSET = check_of("motion_offset_mm")
NOISE = check_of("plate_noise_mm")
DISTANCE = check_of("camera_distance_mm")
BOUND = QaBound(warn=1.0, fail=2.0)


def verdict(check, value, expected=None, bound=BOUND):
    return judge(QaFigure(code=check.code, value=value), check, bound, expected).verdict


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        (0.0, "pass"),
        (1.0, "pass"),
        (1.001, "warn"),
        (2.0, "warn"),
        (2.001, "fail"),
        (-1.0, "pass"),
        (-1.001, "warn"),
        (-2.001, "fail"),
        (math.nan, "fail"),
        (math.inf, "fail"),
        (-math.inf, "fail"),
        (None, "fail"),
    ],
)
def test_an_absolute_check_looks_at_how_far_it_is_off_whichever_way(value, wanted):
    assert verdict(OFFSET, value) == wanted


@pytest.mark.parametrize(
    ("value", "wanted"),
    [(-5.0, "pass"), (1.0, "pass"), (1.5, "warn"), (2.5, "fail"), (math.nan, "fail"), (None, "fail")],
)
def test_a_check_at_most_looks_at_the_figure_itself(value, wanted):
    assert verdict(NOISE, value) == wanted


def test_what_has_a_baseline_is_held_against_the_site_s_and_fails_without_one():
    judgement = judge(QaFigure(code=DISTANCE.code, value=851.5), DISTANCE, BOUND, 850.0)
    assert (judgement.verdict, judgement.expected, judgement.deviation) == ("warn", 850.0, 1.5)
    without = judge(QaFigure(code=DISTANCE.code, value=851.5), DISTANCE, BOUND, None)
    assert (without.verdict, without.value, without.deviation) == ("fail", 851.5, None)
    assert "baseline" in without.detail


def test_a_baseline_is_nothing_to_a_check_that_has_none():
    judgement = judge(QaFigure(code=OFFSET.code, value=5.0), OFFSET, BOUND, 5.0)
    assert (judgement.expected, judgement.verdict) == (0.0, "fail")


def test_what_was_not_measured_states_it_and_why():
    judgement = judge(QaFigure(code=NOISE.code, value=None, detail="the plate was tilted"), NOISE, BOUND)
    assert judgement.detail == "not measured; the plate was tilted"
    assert judgement.value is None


def test_a_number_that_is_none_is_not_handed_on():
    judgement = judge(QaFigure(code=NOISE.code, value=math.nan), NOISE, BOUND)
    assert judgement.value is None
    assert judgement.deviation is None


def test_a_figure_is_only_judged_as_its_own_check():
    with pytest.raises(InvalidValueError, match="plate_noise_mm"):
        judge(QaFigure(code="motion_offset_mm", value=0.0), NOISE, BOUND)


def test_a_run_is_as_good_as_its_worst_check_and_nothing_checked_is_a_fail():
    order = [QaVerdict.PASS, QaVerdict.WARN, QaVerdict.FAIL]
    for better, worse in pairwise(order):
        assert QaVerdict.worst([better, worse, better]) is worse
    assert QaVerdict.worst([]) is QaVerdict.FAIL
    assert QaReport(kind=QaKind.DAILY, results=()).verdict is QaVerdict.FAIL


def test_a_check_that_nothing_was_measured_for_fails_its_run():
    results = judge_all(QaKind.DAILY, [], QaBounds(), QaBaseline())
    needed = [check.code for check in checks_of(QaKind.DAILY) if not check.is_optional]
    assert [result.code for result in results] == needed
    assert {result.verdict for result in results} == {QaVerdict.FAIL}


def test_every_check_stands_once_with_bounds_it_may_have_and_states_where_they_are_from():
    codes = [check.code for check in CHECKS]
    assert len(set(codes)) == len(codes)
    for check in CHECKS:
        assert 0.0 <= check.warn <= check.fail <= check.most, check.code
        assert check.source, check.code
        assert check.method.endswith("."), check.code
        assert check.title, check.code
        is_absolute = check.sidedness is Sidedness.ABSOLUTE
        assert (check.expected is not None or check.has_baseline) is is_absolute, check.code
        assert check.has_baseline is (check.code in BASELINE_BOUNDS), check.code


def test_each_kind_holds_all_of_the_one_before():
    daily, monthly, annual, latency = (set(checks_of(kind)) for kind in QaKind)
    assert daily < monthly < annual == set(CHECKS) - latency
    assert not annual & latency
    assert needs_of(QaKind.LATENCY) == (QaNeed.CAMERA,)
    assert needs_of(QaKind.DAILY) == (QaNeed.PLATE, QaNeed.BEAM)
    assert needs_of(QaKind.MONTHLY) == needs_of(QaKind.ANNUAL) == (QaNeed.PLATE, QaNeed.PHANTOM, QaNeed.BEAM)


@pytest.mark.parametrize("code", [check.code for check in CHECKS if check.code.startswith("fail_safe")])
def test_every_drill_is_done_every_day(code):
    assert QaKind.DAILY in check_of(code).kinds


def test_a_site_s_bounds_go_before_the_table_s():
    bounds = QaBounds(chosen={NOISE.code: QaBound(warn=0.5, fail=0.75)})
    assert bounds.of(NOISE.code) == QaBound(warn=0.5, fail=0.75)
    assert bounds.of(OFFSET.code) == QaBound(warn=OFFSET.warn, fail=OFFSET.fail)


@pytest.mark.parametrize(
    ("warn", "fail", "field"),
    [
        (0.5, NOISE.most + 0.1, "fail"),
        (-0.1, 1.0, "warn"),
        (0.5, math.nan, "fail"),
        (math.nan, 1.0, "warn"),
        (0.5, math.inf, "fail"),
        (1.0, 0.5, "warn"),
        (True, 1.0, "warn"),
    ],
)
def test_bounds_that_are_none_or_too_wide_are_refused_by_name(warn, fail, field):
    with pytest.raises(InvalidValueError) as refusal:
        QaBounds(chosen={NOISE.code: QaBound(warn=warn, fail=fail)})
    assert refusal.value.field == f"plate_noise_mm.{field}"


def test_bounds_of_no_check_are_refused():
    with pytest.raises(InvalidValueError, match="plate_colour"):
        QaBounds(chosen={"plate_colour": BOUND})
    with pytest.raises(InvalidValueError, match="plate_colour"):
        QaBounds().of("plate_colour")


@pytest.mark.parametrize(
    "expected",
    [
        {"plate_noise_mm": 1.0},
        {"camera_distance_mm": 0.0},
        {"camera_distance_mm": math.nan},
        {"camera_tilt_x_deg": 90.0},
    ],
)
def test_a_baseline_that_cannot_be_is_refused(expected):
    with pytest.raises(InvalidValueError, match=next(iter(expected))):
        QaBaseline(expected=expected)


def test_what_the_gate_and_the_line_take_adds_up_and_is_not_known_without_either():
    gate, line = QaFigure(code="gate_delay_off_ms", value=70.0), QaFigure(code="beam_readback_off_ms", value=45.0)
    assert _total([gate, line]).value == pytest.approx(115.0)
    assert _total([gate]).value is None
    assert _total([line]).value is None
