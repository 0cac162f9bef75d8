"""The documentation as a site: built strictly, complete, searchable and without a network."""

import inspect
import json
import re
import shutil
import subprocess
import sys

import pytest
from starlette.testclient import TestClient

import tidegate
from service.core.settings.settings import Settings
from service.web import app
from tests.support.repository import ROOT

pytestmark = pytest.mark.verification


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-n", "-W", "--keep-going", "-b", "html", ROOT / "docs", out]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (built.returncode, built.stderr) == (0, ""), built.stderr
    return out


def test_every_document_is_a_page_that_the_contents_lead_to(site):
    pages = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    assert {path for path in pages if not (site / path).exists()} == set()
    index = (site / "README.html").read_text()
    assert {str(path) for path in pages if f'href="{path}"' not in index and path.name != "README.html"} == set()


def test_what_the_code_states_is_there(site):
    rest = (site / "4-integrate/rest.html").read_text()
    document = json.loads((ROOT / "openapi/openapi.json").read_text())
    ours = [path for path in document["paths"] if f" {path}<" not in rest]
    assert ours == []
    python = (site / "4-integrate/python.html").read_text()
    names = set(tidegate.__all__) - {"__version__"}
    assert {name for name in names if f'id="tidegate.{name}"' not in python} == set()
    settings = (site / "3-operate/settings.html").read_text()
    assert settings.count("<tr") > len(Settings.model_fields)


def test_nothing_is_loaded_from_elsewhere_and_search_is_local(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        assert re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(?:https?:)?//', text) == [], page
    assert "dwell" in (site / "searchindex.js").read_text()


def test_where_it_was_built_in_the_service_serves_it_to_everybody(site, tmp_path, monkeypatch):
    page = tmp_path / "dashboard"
    shutil.copytree(app.DASHBOARD, page)
    settings = Settings(data_dir=tmp_path / "data", allowed_hosts=("testserver",))
    monkeypatch.setattr(app, "DASHBOARD", page)
    monkeypatch.setattr(app, "_page_files", inspect.unwrap(app._page_files))  # otherwise listed once per process
    without = TestClient(app.create_app(settings))
    assert without.get("/lang/index.json").json()["has_docs"] is False
    shutil.copytree(site, page / "docs")
    shutil.copy(site / "README.html", page / "docs/index.html")
    client = TestClient(app.create_app(settings))
    assert client.get("/lang/index.json").json()["has_docs"] is True
    answer = client.get("/docs")
    assert (answer.status_code, "<h1>Documentation" in answer.text) == (200, True)
    policy = answer.headers["Content-Security-Policy"]
    assert "style-src 'self' 'unsafe-inline'" in policy
    assert "script-src" not in policy  # as everywhere: the service's own files alone
    assert client.get("/docs/2-clinical/safety.html").status_code == 200
    assert "unsafe-inline" not in client.get("/").headers["Content-Security-Policy"]
