"""The dashboard and the alerts ask for metrics that there are, by labels that they have."""

import itertools
import json
import re

import yaml

from engine.core.gate_state import GateState
from service.core.schemas.base import ReadinessCode
from tests.support.documents.metrics import families, sample_names
from tests.support.repository import ROOT

DASHBOARD = ROOT / "docker" / "department" / "grafana" / "tidegate.json"
RULES = ROOT / "docker" / "department" / "prometheus" / "tidegate.rules.yml"
SCRAPE = ROOT / "docker" / "department" / "prometheus" / "prometheus.yml"
WORDS = re.compile(r"[a-zA-Z_:][a-zA-Z0-9_:]*")
STRINGS = re.compile(r'"[^"]*"')
SELECTOR = re.compile(r"([a-zA-Z_:][a-zA-Z0-9_:]*)\s*\{([^}]*)\}")
MATCHER = re.compile(r'([a-zA-Z_]+)\s*(?:=~|!~|!=|=)\s*"([^"]*)"')
LANGUAGE = frozenset(
    [
        *("histogram_quantile", "sum", "rate", "increase", "avg_over_time", "by"),
        *("le", "topk", "sort_desc", "time", "on", "and"),
    ]
)
OF_THE_SCRAPE = frozenset({"instance", "job", "room", "up"})
COLUMNS = 24


def dashboard():
    return json.loads(DASHBOARD.read_text(encoding="utf-8"))


def panels():
    return [panel for panel in dashboard()["panels"] if panel["type"] != "row"]


def alerts():
    groups = yaml.safe_load(RULES.read_text(encoding="utf-8"))["groups"]
    return [rule for group in groups for rule in group["rules"]]


def expressions():
    asked = [(panel["title"], target["expr"]) for panel in panels() for target in panel["targets"]]
    asked += [(one["name"], one["expr"]) for one in dashboard()["annotations"]["list"]]
    return asked + [(rule["alert"], rule["expr"]) for rule in alerts()]


def labels_of():
    found = {}
    for family in families():
        for one in family.samples:
            found.setdefault(one.name, set()).update(one.labels)
    return found


def test_every_expression_asks_for_metrics_that_there_are(subtests):
    for where, expression in expressions():
        with subtests.test(f"{where}: {expression}"):
            check_metrics_of(where, expression)


def check_metrics_of(where, expression):
    assert expression.count("(") == expression.count(")")
    plain = re.sub(r"\[[^\]]*\]", "", STRINGS.sub('""', expression)).replace("$__range", "")
    groups = {label for inside in re.findall(r"(?:by|on)\s*\(([^)]*)\)", plain) for label in WORDS.findall(inside)}
    inside = {label for _, matchers in SELECTOR.findall(plain) for label in WORDS.findall(matchers)}
    names = {word for word in WORDS.findall(plain) if not word[0].isdigit()} - LANGUAGE - groups - inside
    numbers = {name for name in names if re.fullmatch(r"e\d+", name)}
    assert names - numbers - OF_THE_SCRAPE <= sample_names(), where
    assert names & sample_names() or "up" in names, where


def test_every_label_is_one_that_the_metric_has(subtests):
    known = labels_of()
    for where, expression in expressions():
        with subtests.test(f"{where}: {expression}"):
            check_labels_of(where, expression, known)


def check_labels_of(where, expression, known):
    values = {"state": {one.value for one in GateState} | {"lost", "measuring", "training"}}
    values["code"] = {one.value for one in ReadinessCode}
    for name, matchers in SELECTOR.findall(expression):
        for label, value in MATCHER.findall(matchers):
            assert label in known.get(name, set()) | OF_THE_SCRAPE, (where, name, label)
            if label in values:
                assert value in values[label], (where, value)


def test_the_dashboard_is_one_that_grafana_takes():
    said = dashboard()
    assert {"uid", "title", "schemaVersion", "panels", "templating", "time"} <= said.keys()
    ids = [panel["id"] for panel in said["panels"]]
    assert len(ids) == len(set(ids))
    for panel in said["panels"]:
        place = panel["gridPos"]
        assert place["w"] + place["x"] <= COLUMNS
    for panel in panels():
        assert panel["title"]
        assert panel["targets"]
        assert panel["datasource"]["uid"] == "prometheus"
        references = [target["refId"] for target in panel["targets"]]
        assert len(references) == len(set(references))


def test_no_two_panels_lie_on_each_other():
    taken = set()
    for panel in dashboard()["panels"]:
        place = panel["gridPos"]
        columns, rows = (range(place[at], place[at] + place[size]) for at, size in (("x", "w"), ("y", "h")))
        mine = set(itertools.product(columns, rows))
        assert not taken & mine, panel["title"]
        taken |= mine


def test_every_panel_is_of_the_chosen_service_alone():
    for panel in panels():
        for target in panel["targets"]:
            for name, matchers in SELECTOR.findall(target["expr"]):
                assert "$instance" in matchers, (panel["title"], name)
            bare = SELECTOR.sub("", target["expr"])
            assert not re.search(r"(tidegate|process)_", bare), panel["title"]


def test_every_alert_states_how_bad_it_is_and_what_it_is():
    names = [rule["alert"] for rule in alerts()]
    assert len(names) == len(set(names))
    for rule in alerts():
        assert rule["labels"]["severity"] in {"critical", "warning", "info"}
        assert len(rule["annotations"]["summary"]) > 20


def test_what_was_asked_for_is_alerted_of():
    asked = " ".join(rule["expr"] for rule in alerts())
    for name in (
        "tidegate_gate_state",
        "tidegate_missed_frames_total",
        "tidegate_decision_seconds_bucket",
        "tidegate_disk_free_bytes",
        "tidegate_not_ready",
        "tidegate_engine_processes_lost_total",
        "tidegate_certificate_end_timestamp_seconds",
        "tidegate_replication_active",
        "tidegate_replication_lost",
        "tidegate_replication_limit_bytes",
        "up",
    ):
        assert name in asked


def test_the_scrape_asks_with_a_key_and_for_the_rules_that_there_are():
    said = yaml.safe_load(SCRAPE.read_text(encoding="utf-8"))
    assert said["rule_files"] == [RULES.name]
    for job in said["scrape_configs"]:
        assert job["authorization"]["type"] == "Bearer"
        assert "credentials" not in job["authorization"]


def test_every_alert_names_the_room_and_none_asks_for_a_job():
    for rule in alerts():
        assert "$labels.room" in rule["annotations"]["summary"], rule["alert"]
        assert "job=" not in rule["expr"], rule["alert"]
