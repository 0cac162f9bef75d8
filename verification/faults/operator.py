"""A person at the page, logged in, over HTTP: makes a session, sets the zero, acknowledges, arms; sees the audit."""

import contextlib
import threading
import time
from typing import Any

import httpx2

NAME = "A. Therapist"
POLL_S = 0.02
PATIENCE_S = 60.0


class PersonGaveUpError(Exception):
    """What a person tried did not come true in time."""


class Person:
    """Calls one service; every call names the person.

    Parameters
    ----------
    headers
        Those of a log-in that is open in the service's data folder.
    """

    def __init__(self, port: int, headers: dict[str, str]) -> None:
        self.port = port
        self.headers = headers
        self._client = httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=20.0, headers=headers)
        self.session_id = ""
        self._present = threading.Event()
        self._present.set()
        self._is_over = threading.Event()
        self._page = threading.Thread(target=self._keep_page, daemon=True)
        self._page.start()
        self.seen_ns = 0

    def close(self) -> None:
        self._is_over.set()
        self._page.join()
        self._client.close()

    def wait_for_service(self, is_alive) -> None:
        """Wait until the service answers; raise PersonGaveUpError if it never does."""
        end_s = time.monotonic() + PATIENCE_S
        while is_alive() and time.monotonic() < end_s:
            with contextlib.suppress(httpx2.TransportError):
                if self._client.get("/healthz").status_code == 200:
                    return
            time.sleep(0.03)
        raise PersonGaveUpError("the service does not answer")

    def upload(self, calibration: bytes) -> str:
        answer = self._client.post(
            "/api/v1/calibrations",
            params={"operator": NAME},
            content=calibration,
            headers={"Content-Type": "application/json"},
        )
        return str(_body(answer)["id"])

    def make_session(self, request: dict[str, Any]) -> str:
        """Make and start a session; the id is kept."""
        self.create_session(request)
        answer = self.act("start")
        if answer.status_code != 200:
            raise PersonGaveUpError(f"the session does not start: {answer.text}")
        return self.session_id

    def create_session(self, request: dict[str, Any]) -> str:
        """Make a session; the id is kept."""
        body = {"patient_reference": "P-1", "plan_id": "PLAN", "fraction_id": "FX", "operator": NAME, **request}
        self.session_id = str(_body(self._client.post("/api/v1/sessions", json=body))["id"])
        return self.session_id

    def act(self, action: str, **more: object):
        """Ask for something; the answer may be a refusal."""
        body = {"operator": NAME, **more}
        return self._client.post(f"/api/v1/sessions/{self.session_id}/{action}", json=body)

    def post(self, path: str, **more: object):
        return self._client.post(f"/api/v1{path}", json={"operator": NAME, **more})

    def post_as_is(self, path: str, body: dict[str, Any]):
        return self._client.post(f"/api/v1{path}", json=body)

    def get_top(self, path: str):
        return self._client.get(path)

    def get(self, path: str):
        return self._client.get(f"/api/v1{path}")

    def detail(self) -> dict[str, Any]:
        return _body(self.get(f"/sessions/{self.session_id}"))

    def models(self) -> list[dict[str, Any]]:
        return _body(self.get(f"/sessions/{self.session_id}/models"))["items"]

    def is_chain_intact(self) -> bool:
        return bool(_body(self.get("/audit/verify"))["is_intact"])

    def leave_page(self) -> int:
        """Close the page; returns when it was received of last."""
        self._present.clear()
        time.sleep(0.05)
        return self.seen_ns

    def come_back(self) -> None:
        self._present.set()

    def _keep_page(self) -> None:
        while not self._is_over.wait(0.25):
            if self._present.is_set() and self.session_id:
                with contextlib.suppress(httpx2.HTTPError, RuntimeError):
                    self.seen_ns = time.monotonic_ns()
                    self.act("presence")


def _body(answer) -> dict[str, Any]:
    if answer.status_code >= 400:
        raise PersonGaveUpError(f"{answer.status_code}: {answer.text}")
    return answer.json()
