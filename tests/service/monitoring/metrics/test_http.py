"""Requests are counted by their route's template: no one can make series by making up paths."""

import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.access.request.rules import RULES
from service.monitoring.metrics.registry import METHODS, OTHER_METHOD, RouteNames, method_of

pytestmark = pytest.mark.slow


def scrape(client, name):
    text = client.get("/metrics").text
    return {
        tuple(sorted(one.labels.items())): one.value
        for family in text_string_to_metric_families(text)
        for one in family.samples
        if one.name == name
    }


def routes(client):
    return {dict(labels)["route"] for labels in scrape(client, "tidegate_http_requests_total")}


def test_a_thousand_unknown_paths_are_one_series(client):
    for number in range(1_000):
        client.get(f"/nothing/{number}")
    assert {route for route in routes(client) if "nothing" in route} == set()
    found = scrape(client, "tidegate_http_requests_total")
    assert found[("method", "GET"), ("route", "unknown"), ("status", "404")] >= 1_000


def test_however_many_sessions_and_methods_there_are_the_series_are_few(client):
    before = len(scrape(client, "tidegate_http_requests_total"))
    for number in range(200):
        client.get(f"/api/v1/sessions/{number:032x}")
        client.request(f"MADE{number}", "/healthz")
    assert len(scrape(client, "tidegate_http_requests_total")) <= before + 2
    assert routes(client) <= {template for _, template in RULES} | {"page", "unknown"}


def test_an_answer_counts_once_with_its_status_and_its_time(client):
    labels = (("method", "POST"), ("route", "/api/v1/sessions"))
    status = (*labels, ("status", "415"))
    before = scrape(client, "tidegate_http_requests_total").get(status, 0.0)
    times = scrape(client, "tidegate_http_request_duration_seconds_count").get(labels, 0.0)
    client.post("/api/v1/sessions", content=b"x", headers={"Content-Type": "text/plain"})
    assert scrape(client, "tidegate_http_requests_total")[status] == before + 1.0
    assert scrape(client, "tidegate_http_request_duration_seconds_count")[labels] == times + 1.0


def test_what_is_under_way_is_counted_and_what_failed_is_not_left_over(client, monkeypatch):
    monkeypatch.setattr(client.app.state.services.health, "readiness", lambda: 1 / 0)
    client.get("/readyz")
    monkeypatch.undo()
    assert scrape(client, "tidegate_http_requests_in_progress") == {(): 1.0}  # the scrape itself
    with client.websocket_connect("/api/v1/live"):
        assert scrape(client, "tidegate_http_sockets_open") == {(): 1.0}


@pytest.mark.parametrize("path", ["/api/v1/sessions/x/../../metrics", "//metrics", "/metrics/", "/METRICS", "/%2e%2e"])
def test_a_path_that_only_looks_like_a_route_is_none(path):
    assert RouteNames(frozenset()).of(path) == "unknown"


def test_methods_are_those_there_are():
    assert method_of("http", "GET") == "GET"
    assert method_of("http", "BREW") == OTHER_METHOD
    assert method_of("websocket", "") in METHODS
