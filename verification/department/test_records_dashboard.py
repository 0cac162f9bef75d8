"""Grafana's dashboard of records: its queries are asked of a real copy, by an account that reads. No Grafana."""

import json
from contextlib import closing
from datetime import UTC, datetime

import pytest
import yaml
from sqlalchemy import insert, text

from service.storage.database.base import Base
from service.storage.database.engine import Database
from tests.support.audit.rows import ROWS, fill
from tests.support.database.rows import add_rows
from tests.support.department.replication import execute
from tests.support.repository import ROOT

GRAFANA = ROOT / "docker/department/grafana"
DASHBOARD = json.loads((GRAFANA / "tidegate-records.json").read_text(encoding="utf-8"))
BEGAN = datetime(2026, 11, 23, 7, tzinfo=UTC)
QUERIES = {panel["title"]: target["rawSql"] for panel in DASHBOARD["panels"] for target in panel["targets"]}


@pytest.fixture
def asked(followed):
    """Ask the copy, as Grafana's account, with a patient's reference as Grafana quotes it."""
    fill(followed.database, 4)
    with followed.database.write() as db:
        add_rows(db.connection(), but=("audit", "qa_runs", "qa_outcomes", "qa_results"))
        run = ROWS["qa_runs"] | {"is_simulated": False, "is_simulated_beam": False, "created_at": BEGAN}
        db.execute(insert(Base.metadata.tables["qa_runs"]).values(run))
        db.execute(text("UPDATE sessions SET patient_reference = 'O''Hara', is_simulated_beam = false"))
    followed.follow()
    followed.arrive()
    execute(followed.hub, "postgres", "CREATE ROLE grafana LOGIN PASSWORD 'g'", "GRANT tidegate_reader TO grafana")
    url = followed.hub.tcp_url(followed.hub_name, password="g").set(username="grafana")
    with closing(Database(url)) as database, database.connect() as connection:

        def ask(title, patient=""):
            quoted = "'" + patient.replace("'", "''") + "'"
            query = QUERIES[title].replace("${patient:sqlstring}", quoted).replace("%", "%%")
            rows = connection.exec_driver_sql(query)
            return [dict(row) for row in rows.mappings()]

        yield ask
    execute(followed.hub, "postgres", "DROP ROLE grafana")


def test_every_panel_s_query_is_answered_by_the_copy(asked):
    assert {title for title in QUERIES if asked(title)} == set(QUERIES) - {
        "Sessions of a patient",
        "Refused and failed",
    }


def test_a_patient_is_found_by_the_whole_reference_and_no_other_is_shown(asked):
    assert len(asked("Sessions of a patient", "O'Hara")) == 1
    assert asked("Sessions of a patient", "O'Har") == []
    assert asked("Sessions of a patient", "%") == []


def test_what_a_person_types_reaches_a_query_quoted_only():
    typed = [query for query in QUERIES.values() if "$" in query]
    assert [query.count("${patient:sqlstring}") for query in typed] == [1]
    assert [query.count("$") for query in typed] == [1]


def test_the_dashboard_asks_the_rooms_that_are_provisioned_over_tls_and_without_a_password_in_the_file():
    said = yaml.safe_load((GRAFANA / "provisioning/datasources/rooms.yaml").read_text(encoding="utf-8"))
    kinds = {panel["datasource"]["type"] for panel in DASHBOARD["panels"]}
    for source in said["datasources"]:
        assert {source["type"]} == kinds
        assert source["jsonData"]["sslmode"] == "verify-ca"
        assert source["secureJsonData"]["password"].startswith("$__file{/run/secrets/")
    assert len({source["jsonData"]["database"] for source in said["datasources"]}) == len(said["datasources"])
