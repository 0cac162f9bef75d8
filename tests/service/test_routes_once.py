"""What is kept of FastAPI's work on routes tells apart what is not the same."""

from fastapi import APIRouter, Depends, FastAPI, HTTPException, routing
from fastapi.testclient import TestClient

from tests.routes_once import routes_once

router = APIRouter()


@router.get("/thing")
def _read_thing() -> str:
    return "there"


def _refuse() -> None:
    raise HTTPException(418)


def app_of(prefix, *dependencies):
    app = FastAPI()
    app.include_router(router, prefix=prefix, dependencies=dependencies)
    return app


def test_a_router_that_is_included_otherwise_answers_otherwise():
    with routes_once():
        open_one, moved, closed = app_of("/a"), app_of("/b"), app_of("/a", Depends(_refuse))
        asked = [TestClient(app).get("/a/thing").status_code for app in (open_one, moved, closed, app_of("/a"))]
        assert asked == [200, 404, 418, 200]
        assert TestClient(moved).get("/b/thing").status_code == 200


def test_one_that_is_included_in_the_same_way_is_not_worked_out_again(monkeypatch):
    worked_out = []
    work_out = routing._IncludedRouter._build_effective_context
    monkeypatch.setattr(
        routing._IncludedRouter,
        "_build_effective_context",
        lambda included, route: worked_out.append(route) or work_out(included, route),
    )
    with routes_once():
        for _ in range(3):
            assert TestClient(app_of("/a")).get("/a/thing").json() == "there"
    assert len(worked_out) == 1
