"""Clinical mode: narrower bounds, and what is obligatory there, named all at once when it is missing."""

import dataclasses
import re

import pytest

from engine.gating.limits import LIMIT_BOUNDS
from service.core.schemas.windows import Window
from service.core.settings.clinical import CLINICAL_BOUNDS, EXEMPT, WINDOW_EXEMPT, WINDOW_NUMBERS, refusals
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings, SettingsError, load_settings
from tests.support.documents import clinical as document
from tests.support.generated_sections import are_as_made
from tests.support.service.clinical_site import CLINICAL, LINE, OBLIGATORY, clinical_settings, environment
from tests.support.site_settings import give_settings

pytestmark = pytest.mark.usefixtures("no_settings_around")

NOT_NARROWER = {
    "dwell_ms": "min_dwell_ms is its bound",
    "min_on_ms": "only shortens the beam's time",
    "max_beam_on_s": "at most 30 s in research too",
    "max_unwritten_ms": "at most a second in research too",
}
EDGES = [
    (name, edge, beyond)
    for name, bound in CLINICAL_BOUNDS.items()
    for edge, beyond in ((bound.low, bound.low - 0.01), (bound.high, bound.high + 0.01))
]


@pytest.fixture
def site(monkeypatch, tmp_path):
    def load(values):
        give_settings(monkeypatch, tmp_path, **environment(values))
        return load_settings()

    return load


def lines_of(settings):
    return refusals(settings, settings.holding_events)


def without(*names):
    return {name: value for name, value in CLINICAL.items() if name not in names}


def test_a_site_that_has_all_of_it_starts(site):
    assert lines_of(site(CLINICAL)) == ()


def test_all_that_is_missing_is_named_at_once(site):
    with pytest.raises(SettingsError) as refusal:
        site({"mode": "clinical", "recordings_may_gate": True})
    lines = str(refusal.value).splitlines()
    assert all(line.startswith("TIDEGATE_MODE is clinical: ") for line in lines)
    named = {
        name
        for name in OBLIGATORY | {"beam_line": 0, "recordings_may_gate": 0}
        if f"{setting_name(name)} is" in str(refusal.value)
    }
    assert named == OBLIGATORY.keys() | {"beam_line", "recordings_may_gate"}
    assert sum("TIDEGATE_HARDWARE_DEAD_MAN=true" in line for line in lines) == 1
    assert len(lines) == len(named) + 1


@pytest.mark.parametrize("name", OBLIGATORY)
def test_each_thing_that_is_missing_is_named_alone(site, name):
    with pytest.raises(SettingsError) as refusal:
        site(without(name))
    (line,) = str(refusal.value).splitlines()
    default = Settings.model_fields[name].default
    value = str(default).lower() if isinstance(default, bool) else f"{default:g}"
    assert line.startswith(f"TIDEGATE_MODE is clinical: {setting_name(name)} is {value}")
    if name in CLINICAL_BOUNDS:
        assert CLINICAL_BOUNDS[name].text in line


@pytest.mark.parametrize(
    ("events", "named"),
    [
        ("cough,apnoea", "no_cycle"),
        ("no_cycle", "apnoea"),
        ("", "apnoea and no_cycle"),
        ("no_cycle,drift,apnoea", None),
    ],
)
def test_the_beam_is_held_where_breathing_has_ceased(site, events, named):
    """By default it is; a site may only add events."""
    if named is None:
        assert site(CLINICAL | {"holding_events": events}).holding_events == ("no_cycle", "drift", "apnoea")
        return
    with pytest.raises(SettingsError, match=f"TIDEGATE_HOLDING_EVENTS lacks {named}:") as refusal:
        site(CLINICAL | {"holding_events": events})
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.parametrize(("name", "edge", "beyond"), EDGES, ids=lambda value: f"{value}")
def test_a_bound_holds_at_its_edge_and_is_named_beyond(name, edge, beyond):
    """By `refusals` alone: other rules between two settings are elsewhere."""
    good = clinical_settings()
    assert lines_of(good.model_copy(update={name: edge})) == ()
    (line,) = lines_of(good.model_copy(update={name: beyond}))
    assert f"{setting_name(name)} is {beyond:g}: must be {CLINICAL_BOUNDS[name].text}" in line


@pytest.mark.parametrize(
    "wide",
    [
        {"max_shift_mm": 100.0, "max_turn_deg": 45.0, "max_residual_mm": 20.0, "min_valid_share": 0.1},
        {"max_jump_mm": 20.0, "max_baseline_correction_mm": 50.0, "max_height_mm": 50.0},
        {"likeness_max_shift_mm": 200.0, "likeness_max_tilt_deg": 45.0, "likeness_max_shape_mm": 30.0},
        {"window_lower_mm": -100.0, "window_upper_mm": 100.0},
    ],
    ids="+".join,
)
def test_what_research_may_choose_is_refused_together_and_research_takes_it(site, wide):
    assert Settings(**wide)
    with pytest.raises(SettingsError) as refusal:
        site(CLINICAL | wide)
    named = {line.split()[3] for line in str(refusal.value).splitlines()}
    assert named == {setting_name(name) for name in wide}


def test_every_limit_has_a_clinical_bound_or_a_reason_for_none():
    limits = LIMIT_BOUNDS.keys() | {name for name in Settings.model_fields if name.startswith("likeness_")}
    assert limits == (CLINICAL_BOUNDS.keys() & limits) | NOT_NARROWER.keys()
    assert not CLINICAL_BOUNDS.keys() & NOT_NARROWER.keys()


@pytest.mark.parametrize("name", CLINICAL_BOUNDS)
def test_a_clinical_bound_is_within_the_research_one_narrower_and_has_a_reason(name):
    bound = CLINICAL_BOUNDS[name]
    found = Settings.model_fields[name].metadata
    low = next(one.ge for one in found if hasattr(one, "ge"))
    high = next(one.le for one in found if hasattr(one, "le"))
    assert low <= bound.low < bound.high <= high
    assert (low, high) != (bound.low, bound.high)
    assert bound.reason


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ({**LINE, "hardware_dead_man": False}, ["TIDEGATE_BEAM_LINE_2, or", "TIDEGATE_HARDWARE_DEAD_MAN=true"]),
        (
            {"beam_line": "serial-relay", "beam_relay_device": "/dev/ttyUSB1", "hardware_dead_man": True},
            ["beam.relay_heartbeat_channel"],
        ),
    ],
    ids=["one line", "relay alone"],
)
def test_a_line_that_has_no_second_way_off_is_refused(site, line, said):
    with pytest.raises(SettingsError) as refusal:
        site(without(*LINE) | line)
    (only,) = str(refusal.value).splitlines()
    assert all(words in only for words in said)


def test_two_lines_need_no_declaration(site):
    second = {"beam_line_2": "serial-relay", "beam_relay_device": "/dev/ttyUSB1", "hardware_dead_man": False}
    assert site(CLINICAL | second).hardware_dead_man is False


def test_a_dead_man_of_a_simulated_line_is_refused(site):
    with pytest.raises(SettingsError, match="TIDEGATE_HARDWARE_DEAD_MAN is true, but"):
        site({"hardware_dead_man": True})


def test_the_page_of_the_handbook_has_the_table():
    assert are_as_made(document.DOCUMENT, document.MADE), "run `python -m tests.support.documents.clinical --write`"


def test_a_bound_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        CLINICAL_BOUNDS["max_shift_mm"].high = 100.0


def numbers(model):
    """The names of a model's fields that are numbers, also where they may be left out."""
    kinds = {name: str(field.annotation) for name, field in model.model_fields.items()}
    return {name for name, kind in kinds.items() if re.search(r"\b(int|float)\b", kind)}


def exempt(name):
    return [one for one in EXEMPT if one == name or (one.endswith("_") and name.startswith(one))]


def test_every_number_of_the_settings_has_a_clinical_bound_or_a_reason_for_none():
    found = numbers(Settings)
    assert len(found) > 90
    bounded = found & CLINICAL_BOUNDS.keys()
    assert {name: exempt(name) for name in found - bounded if len(exempt(name)) != 1} == {}
    assert [name for name in bounded if exempt(name) and name not in BOTH] == []
    assert [one for one in EXEMPT if not any(one in exempt(name) for name in found)] == []


BOTH = {"qa_required_daily_h", "qa_latency_max_age_days"}
"""Settings of QA that decide about arming, unlike its tolerances."""


def test_every_number_of_a_window_is_bounded_by_the_site_or_has_a_reason_for_none():
    found = numbers(Window)
    assert found == WINDOW_NUMBERS.keys() | WINDOW_EXEMPT.keys()
    assert not WINDOW_NUMBERS.keys() & WINDOW_EXEMPT.keys()
    assert set(WINDOW_NUMBERS.values()) <= CLINICAL_BOUNDS.keys()
