"""An address without anything answers a browser with a page and a program with a problem."""

import pytest
from starlette.testclient import TestClient

from service.core.settings.settings import Settings
from service.web.app import create_app

BROWSER = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}


@pytest.fixture
def client(tmp_path):
    with TestClient(create_app(Settings(data_dir=tmp_path, allowed_hosts=("testserver",)))) as client:
        yield client


@pytest.mark.parametrize("path", ["/nothing", "/offices/", "/patient/x", "/css/none.css", "/metrics/more"])
def test_a_browser_gets_a_page_that_leads_back(client, path):
    answer = client.get(path, headers=BROWSER)
    assert answer.status_code == 404
    assert answer.headers["content-type"].startswith("text/html")
    assert answer.headers["cache-control"] == "no-store"
    assert "nothing.heading" in answer.text
    assert path not in answer.text, "what was asked for is not repeated"


@pytest.mark.parametrize(
    ("path", "headers"),
    [("/nothing", {}), ("/api/v1/none", BROWSER), ("/api/v1/sessions", BROWSER), ("/metrics", BROWSER)],
)
def test_a_program_and_every_call_get_a_problem(client, path, headers):
    answer = client.get(path, headers=headers)
    assert answer.status_code == 401
    assert answer.headers["content-type"] == "application/problem+json"


def test_only_reading_gets_the_page(client):
    assert client.post("/nothing", headers=BROWSER).headers["content-type"] == "application/problem+json"
