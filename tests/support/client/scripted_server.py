"""A server that answers each call of a client as the test scripted it."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

KEY = "tg_0123456789_a-secret-that-must-not-be-seen"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedRequest:
    """A request as it came."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes
    connection: int

    @property
    def json(self) -> object:
        return json.loads(self.body)


Step = Callable[["Handler"], None]


class Handler(BaseHTTPRequestHandler):
    """Records a request, then executes the script's next step."""

    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        size = int(self.headers.get("Content-Length", 0))
        headers = {name.lower(): value for name, value in self.headers.items()}
        received = ReceivedRequest(
            method=self.command,
            path=self.path,
            headers=headers,
            body=self.rfile.read(size),
            connection=self.client_address[1],
        )
        self.server.script.requests.append(received)
        self.server.script.next_step()(self)

    do_POST = do_GET  # noqa: N815 - the library finds it by this name

    def answer(self, status: int, body: bytes, content_type: str = "application/json", **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", headers.pop("length", str(len(body))))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@dataclass(slots=True, kw_only=True)
class Script:
    """The server's script: one step a request, the last one repeated."""

    port: int = 0
    steps: list[Step] = field(default_factory=list)
    requests: list[ReceivedRequest] = field(default_factory=list)

    def next_step(self) -> Step:
        return self.steps.pop(0) if len(self.steps) > 1 else self.steps[0]


def says(document: object, status: int = 200, **headers: str) -> Step:
    """Answer with JSON."""
    return lambda handler: handler.answer(status, json.dumps(document).encode(), **headers)


def refuses(status: int, code: str, **headers: str) -> Step:
    """Answer with a problem."""
    problem = {"type": f"urn:tidegate:problem:{code}", "title": "t", "status": status, "detail": "d", "code": code}
    return lambda handler: handler.answer(status, json.dumps(problem).encode(), "application/problem+json", **headers)


def cuts(handler: Handler) -> None:
    """Take the request, and close without a word."""
    handler.close_connection = True
    handler.connection.shutdown(2)


def writes(raw: bytes) -> Step:
    """Answer with these very bytes, then close."""

    def step(handler: Handler) -> None:
        handler.wfile.write(raw)
        handler.close_connection = True

    return step


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    script: Script

    def handle_error(self, *_: object) -> None:
        pass
