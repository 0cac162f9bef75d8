"""Regions of a session: validated, passed to the engine, streamed, exported, and the surface as a mesh."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import NODE_COLUMNS, NODE_ROWS, PhaseLag
from engine.motion.settings import PipelineSettings
from service.core.schemas import sessions
from service.engine_host.site_limits.window_limits import measuring_with
from tests.support.service import fake_engine
from tests.support.service.api_calls import act, audit_rows, make_session_body
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

URL = "/api/v1/sessions"
BELLY = {"name": "belly", "vertices": [[220.0, 40.0], [220.0, 160.0], [320.0, 100.0]]}
CHEST = {"name": "chest", "vertices": [[40.0, 40.0], [40.0, 160.0], [120.0, 100.0]]}
REGIONS = {"named": [BELLY, CHEST], "split": {"right_row": 150.0, "left_row": 165.5}, "extra_markers": True}
LAG = PhaseLag(first="thorax", second="abdomen", lag_s=0.13, lag_deg=12.0, period_s=3.9, confidence=0.99)
UNREPORTED = PhaseLag(first="belly", second="whole", note="too little seen yet")


@pytest.fixture
def session_body(calibration_id):
    return make_session_body(calibration_id) | {"regions": REGIONS}


@pytest.fixture
def moving(monkeypatch):
    """Let the fake engine measure two named regions, a surface and lags."""
    plain = fake_engine.make_motion
    x, y = np.meshgrid(np.linspace(-80.0, 80.0, NODE_COLUMNS), np.linspace(-150.0, 150.0, NODE_ROWS))
    surface = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 850.1234567)])

    def motion(whole_mm=1.5):
        return replace(
            plain(whole_mm),
            named_mm=np.array([2.5, np.nan]),
            lags=(LAG, UNREPORTED),
            surface_mm=surface,
            split_rows=(150.0, 165.5),
        )

    monkeypatch.setattr(fake_engine, "make_motion", motion)


def test_a_session_keeps_its_regions_and_the_engine_gets_them(client, session_id, running):
    assert client.get(f"{URL}/{session_id}").json()["regions"] == REGIONS
    assert running.plan.regions.model_dump() == REGIONS
    assert audit_rows(client, "session.create")[-1]["detail"]["regions"] == REGIONS


def test_a_session_without_regions_has_none(client, calibration_id):
    session = client.post(URL, json=make_session_body(calibration_id)).json()
    assert session["regions"] == {"named": [], "split": None, "extra_markers": False}


def test_the_pipeline_is_set_as_the_session_asks():
    asked = measuring_with(PipelineSettings(cell_px=10), sessions.Regions.model_validate(REGIONS))
    assert [region.name for region in asked.named] == ["belly", "chest"]
    assert asked.named[0].vertices == ((220.0, 40.0), (220.0, 160.0), (320.0, 100.0))
    assert (asked.split, asked.extra_markers, asked.cell_px) == ((150.0, 165.5), True, 10)
    plain = PipelineSettings(split=(100.0, 100.0))
    assert measuring_with(plain, sessions.Regions()) == plain


def named(**changes):
    return {"named": [BELLY | changes]}


@pytest.mark.parametrize(
    ("regions", "field"),
    [
        ([], "regions"),
        (None, "regions"),
        ({"surprise": 1}, "regions.surprise"),
        ({"named": [BELLY] * 33}, "regions.named"),
        ({"named": [BELLY, BELLY]}, "regions.named"),
        (named(name="Belly"), "regions.named.0.name"),
        (named(name="whole"), "regions.named.0.name"),
        (named(name=7), "regions.named.0.name"),
        (named(vertices=[[1.0, 2.0], [3.0, 4.0]]), "regions.named.0.vertices"),
        (named(vertices=[[1.0, 2.0], [3.0, 4.0], [5.0]]), "regions.named.0.vertices.2"),
        (named(vertices=[[1.0, 2.0], [3.0, 4.0], [5.0, "6"]]), "regions.named.0.vertices.2.1"),
        (named(vertices=[[1.0, 2.0], [3.0, 4.0], [350.0, 6.0]]), "regions.named.0.vertices.2.0"),
        (named(vertices=[[10.0, 20.0], [30.0, 250.0], [50.0, 60.0]]), "regions.named.0.vertices"),
        (named(vertices=[[10.0, 10.0], [60.0, 60.0], [10.0, 60.0], [60.0, 10.0]]), "regions.named.0.vertices"),
        (named(vertices=[[10.0, 10.0], [10.0, 13.0], [13.0, 13.0]]), "regions.named.0.vertices"),
        (named(color="red"), "regions.named.0.color"),
        ({"split": {"right_row": 10.0, "left_row": 165.0}}, "regions.split.right_row"),
        ({"split": {"right_row": 100.0}}, "regions.split.left_row"),
        ({"extra_markers": "yes"}, "regions.extra_markers"),
    ],
    ids=lambda part: str(part)[-40:],
)
def test_bad_regions_are_refused_with_field_value_and_bound_and_change_nothing(client, calibration_id, regions, field):
    answer = client.post(URL, json=make_session_body(calibration_id) | {"regions": regions})
    problem = answer.json()
    assert answer.status_code == 422
    assert problem["code"] == "invalid_value"
    assert problem["field"] == field
    assert problem["value"]
    assert problem["bound"]
    assert client.get(URL).json()["items"] == []


@pytest.mark.parametrize("text", ["NaN", "Infinity", "1e999"])
def test_a_vertex_that_is_no_number_is_refused(client, calibration_id, text):
    body = json.dumps(make_session_body(calibration_id) | {"regions": {"named": [BELLY]}}).replace("320.0", text)
    answer = client.post(URL, content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422


def test_the_live_stream_reports_named_regions_lags_and_the_split(client, moving, running):
    running.frame()
    with client.websocket_connect("/api/v1/live") as socket:
        message = socket.receive_json()
        while message["type"] != "sample":
            message = socket.receive_json()
    assert message["named_mm"] == {"belly": 2.5, "chest": None}
    assert message["split_rows"] == [150.0, 165.5]
    first, second = message["lags"]
    assert (first["first"], first["second"], first["lag_deg"], first["note"]) == ("thorax", "abdomen", 12.0, "")
    assert (second["lag_s"], second["note"]) == (None, "too little seen yet")


def test_samples_are_kept_and_exported_with_a_column_for_each_region(client, moving, session_id, running):
    running.frame()
    running.frame(whole_mm=None)
    act(client, session_id, "stop")
    rows = list(csv.DictReader(io.StringIO(client.get(f"{URL}/{session_id}/samples").text)))
    assert list(rows[0])[-2:] == ["belly_mm", "chest_mm"]
    assert [(row["belly_mm"], row["chest_mm"]) for row in rows] == [("2.5", ""), ("", "")]


def test_the_newest_surface_is_a_mesh_in_the_cameras_frame(client, moving, session_id, running):
    assert client.get(f"{URL}/{session_id}/mesh").json()["code"] == "mesh_missing"
    running.frame()
    running.frame()
    mesh = client.get(f"{URL}/{session_id}/mesh").json()
    assert (mesh["frame_index"], mesh["rows"], mesh["columns"]) == (1, NODE_ROWS, NODE_COLUMNS)
    vertices, triangles = np.array(mesh["vertices_mm"]), np.array(mesh["triangles"])
    assert vertices.shape == (NODE_ROWS * NODE_COLUMNS, 3)
    assert vertices[0].tolist() == [-80.0, -150.0, 850.123]
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0.0).all()
    assert mesh["volume_l"] == 0.21


def test_there_is_no_mesh_of_a_frame_that_was_not_measured_or_of_a_session_that_is_over(
    client, moving, session_id, running
):
    running.frame()
    running.frame(whole_mm=None)
    answer = client.get(f"{URL}/{session_id}/mesh")
    assert (answer.status_code, answer.json()["code"]) == (404, "mesh_missing")
    running.frame()
    act(client, session_id, "stop")
    eventually(lambda: client.get(f"{URL}/{session_id}/mesh").status_code == 404)
