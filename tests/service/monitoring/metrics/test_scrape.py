"""What `/metrics` says can be read by everybody, and follows the conventions that dashboards rely on."""

import re

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as openmetrics_families

from engine.core.gate_state import GateState, HoldReason
from service.core.schemas.base import ReadinessCode
from tests.support.documents.metrics import DOCUMENT, MADE, described, families, sample_names, scraped
from tests.support.generated_sections import part_of

NAME = re.compile(r"(tidegate|process|python)_[a-z][a-z0-9_]*")
OTHER_UNITS = ("_ms", "_milliseconds", "_mb", "_kb", "_minutes", "_hours", "_percent", "_us", "_ns", "_mib")
OURS = "tidegate_"
MOST_SERIES = 1_000


def values(name):
    return {
        tuple(sorted(one.labels.items())): one.value
        for family in families()
        for one in family.samples
        if one.name == name
    }


def test_every_line_is_read_and_every_family_is_explained_once():
    names = [family.name for family in families()]
    assert len(names) == len(set(names))
    assert [family.name for family in families() if not family.documentation or family.type == "unknown"] == []


def test_names_are_lower_case_in_base_units_and_counters_end_in_total():
    for family in families():
        assert NAME.fullmatch(family.name), family.name
        assert not family.name.endswith(OTHER_UNITS), family.name
        is_counter = family.type == "counter"
        ends = {one.name.endswith("_total") for one in family.samples}
        assert ends == {is_counter}, family.name
        assert not family.name.endswith(("_count", "_sum", "_bucket")), family.name
        for one in family.samples:
            assert all(re.fullmatch(r"[a-z_]+", label) for label in one.labels), one
            assert "quantile" not in one.labels, "a summary's word"


def test_times_and_sizes_say_their_unit():
    for family in families():
        if family.type == "histogram":
            assert family.name.endswith("_seconds"), family.name
        if "memory" in family.name or "disk" in family.name:
            assert family.name.endswith("_bytes"), family.name


def test_histograms_rise_to_infinity():
    for family in families():
        if family.type != "histogram":
            continue
        series = {}
        for one in family.samples:
            if one.name.endswith("_bucket"):
                labels = tuple(sorted((name, value) for name, value in one.labels.items() if name != "le"))
                series.setdefault(labels, []).append((float(one.labels["le"]), one.value))
        for steps in series.values():
            assert steps == sorted(steps)
            assert [count for _, count in steps] == sorted(count for _, count in steps)
            assert steps[-1][0] == float("inf")


def test_there_are_not_too_many_series():
    assert sum(len(family.samples) for family in families()) < MOST_SERIES


def test_every_state_reason_and_code_is_there_from_the_start():
    assert {dict(labels)["state"] for labels in values("tidegate_gate_state")} == {one.value for one in GateState}
    assert {dict(labels)["reason"] for labels in values("tidegate_holds_total")} == {one.value for one in HoldReason}
    assert {dict(labels)["code"] for labels in values("tidegate_not_ready")} == {one.value for one in ReadinessCode}
    assert sum(values("tidegate_gate_state").values()) == 1.0


@pytest.mark.parametrize(
    "name",
    [
        "tidegate_decision_seconds_count",
        "tidegate_assertion_seconds_count",
        "tidegate_disk_free_bytes",
        "tidegate_database_size_bytes",
        "tidegate_audit_rows",
        "tidegate_ready",
        "tidegate_engine_process_resident_memory_bytes",
        "tidegate_engine_process_cpu_seconds_total",
        "tidegate_certificate_end_timestamp_seconds",
        "process_resident_memory_bytes",
        "process_open_fds",
        "tidegate_queue_capacity",
    ],
)
def test_what_somebody_watches_is_there_and_no_zero_by_mistake(name):
    assert name in sample_names()
    assert all(value > 0.0 for value in values(name).values())


def test_the_accelerator_s_signal_and_the_time_of_holds_are_figures():
    assert values("tidegate_accelerator_beam_on") == {(): 1.0}
    assert values("tidegate_beam_absent") == {(): 0.0}
    assert values("tidegate_beam_off_seconds") == {(("hold", "last"),): 0.045, (("hold", "slowest"),): 0.06}


def test_a_scrape_states_the_same_as_openmetrics(client):
    answer = client.get("/metrics", headers={"Accept": "application/openmetrics-text;version=1.0.0,text/plain;q=0.5"})
    assert answer.headers["content-type"].startswith("application/openmetrics-text; version=1.0.0")
    assert answer.text.endswith("# EOF\n")
    names = {family.name for family in openmetrics_families(answer.text)}
    assert {"tidegate_frames", "tidegate_ready", "tidegate_http_request_duration_seconds"} <= names
    plain = client.get("/metrics", headers={"Accept": "*/*"})
    assert plain.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"


def test_counts_of_refusals_have_words_of_ours_alone(client):
    client.app.state.access.refused_logins.count("made up by somebody", "127.0.0.1")
    text = client.get("/metrics").text
    assert "made up" not in text
    assert 'tidegate_refused_total{why="other"} 1.0' in text


def test_a_database_that_hangs_leaves_figures_out_and_the_scrape_goes_on(client, monkeypatch):
    machine = client.app.state.services.metrics.collectors[1]
    monkeypatch.setattr(machine._figures, "_cached", None)
    with machine._figures._reading:
        text = client.get("/metrics").text
    assert "tidegate_database_size_bytes" not in text
    assert "tidegate_disk_free_bytes" in text


def test_the_document_states_what_there_is():
    text = DOCUMENT.read_text(encoding="utf-8")
    assert {name: part_of(text, name) for name in MADE} == {name: make() for name, make in MADE.items()}


def test_the_document_names_every_code_of_the_readiness():
    text = DOCUMENT.read_text(encoding="utf-8")
    assert [code.value for code in ReadinessCode if f"`{code.value}`" not in text] == []


def test_every_event_has_a_text():
    assert [one.name for one in described() if len(one.words) < 8] == []
    assert "P-0001" not in scraped()
