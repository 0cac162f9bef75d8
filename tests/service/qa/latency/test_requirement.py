"""Clinical mode arms only with a camera whose latency was measured; the gate counts the larger of both values."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from service.core.errors import BoundError, CameraLatencyError
from service.core.settings.settings import Settings
from service.qa.latency.requirement import (
    counted_latency_ms,
    largest_counted_ms,
    newest_latencies,
    refusal,
    refuse_unmeasured,
    refuse_unmeasured_site,
)
from tests.support.qa.latency_runs import CAMERA, NOW, put
from tests.support.service.clinical_site import clinical_settings

pytestmark = pytest.mark.both_databases

SITE = clinical_settings()
"""It counts 40 ms."""


def why(database, settings=SITE, camera=CAMERA, now=NOW):
    with database.read() as db:
        return refusal(newest_latencies(db), settings, camera, now)


def counted(database, settings=SITE, serial="A1"):
    with database.read() as db:
        return counted_latency_ms(db, settings, serial)


def test_a_young_measurement_of_this_camera_and_mode_that_the_site_counts_permits_arming(database):
    put(database)
    assert why(database) is None


def test_without_a_measurement_the_refusal_names_camera_and_command(database):
    reason = why(database)
    assert "this camera (A1) was never measured" in reason
    assert "tidegate qa latency" in reason


@pytest.mark.parametrize(
    "made",
    [
        {"is_simulated": True},
        {"status": "cancelled"},
        {"status": "failed"},
        {"status": None},
        {"median_ms": None, "verdict": "fail"},
        {"kind": "annual"},
    ],
    ids=str,
)
def test_what_is_no_measurement_counts_for_nothing(database, made):
    put(database, **made)
    assert "never measured" in why(database)
    assert counted(database, Settings()) == 0.0


def test_an_attempt_without_a_number_leaves_the_measurement_before_it(database):
    put(database)
    put(database, age_days=1.0, median_ms=None, verdict="fail")
    put(database, age_days=0.5, status="cancelled")
    assert why(database) is None


def test_another_camera_is_no_camera_of_this_session(database):
    put(database, camera=replace(CAMERA, serial="B2"))
    assert "this camera (A1) was never measured" in why(database)


def test_cameras_without_a_serial_number_are_known_by_their_name(database):
    nameless = replace(CAMERA, serial="")
    put(database, camera=nameless)
    assert why(database, camera=nameless) is None
    assert "never measured" in why(database, camera=replace(nameless, name="Kinect"))


@pytest.mark.parametrize(
    "other", [{"depth_size": (320, 240)}, {"color_size": (320, 240)}, {"fps": 60.0}, {"name": "Kinect"}], ids=str
)
def test_another_mode_is_refused_with_both_modes(database, other):
    put(database, camera=replace(CAMERA, **other))
    reason = why(database)
    assert "another mode (depth" in reason
    assert "this session's (depth 640 x 480, colour 640 x 480, 30 frames a second)" in reason


@pytest.mark.parametrize(("age_days", "is_allowed"), [(364.9, True), (365.1, False), (-0.1, False)])
def test_a_measurement_lasts_as_long_as_the_site_states(database, age_days, is_allowed):
    put(database, age_days=age_days)
    reason = why(database)
    assert (reason is None) is is_allowed
    if age_days > 365.0:
        assert "older than 365 days" in reason
    if age_days < 0.0:
        assert "check this machine's clock" in reason
    assert ("older than 5 days" in (why(database, clinical_settings(qa_latency_max_age_days=5.0)) or "")) is (
        age_days > 5.0
    )


def test_a_failed_measurement_holds_until_a_newer_one_is_passed(database):
    put(database, age_days=3.0)
    failed = put(database, age_days=2.0, verdict="fail")
    assert f"failed its bounds (run {failed[:8]})" in why(database)
    put(database, age_days=1.0, verdict="warn")
    assert why(database) is None


@pytest.mark.parametrize(
    ("median_ms", "half_ms", "is_allowed"), [(35.0, 5.0, True), (35.0, 5.1, False), (41.0, 0.0, False)]
)
def test_median_and_uncertainty_must_lie_within_what_the_site_counts(database, median_ms, half_ms, is_allowed):
    put(database, median_ms=median_ms, half_ms=half_ms)
    reason = why(database)
    assert (reason is None) is is_allowed
    if reason is not None:
        assert f"set TIDEGATE_CAMERA_LATENCY_MS to {median_ms + half_ms:g} or more" in reason


def test_the_camera_has_to_be_known_and_a_recording_needs_none(database):
    put(database)
    assert "not known yet" in why(database, camera=None)
    assert why(database, camera=replace(CAMERA, is_live=False, serial="")) is None


def test_research_mode_requires_none(database):
    refuse_unmeasured(database, Settings(), CAMERA)
    refuse_unmeasured_site(database, Settings())


def test_clinical_mode_names_field_and_bound(database):
    with pytest.raises(CameraLatencyError, match="never measured") as refused:
        refuse_unmeasured(database, SITE, CAMERA)
    assert refused.value.field == "camera_latency_ms"
    assert "within 365 days, and at most TIDEGATE_CAMERA_LATENCY_MS (40)" in refused.value.bound


def test_a_site_needs_one_usable_camera(database):
    with pytest.raises(CameraLatencyError, match="ever measured"):
        refuse_unmeasured_site(database, SITE)
    put(database, median_ms=60.0, now=datetime.now(UTC))
    with pytest.raises(CameraLatencyError, match="set TIDEGATE_CAMERA_LATENCY_MS to 65"):
        refuse_unmeasured_site(database, SITE)
    put(database, camera=replace(CAMERA, serial="B2"), now=datetime.now(UTC))
    refuse_unmeasured_site(database, SITE)


@pytest.mark.parametrize("configured_ms", [0.0, 20.0, 34.9, 35.0, 60.0])
def test_the_gate_counts_the_larger_of_both_in_every_mode(database, configured_ms):
    assert counted(database, Settings(camera_latency_ms=configured_ms)) == configured_ms
    put(database)
    assert counted(database, Settings(camera_latency_ms=configured_ms)) == max(configured_ms, 35.0)


def test_an_old_or_failed_measurement_counts_as_well(database):
    put(database, age_days=2000.0, verdict="fail", median_ms=120.0)
    assert counted(database) == 125.0


def test_the_newest_of_a_mode_counts_and_the_largest_of_the_modes(database):
    put(database, age_days=2.0, median_ms=90.0)
    put(database, age_days=1.0, median_ms=30.0)
    assert counted(database) == 40.0
    put(database, age_days=3.0, median_ms=50.0, camera=replace(CAMERA, fps=60.0))
    assert counted(database) == 55.0


def test_without_a_serial_number_in_the_calibration_every_camera_counts(database):
    put(database, camera=replace(CAMERA, serial="B2"), median_ms=70.0)
    assert counted(database, serial="A1") == 40.0
    assert counted(database, serial="") == 75.0


@pytest.mark.parametrize(("site", "median_ms"), [({}, 296.0), ({"max_latency_ms": 100.0}, 95.0)])
def test_a_latency_beyond_what_the_gate_accepts_is_refused_at_the_start(database, site, median_ms):
    put(database, median_ms=median_ms)
    with pytest.raises(BoundError, match="measured latency is") as refused:
        counted(database, Settings(**site))
    assert refused.value.field == "camera_latency_ms"


def test_what_counts_is_rounded_up_and_never_down(database):
    put(database, median_ms=30.01, half_ms=5.0)
    with database.read() as db:
        (found,) = newest_latencies(db)
    assert found.counted_ms == 35.1
    assert largest_counted_ms([found], "A1") == 35.1
    assert largest_counted_ms([], "") == 0.0


@pytest.mark.parametrize("days", [0.5, 1101.0])
def test_the_age_is_bounded(days):
    with pytest.raises(ValueError, match="qa_latency_max_age_days"):
        Settings(qa_latency_max_age_days=days)
