"""The mechanisms that are broken, one at a time, in a copy of the sources; each with the test that must fail."""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.support.repository import ROOT

COPIED = (
    "engine",
    "lab",
    "service",
    "tests",
    "verification",
    "conftest.py",
    "migrations",
    "docs",
    "openapi",
    "pyproject.toml",
    "LICENSE",
    "README.md",
)
TIMEOUT_S = 300.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Planted:
    """One broken mechanism: ``old`` becomes ``new`` where it first stands in ``file``, and ``test`` has to fail."""

    what: str
    file: str
    old: str
    new: str
    test: str


_CROSS, _CROSS_TEST = "engine/motion/cross_check/cross_check.py", "tests/engine/motion/cross_check/test_cross_check.py"
_BUDGET, _WINDOWS = "engine/control/fraction_checks.py", "tests/engine/control/test_window_budget.py"
_BREATH, _STAY = "engine/gating/windows/patient_breath.py", "tests/engine/control/test_stay_through_commands.py"
_NOISE, _NOISE_TEST = (
    "engine/motion/cross_check/present_noise.py",
    "tests/engine/motion/cross_check/test_present_noise.py",
)
_REPEATED = "engine/motion/tracking/repeated_pictures.py"
_REPEATED_TEST = "tests/engine/motion/tracking/test_repeated_pictures.py"
_TIME, _TIME_TEST = "service/storage/believed_time.py", "tests/service/storage/test_believed_time.py"
_WARMTH, _WARMTH_TEST = "service/engine_host/camera_warmth.py", "tests/service/engine_host/test_camera_warmth.py"
_SUPERVISION = "tests/engine/gating/supervision"
PLANTED: tuple[Planted, ...] = (
    Planted(
        what="a moment outside of the window ends a stay",
        file=_BREATH,
        old="AWAY_S = 0.3",
        new="AWAY_S = 0.2",
        test="tests/engine/gating/test_beam_on_limit.py::"
        "test_a_stay_ends_only_beyond_an_edge_by_the_hysteresis_for_as_long_as_a_breath_takes",
    ),
    Planted(
        what="a stay is judged by the edges in force, not by those of when the beam was on",
        file=_BREATH,
        old="return max(edges.lower - now.value, now.value - edges.upper)",
        new="return max(now.edges.lower - now.value, now.value - now.edges.upper)",
        test=f"{_STAY}::test_no_way_round_begins_the_time_anew",
    ),
    Planted(
        what="lost frames between two do not break a breath",
        file=_BREATH,
        old="is_next = 0 <=",
        new="is_next = True or 0 <=",
        test=f"{_STAY}::test_no_way_round_begins_the_time_anew",
    ),
    Planted(
        what="another reference is a breath",
        file="engine/control/gate_controller.py",
        old="conditions=rescaled(self.gate.conditions)",
        new="conditions=self.gate.conditions",
        test=f"{_STAY}::test_no_way_round_begins_the_time_anew",
    ),
    Planted(
        what="two times the noise beyond an edge are a breath",
        file=_BREATH,
        old="NOISES = 3.0",
        new="NOISES = 1.5",
        test="tests/engine/gating/test_beam_on_limit.py::test_a_noisy_signal_has_to_be_further_out",
    ),
    Planted(
        what="a quarter of the learned breath is a breath",
        file=_BREATH,
        old="BREATH_SHARE = 1.0 / 3.0",
        new="BREATH_SHARE = 1.0 / 3.2",
        test="tests/engine/gating/test_beam_on_limit.py::"
        "test_a_third_of_the_learned_breath_away_from_where_the_beam_was_on_is_a_breath",
    ),
    Planted(
        what="a later window lengthens a breath hold",
        file="engine/gating/windows/breath_hold.py",
        old="state.timeout_s * NS_PER_S",
        new="self.timeout_s * NS_PER_S",
        test="tests/engine/gating/windows/test_breath_hold.py::test_the_least_time_of_all_windows_ends_a_hold",
    ),
    Planted(
        what="ceased breathing is excused in every window",
        file="engine/gating/gate.py",
        old="is_breath_held = is_held(limits.window, found.states)",
        new="is_breath_held = True",
        test="tests/engine/gating/windows/test_breath_hold.py::"
        "test_ceased_breathing_in_the_other_way_into_the_beam_is_not_excused",
    ),
    Planted(
        what="an inspiration hold may lie in free breathing",
        file="engine/gating/active_window.py",
        old="INSPIRATION_FROM, EXPIRATION_TO = 60.0, 40.0",
        new="INSPIRATION_FROM, EXPIRATION_TO = 0.0, 100.0",
        test="tests/engine/gating/test_duty_cycle.py::test_a_breath_hold_whose_level_free_breathing_reaches_is_refused",
    ),
    Planted(
        what="a program's release ends every hold",
        file="engine/control/gate_controller.py",
        old="elif command.is_person:",
        new="elif command is not None:",
        test="tests/engine/control/test_operators.py::"
        "test_a_release_ends_ones_own_hold_and_a_person_s_hold_is_ended_by_a_person",
    ),
    Planted(
        what="what was looked at is not compared",
        file="engine/control/arming.py",
        old="command.seen != self.state",
        new="command.seen == ''",
        test="tests/engine/control/test_armed_as_seen.py::"
        "test_an_arming_for_something_else_than_was_looked_at_is_refused",
    ),
    Planted(
        what="a check may be silent for 1 s",
        file="engine/gating/limits.py",
        old="MAX_UNCHECKED_US = 500_000",
        new="MAX_UNCHECKED_US = 1_000_000",
        test=f"{_SUPERVISION}/test_checks.py::test_a_check_that_cannot_work_any_more_holds_after_half_a_second",
    ),
    Planted(
        what="the age of the pictures may be unknown for 5 s",
        file="engine/gating/delivery.py",
        old="since_ns <= MAX_UNCHECKED_US * NS_PER_US",
        new="since_ns <= 10 * MAX_UNCHECKED_US * NS_PER_US",
        test="tests/engine/gating/test_delivery.py::"
        "test_a_backlog_that_a_fast_clock_hides_holds_within_half_a_second_and_states_since_when",
    ),
    Planted(
        what="markers that are not compared are not noticed",
        file="engine/gating/supervision/checks.py",
        old="Check.MARKERS: has_markers,",
        new="Check.MARKERS: True,",
        test=f"{_SUPERVISION}/test_checks.py::test_a_check_that_cannot_work_any_more_holds_after_half_a_second",
    ),
    Planted(
        what="the second estimate always claims to compare the colour",
        file=_CROSS,
        old="color=color.colored_share >= LEAST_COLORED",
        new="color=True",
        test=f"{_CROSS_TEST}::test_the_colour_is_compared_where_half_of_the_region_has_one",
    ),
    Planted(
        what="the camera may move by 2 mm",
        file=_CROSS,
        old="CAMERA_MM = 1.5",
        new="CAMERA_MM = 2.0",
        test=f"{_CROSS_TEST}::test_the_bound_of_a_moved_camera_is_a_millimetre_and_a_half_itself",
    ),
    Planted(
        what="a surface may differ by 1.2 mm on a noisy sensor",
        file=_CROSS,
        old="MOST_MISFIT_MM = 0.6",
        new="MOST_MISFIT_MM = 1.2",
        test=f"{_CROSS_TEST}::test_a_surface_may_differ_by_what_noise_of_now_explains_and_by_six_tenths_at_most",
    ),
    Planted(
        what="the noise of the training counts whatever it is now",
        file=_NOISE,
        old="return noise_mm if noise_mm < trained_mm else trained_mm",
        new="return trained_mm",
        test=f"{_NOISE_TEST}::test_the_smaller_of_the_training_s_and_the_present_one_counts",
    ),
    Planted(
        what="half of the training's noise is a filter",
        file=_NOISE,
        old="FILTERED_SHARE = 0.4",
        new="FILTERED_SHARE = 0.8",
        test=f"{_NOISE_TEST}::test_a_filter_in_time_is_found_within_half_a_second_and_noise_alone_never_is",
    ),
    Planted(
        what="old parts of a picture are not looked for",
        file=_REPEATED,
        old=" and earlier.has_part()",
        new=" and False",
        test=f"{_REPEATED_TEST}::test_a_picture_that_is_old_in_part_is_old_for_as_long_as_it_lags",
    ),
    Planted(
        what="a part is old from nineteen of twenty readings",
        file=_REPEATED,
        old="OLD_TILE_SHARE = 0.995",
        new="OLD_TILE_SHARE = 0.9",
        test=f"{_REPEATED_TEST}::test_a_part_that_never_changes_tells_nothing_and_one_that_hardly_does_is_not_old",
    ),
    Planted(
        what="ends of exhale are kept for 5 s",
        file="engine/gating/supervision/supervisor.py",
        old="KEPT_US = 135_000_000",
        new="KEPT_US = 5_000_000",
        test=f"{_SUPERVISION}/test_exhale_shape.py::"
        "test_a_breath_that_pauses_is_judged_up_to_the_longest_that_a_site_allows_and_then_said_to_be_missing",
    ),
    Planted(
        what="a fraction that was armed without a signature needs none",
        file=_BUDGET,
        old="if signed is None or placed is None:\n            return True",
        new="if signed is None or placed is None:\n            return False",
        test="tests/engine/control/test_countersignature.py::"
        "test_without_it_the_first_arming_is_refused_and_no_permit_given",
    ),
    Planted(
        what="a signature covers any window that is set later",
        file=_BUDGET,
        old="is_set_beyond(signed, placed) or not",
        new="not",
        test="tests/engine/control/test_countersignature.py::"
        "test_later_armings_need_none_unless_a_window_is_set_beyond_the_one_that_was_signed",
    ),
    Planted(
        what="names that differ by case are two",
        file="service/core/identity.py",
        old=".casefold()",
        new="",
        test="tests/service/storage/database/test_identities.py::test_what_looks_alike_has_one_key",
    ),
    Planted(
        what="letters that look alike are two",
        file="service/core/identity.py",
        old=".translate(_LOOK_ALIKE).casefold().translate(_LOOK_ALIKE)",
        new=".casefold()",
        test="tests/service/storage/database/test_identities.py::test_what_looks_alike_has_one_key",
    ),
    Planted(
        what="a clock may be a year ahead of the records",
        file=_TIME,
        old="FAR = timedelta(days=3)",
        new="FAR = timedelta(days=400)",
        test=f"{_TIME_TEST}::test_a_clock_that_starts_far_from_the_records_removes_nothing_for_a_day_of_run_time",
    ),
    Planted(
        what="a doubted clock is believed after an hour",
        file=_TIME,
        old="WAIT = timedelta(days=1)",
        new="WAIT = timedelta(hours=1)",
        test=f"{_TIME_TEST}::test_a_clock_that_starts_far_from_the_records_removes_nothing_for_a_day_of_run_time",
    ),
    Planted(
        what="a camera without a serial number may be warm",
        file=_WARMTH,
        old="if not serial or not now.boot:",
        new="if not now.boot:",
        test=f"{_WARMTH_TEST}::test_another_camera_at_the_same_socket_is_cold_and_so_is_one_without_a_serial_number",
    ),
    Planted(
        what="warmth outlives the machine's next start",
        file=_WARMTH,
        old="seen.boot != now.boot or",
        new="",
        test=f"{_WARMTH_TEST}::test_after_the_machine_s_next_start_every_camera_is_cold_whatever_its_clock_says",
    ),
    Planted(
        what="a cold reference stays when the camera is warm",
        file="engine/motion/learning/learner.py",
        old="self.history.doubt_first()\n        self.reference.drop()\n        self.reference.is_needed = True",
        new="self.history.doubt_first()",
        test="tests/engine/motion/test_pipeline_camera_returned.py::"
        "test_a_reference_that_a_cold_camera_measured_is_dropped_and_its_distance_is_not_known",
    ),
    Planted(
        what="an answer of another function counts",
        file="engine/beam/wire/modbus.py",
        old="if answer.function_code != function or answer.dev_id",
        new="if answer.dev_id",
        test="tests/engine/beam/wire/test_modbus.py::test_the_answer_to_another_question_is_none",
    ),
    Planted(
        what="anchors in the data folder give no warning",
        file="service/monitoring/readiness.py",
        old="yield _reason(ReadinessCode.ANCHORS_INSIDE, detail)",
        new="pass",
        test="tests/service/monitoring/test_readiness.py::test_anchors_in_the_data_folder_are_a_warning",
    ),
    Planted(
        what="a quarter of the region may have another colour",
        file=_CROSS,
        old="OTHER_COLOR_SHARE = 0.06",
        new="OTHER_COLOR_SHARE = 0.25",
        test=f"{_CROSS_TEST}::test_another_colour_is_an_object_from_six_per_cent_of_the_region",
    ),
    Planted(
        what="a disagreement ends at its limit itself",
        file=_CROSS,
        old="RETURNED = 0.8",
        new="RETURNED = 1.0",
        test=f"{_CROSS_TEST}::test_an_object_that_shrinks_is_one_until_it_is_clearly_smaller_than_its_limit",
    ),
    Planted(
        what="a deep breath hides any height",
        file=_CROSS,
        old="HEIGHT_OF_DEEPER = 0.6",
        new="HEIGHT_OF_DEEPER = 6.0",
        test=f"{_CROSS_TEST}::test_a_patient_raised_within_a_deeper_breath_is_so_but_for_a_share_of_it",
    ),
    Planted(
        what="five cells are a surface",
        file="engine/motion/cross_check/cell_surface.py",
        old="LEAST_CELLS = 20",
        new="LEAST_CELLS = 5",
        test=f"{_CROSS_TEST}::test_the_surface_is_compared_by_twenty_cells",
    ),
    Planted(
        what="ten frames teach the scene after one that was hidden",
        file="engine/motion/cross_check/static_scene.py",
        old="self._seen, self._began_us = [], None\n        is_seen",
        new="self._seen = []\n        is_seen",
        test="tests/engine/motion/cross_check/test_static_scene.py::"
        "test_a_scene_that_was_hidden_at_the_reference_is_learned_when_it_is_seen",
    ),
    Planted(
        what="a jump leaves the level known",
        file="engine/gating/supervision/patient_shift.py",
        old="self._note_jump(measurement.motion, measurement.frame_index, now_us, levels)",
        new="pass",
        test=f"{_SUPERVISION}/test_baseline.py::test_after_a_jump_the_level_is_confirmed_as_after_a_loss",
    ),
    Planted(
        what="a shift that is left at the end of exhale is a breath's",
        file="engine/gating/supervision/supervisor.py",
        old="REDISTRIBUTED_SHARE * allowed_mm:",
        new="10.0 * allowed_mm:",
        test=f"{_SUPERVISION}/test_exhale_shape.py::"
        "test_a_shift_that_is_left_at_the_end_of_exhale_holds_until_it_is_gone_there",
    ),
    Planted(
        what="stickers may slide",
        file="engine/gating/supervision/patient_shift.py",
        old="self._hold_for_travel() if is_on_part else None",
        new="None",
        test=f"{_SUPERVISION}/test_patient_shift.py::test_markers_that_slide_with_the_breath_hold_a_window_on_a_part",
    ),
    Planted(
        what="a window is set without the budget",
        file=_BUDGET,
        old='self._refuse_reach("window", window, command)',
        new="pass",
        test=f"{_WINDOWS}::test_ten_millimetres_beyond_the_first_armed_window_need_a_person_s_reason",
    ),
    Planted(
        what="an arming does not look at the budget",
        file="engine/control/arming.py",
        old="self.budget.check_arming(command)",
        new="pass",
        test=f"{_WINDOWS}::test_a_window_and_a_reference_add_up_at_the_arming",
    ),
    Planted(
        what="a reference waits without limit for a measured frame",
        file="engine/motion/learning/reference.py",
        old="0 <= self._journal.now_us - self._request.at_us <= MAX_GAP_US",
        new="self._request.at_us >= 0",
        test="tests/engine/motion/learning/test_reference_history.py::"
        "test_a_reference_that_no_frame_takes_up_for_a_second_is_dropped",
    ),
    Planted(
        what="a hold during a repeated permit is not looked for",
        file="engine/beam/wire/supervised_line.py",
        old="if self._standstill is not standstill:",
        new="if self._standstill is self:",
        test="tests/engine/beam/test_heartbeat_drill.py::"
        "test_a_hold_between_beginning_a_repeated_permit_and_sending_it_is_seen",
    ),
    Planted(
        what="clinical mode opens a camera that cannot be compared",
        file="service/engine_host/site_limits/calibrations.py",
        old="if warning is not None:\n        raise",
        new='if warning is not None and warning.code == "camera_mismatch":\n        raise',
        test="tests/service/engine_host/site_limits/test_camera_serial.py::"
        "test_clinical_mode_refuses_a_camera_that_cannot_be_compared",
    ),
    Planted(
        what="a machine of the identity provider is there for ever",
        file="service/access/request/authenticator.py",
        old="return until is not None and self._store.now() < until",
        new="return until is not None",
        test="tests/service/access/test_armed_operator.py::"
        "test_a_machine_of_the_identity_provider_is_there_until_its_newest_token_expires",
    ),
    Planted(
        what="a permit on its way renews a lease that has lapsed",
        file="engine/beam/deadman.py",
        old="            self._has_lapsed = True",
        new="            return False",
        test="tests/engine/beam/test_deadman.py::test_a_permit_asked_for_before_the_lapse_and_taken_after_it_changes_nothing",
    ),
)


def copied(folder: Path) -> Path:
    """Copy what the tests need; return the folder."""
    for name in COPIED:
        source = ROOT / name
        ignored = shutil.ignore_patterns("__pycache__", "*.pyc", "data")
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=ignored)
        elif source.exists():
            shutil.copy2(source, folder / name)
    return folder


def outcome_of(one: Planted, copy: Path) -> str:
    """Break one mechanism, run its test, mend it; return ``fails``, ``PASSES``, or ``NOT RUN`` with a broken file."""
    place = copy / one.file
    whole = place.read_text(encoding="utf-8")
    place.write_text(broken(one, whole), encoding="utf-8")
    try:
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", one.test]
        run = subprocess.run(command, cwd=copy, capture_output=True, timeout=TIMEOUT_S, check=False)
    finally:
        place.write_text(whole, encoding="utf-8")
    return {0: "PASSES", 1: "fails"}.get(run.returncode, "NOT RUN")


def broken(one: Planted, whole: str) -> str:
    """Return a file with the mechanism broken; raise ValueError where it is not there."""
    if one.old not in whole:
        raise ValueError(f"{one.file} no longer has what is broken there: {one.old}")
    return whole.replace(one.old, one.new, 1)
