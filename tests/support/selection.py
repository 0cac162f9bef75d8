"""The order of the tests, and which of them `make check` runs (`pytest --fast`).

A test is slow by its folder or file (below), by a fixture that needs a system package or a recording, by running on
PostgreSQL, or by the mark ``slow``. A new test is fast until one of these says otherwise; `make check` prints its
slowest ten, so that one which does not belong there is seen.
"""

from functools import cache
from pathlib import Path

import pytest

from tests.support.repository import ROOT

LONGEST = tuple(
    f"tests/{name}.py"
    for name in (
        "campaigns/contract/test_schemathesis",
        "campaigns/faults/test_short_campaign",
        "system/engine_process/test_service",
        "system/client/test_whole_fractions",
        "campaigns/kills/test_short_campaign",
        "service/cli/test_measure",
        "system/service/test_replayed_sessions",
        "engine/motion/learning/test_reference_history",
        "engine/verification/qa/test_run",
        "campaigns/fuzz/test_short_run",
        "engine/verification/performance/test_performance_bench",
        "engine/verification/evaluation/runs/test_bench",
        "engine/verification/phantom/test_recording",
        "service/cli/test_qa",
        "engine/motion/learning/test_refit",
        "engine/motion/learning/test_confirmed_references",
        "service/web/api/test_qa",
        "system/service/test_process",
        "system/client/test_real_service",
        "service/storage/backup/test_backup",
    )
)
"""A file is run by one process (``--dist loadfile``): if one of these begins last, every other process waits for it.

The campaigns of kills and of faults begin with a session that one of them learns: the one goes on with another file
meanwhile."""

LAST = "tests/system/browser/"
"""Run by `make test` after what judges times: Chromium has a session of its own, and with it a share of the processors
beside whatever runs in front."""

SLOW_PATHS = tuple(
    f"tests/{name}"
    for name in (
        "campaigns",
        "engine/calibration/formats/test_convert.py",
        "engine/calibration/procedures/test_boards.py",
        "engine/calibration/procedures/test_flat_plate.py",
        "engine/calibration/procedures/test_stereo_pair.py",
        "engine/capture/oni/test_codec.py",
        "engine/capture/oni/test_damage.py",
        "engine/capture/oni/test_reader.py",
        "engine/capture/openni",
        "engine/capture/test_recorder.py",
        "engine/control/test_loop_machine.py",
        "engine/gating/supervision/test_patient_shift.py",
        "engine/gating/test_switching.py",
        "engine/gating/windows/test_window_properties.py",
        "engine/motion/breathing/test_any_input.py",
        "engine/motion/breathing/test_events.py",
        "engine/motion/breathing/test_monitor.py",
        "engine/motion/breathing/test_phase_and_position.py",
        "engine/motion/learning/test_fitting.py",
        "engine/motion/learning/test_learner.py",
        "engine/motion/learning/test_learner_camera_returned.py",
        "engine/motion/learning/test_model_file.py",
        "engine/motion/learning/test_trainer.py",
        "engine/motion/stages/test_motion.py",
        "engine/motion/test_any_picture.py",
        "engine/motion/test_pipeline.py",
        "engine/motion/test_pipeline_camera_returned.py",
        "engine/motion/test_pipeline_models.py",
        "engine/motion/test_pipeline_motion.py",
        "engine/motion/tracking/test_breath_tracker.py",
        "engine/offline/replay/test_scripted_tape.py",
        "engine/verification/evaluation/breathing/test_breathing_bench.py",
        "engine/verification/evaluation/gating/test_timing.py",
        "engine/verification/evaluation/instruments/test_laser.py",
        "engine/verification/evaluation/instruments/test_plane_calibration.py",
        "engine/verification/evaluation/integrity/test_integrity_session.py",
        "engine/verification/evaluation/methods/test_plain.py",
        "engine/verification/evaluation/report/test_report.py",
        "engine/verification/evaluation/runs/test_bench.py",
        "engine/verification/performance/test_performance_bench.py",
        "engine/verification/phantom/test_costal.py",
        "engine/verification/phantom/test_falsifications.py",
        "engine/verification/phantom/test_laser.py",
        "engine/verification/phantom/test_recording.py",
        "engine/verification/phantom/test_sensor.py",
        "engine/verification/phantom/test_truth.py",
        "engine/verification/phantom/test_variations.py",
        "engine/verification/qa/test_phantom.py",
        "engine/verification/qa/test_plate.py",
        "engine/verification/qa/test_run.py",
        "engine/verification/qa/test_sine.py",
        "service/access/oidc/test_http_client.py",
        "service/access/oidc/test_login.py",
        "service/access/oidc/test_people.py",
        "service/access/request/test_claimed_operator.py",
        "service/access/test_armed_operator.py",
        "service/access/test_role_matrix.py",
        "service/cli/test_beam_line.py",
        "service/cli/test_calibrate.py",
        "service/cli/test_data_folder.py",
        "service/cli/test_database_and_backup.py",
        "service/cli/test_measure.py",
        "service/cli/test_measure_many.py",
        "service/cli/test_measure_stored_model.py",
        "service/cli/test_qa.py",
        "service/cli/test_recordings.py",
        "service/cli/test_serve.py",
        "service/cli/test_users_and_keys.py",
        "service/core/settings/test_database_place.py",
        "service/core/settings/test_qa.py",
        "service/engine_host/process",
        "service/engine_host/site_rules/test_uncalibrated.py",
        "service/monitoring/metrics/test_http.py",
        "service/planning/rt_plan/test_damage.py",
        "service/planning/rt_plan/test_import.py",
        "service/planning/rt_plan/test_planned_sessions.py",
        "service/qa/report/test_report.py",
        "service/qa/test_real_run.py",
        "service/sessions/lifecycle/test_runner.py",
        "service/sessions/lifecycle/test_writer.py",
        "service/sessions/recovery/test_interrupted.py",
        "service/sessions/recovery/test_journal.py",
        "service/storage/audit/test_log_file.py",
        "service/storage/backup/test_backup.py",
        "service/storage/database/test_lost_answers.py",
        "service/storage/database/test_lost_server.py",
        "service/storage/database/test_migrations.py",
        "service/storage/samples/test_export.py",
        "service/storage/samples/test_stream.py",
        "service/web/api/test_audit.py",
        "service/web/api/test_calibrations.py",
        "service/web/api/test_conditional_requests.py",
        "service/web/api/test_lists.py",
        "service/web/api/test_models.py",
        "service/web/api/test_qa.py",
        "service/web/api/test_regions.py",
        "service/web/api/test_sessions.py",
        "service/web/api/test_windows.py",
        "service/web/middleware/test_reserved_threads.py",
        "service/web/openapi/test_breaking_changes.py",
        "service/web/problems/test_problems.py",
        "service/web/stream/test_over_tls.py",
        "service/web/stream/test_query.py",
        "service/web/stream/test_resume.py",
        "service/web/stream/test_server_sent_events.py",
        "service/web/stream/test_slow_clients.py",
        "system",
    )
)
"""Folders and files that `make check` leaves out: they need a system package (pdftotext, rsyslogd, OpenNI2, a browser),
or take more than two seconds, so that the rest fits into two minutes. Longer ones stay where they are a package's most
important. tests/test_structure.py holds that each package keeps some."""

STORAGE = "tests/service/storage/"

SLOW_FIXTURES = frozenset(
    {
        "postgres_server",
        "own_postgres_server",
        "regular_volunteer",
        "dibh_volunteer",
        "occlusion_volunteer",
        "lit_volunteer",
    }
)
"""A PostgreSQL server is a system package; a recording takes ten seconds to make on a fresh machine."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--fast`` and ``--leave-out``."""
    parser.addoption("--fast", action="store_true", help="only the fast tests, which need no system package")
    parser.addoption(
        "--leave-out",
        default="",
        metavar="PATH,...",
        help="as --ignore, which compares each file with each path: with 150 paths, half of the time of collecting",
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import what ``--fast`` would not run, or another part of `make test` runs."""
    if collection_path in _left_out(config.getoption("--leave-out")):
        return True
    if config.getoption("--fast") and any(collection_path == ROOT / path for path in SLOW_PATHS):
        return True
    return None


@cache
def _left_out(paths: str) -> frozenset[Path]:
    return frozenset(ROOT / path for path in paths.split(",") if path)


def is_slow(item: pytest.Item) -> bool:
    """Whether ``--fast`` leaves this test out."""
    callspec = getattr(item, "callspec", None)
    return (
        item.get_closest_marker("slow") is not None
        or not SLOW_FIXTURES.isdisjoint(getattr(item, "fixturenames", ()))
        or (callspec is not None and callspec.params.get("database_kind") == "postgresql")
    )


def _further_cases_on_postgresql(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return what a second case on PostgreSQL would not find: a rule's values are in no statement of its own.

    Each test that runs on both databases runs there once, with its first case. In the storage package, where the cases
    are statements and damages, all of them do.
    """
    seen: set[str] = set()
    further = []
    for item in items:
        test, _, case = item.nodeid.partition("[")
        if "postgresql" not in case or item.get_closest_marker("both_databases") is None:
            continue
        if test in seen and not test.startswith(STORAGE):
            further.append(item)
        seen.add(test)
    return further


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the longest files, end with the browser; leave out slow tests for ``--fast``."""
    further = _further_cases_on_postgresql(items)
    config.hook.pytest_deselected(items=further)
    left = set(items).difference(further)
    items[:] = [item for item in items if item in left]
    if config.getoption("--fast"):
        slow = [item for item in items if is_slow(item)]
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if not is_slow(item)]
    turn = {path: number for number, path in enumerate(LONGEST)}

    def place(item: pytest.Item) -> tuple[bool, int]:
        path = item.nodeid.partition("::")[0]
        return path.startswith(LAST), turn.get(path, len(turn))

    items.sort(key=place)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run what is marked so on SQLite and on PostgreSQL."""
    if metafunc.definition.get_closest_marker("both_databases") and "database_kind" in metafunc.fixturenames:
        metafunc.parametrize("database_kind", ["sqlite", "postgresql"], indirect=True)
