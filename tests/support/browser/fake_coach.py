"""A controller with a coaching stream that a test sets, and a patient's page whose time the test moves."""

import asyncio
import contextlib
import json
import math
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from tests.support.browser.fake_service import FakeService, Policy, page_files
from tests.support.browser.stepped_page import SteppedPage

CODE = "042917"
PROBLEM = "application/problem+json"
NOT_PAIRED = {"code": "not_logged_in", "detail": "log in first"}
REFUSED = {"code": "pairing_refused", "detail": "not this code"}


def guide(**changes: Any) -> dict[str, Any]:
    """Return the guidance of a frame below the band; `changes` say what is different."""
    return {
        "type": "guide",
        "sequence": 0,
        "sent_at": "",
        "age_ms": 4.0,
        "is_practice": False,
        "is_measured": True,
        "level": 0.4,
        "band": {"lower": 0.62, "upper": 0.8},
        "instruction": "breathe_in",
        "countdown_s": None,
        "display": "bar",
        "sounds": False,
        "language": "en",
    } | changes


UNMEASURED = {"is_measured": False, "level": None, "band": None, "instruction": "none"}


class FakeCoach(FakeService):
    """The coaching stream in place of the live one: modes are `guide`, `wait` and `silent`."""

    def __init__(self) -> None:
        super().__init__()
        self.schema = "tidegate.coach/1"
        self.mode = "guide"
        self.guide = guide()
        self.language = "en"
        self.is_paired = True
        self.wait_s = 0

    def app(self) -> Starlette:
        """Return the application."""
        routes = [
            WebSocketRoute("/api/v1/coach/live", self._live),
            Route("/api/v1/coach/me", self._me),
            Route("/api/v1/coach/pair", self._pair, methods=["POST"]),
            Route("/patient/", self._page),
            Route("/hang", self._hang),
            Route("/{path:path}", self._file),
        ]
        return Starlette(routes=routes, middleware=[Middleware(Policy)])

    async def _page(self, _request: Request) -> Response:
        return page_files(is_relaxed=self.is_relaxed)["patient/index.html"]

    async def _me(self, _request: Request) -> Response:
        if not self.is_paired:
            return JSONResponse(NOT_PAIRED, 401, media_type=PROBLEM)
        return JSONResponse({"is_screen": True, "expires_at": "2099-01-01T00:00:00Z"})

    async def _pair(self, request: Request) -> Response:
        body = await request.json()
        self.calls.append(("POST", request.url.path, body))
        if self.wait_s:
            return JSONResponse(REFUSED, 429, headers={"Retry-After": str(self.wait_s)}, media_type=PROBLEM)
        if body != {"code": CODE}:
            return JSONResponse(REFUSED, 403, media_type=PROBLEM)
        self.is_paired = True
        return Response(status_code=204)

    def _next_message(self) -> str | None:
        if self.mode == "silent":
            return None
        stamp = {"sent_at": self._now(), "sequence": self.sent + 1}
        if self.mode == "wait":
            return json.dumps({"type": "wait", "language": self.language} | stamp)
        self.frame_index += 1
        moving = {"level": round(0.45 - 0.3 * math.cos(self.frame_index / 12), 3)} if self.is_breathing else {}
        return json.dumps(self.guide | moving | stamp)


COACHING = {"display": "bar", "band": None, "scale": None, "rest_s": 10.0, "sounds": False, "language": "en"} | {
    "is_practice": False
}
SCREEN = {
    "id": "5c" * 16,
    "number": 1,
    "paired_by": "A. Therapist",
    "address": "10.0.0.7",
    "paired_at": "2026-11-21T08:00:00Z",
    "seen_at": "2026-11-21T08:05:00Z",
    "expires_at": "2026-11-21T20:00:00Z",
}


class FakeConsole(FakeService):
    """A controller with the live stream and the coaching stream, for the console's panel."""

    def __init__(self) -> None:
        super().__init__()
        self.guide: dict[str, Any] | None = guide()
        self.coaching = dict(COACHING)
        self.screens: list[dict[str, Any]] = []
        self.mirrors = 0

    def app(self) -> Starlette:
        """Return the application."""
        app = super().app()
        app.router.routes.insert(0, WebSocketRoute("/api/v1/coach/live", self._mirror))
        app.router.routes.insert(0, Route("/api/v1/sessions/{id}/coaching", self._coaching, methods=["GET", "PUT"]))
        return app

    async def _mirror(self, websocket: WebSocket) -> None:
        await websocket.accept()
        self.mirrors += 1
        sequence = 0
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await websocket.send_json({"type": "hello", "schema": "tidegate.coach/1"})
            while self.is_up:
                sequence += 1
                shown = {"type": "wait", "language": "en"} if self.guide is None else self.guide
                await websocket.send_json(shown | {"sent_at": self._now(), "sequence": sequence})
                await asyncio.sleep(self.period_s)
        self.mirrors -= 1

    async def _coaching(self, request: Request) -> Response:
        if request.method == "PUT":
            body = await request.json()
            self.calls.append(("PUT", request.url.path, body))
            if self.problem is not None:
                return JSONResponse(self.problem[1], self.problem[0], media_type=PROBLEM)
            self.coaching = {name: body[name] for name in COACHING}
        return JSONResponse(self.coaching)

    def _answer(self, path: str, method: str, body: Any) -> Response:
        if not path.startswith("/coach/"):
            return super()._answer(path, method, body)
        if path == "/coach/code":
            return JSONResponse({"code": CODE, "expires_at": "2099-01-01T00:00:00Z", "expires_in_s": 120.0}, 201)
        if path.endswith("/end"):
            self.screens = [one for one in self.screens if one["id"] not in path]
        return JSONResponse(
            {"items": self.screens, "code_expires_at": None if self.screens else "2099-01-01T00:00:00Z"}
        )


class SteppedScreen(SteppedPage):
    """The patient's page, and the time that it and its service share."""

    step_ms = 50

    @property
    def kind(self) -> str | None:
        """What the screen shows: guide, wait or blank."""
        return self.page.get_attribute("#guide", "data-show")
