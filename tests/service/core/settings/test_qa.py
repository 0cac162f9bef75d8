"""The site's bounds of QA: real settings, made from the table of checks, bounded, and refused by name."""

import pytest

from engine.qa.checks import CHECKS
from service.core.settings.settings import SettingsError, load_settings
from tests.support.site_settings import give_settings

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_settings_around")]

BOUNDS = [(check, bound) for check in CHECKS for bound in ("warn", "fail")]


def variable(check, bound):
    return f"qa.{check.code}_{bound}"


def test_without_a_word_of_the_site_the_table_s_bounds_hold():
    bounds = load_settings().qa_bounds
    for check in CHECKS:
        assert (bounds.of(check.code).warn, bounds.of(check.code).fail) == (check.warn, check.fail)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.code)
def test_a_site_chooses_both_bounds_of_every_check(monkeypatch, tmp_path, check):
    give_settings(
        monkeypatch,
        tmp_path,
        **{f"qa_{check.code}_warn": check.most / 4, f"qa_{check.code}_fail": check.most / 2},
    )
    bound = load_settings().qa_bounds.of(check.code)
    assert (bound.warn, bound.fail) == pytest.approx((check.most / 4, check.most / 2))


@pytest.mark.parametrize("what", ["too wide", "negative", "nan", "inf", "a word"])
def test_a_bound_beyond_what_the_check_allows_is_refused_by_name(what, subtests, tmp_path):
    for check, bound in BOUNDS:
        value = {"too wide": str(check.most * 1.01 + 0.01), "negative": "-0.1"}.get(what, what)
        with subtests.test(variable(check, bound)), pytest.MonkeyPatch.context() as environment:
            folder = tmp_path / variable(check, bound)
            give_settings(environment, folder, **{f"qa_{check.code}_{bound}": value})
            with pytest.raises(SettingsError, match=variable(check, bound)):
                load_settings()


def test_a_warning_that_comes_after_the_failure_is_refused_by_both_names(monkeypatch, tmp_path):
    give_settings(monkeypatch, tmp_path, qa_camera_distance_mm_warn=2, qa_camera_distance_mm_fail=1.5)
    with pytest.raises(SettingsError, match=r"qa.camera_distance_mm_warn is 2.0: must be at most .*_fail \(1.5\)"):
        load_settings()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("TIDEGATE_QA_CAMERA_DISTANCE_WARN", "1"),
        ("TIDEGATE_QA_REQUIRED_DAILY", "24"),
        ("TIDEGATE_QA_REQUIRED_DAILY_H", "-1"),
        ("TIDEGATE_QA_REQUIRED_DAILY_H", "745"),
        ("TIDEGATE_SITE_NAME", "a\nb"),
        ("TIDEGATE_MACHINE_NAME", "x" * 81),
    ],
)
def test_a_mistyped_name_and_a_value_out_of_its_bound_are_refused_by_name(monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    with pytest.raises(SettingsError, match=name):
        load_settings()
