"""Targets: what comes over HTTP: bodies, cursors, the address a proxy tells."""

import ipaddress
import json
from collections.abc import Iterator
from functools import cache

from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.types import Scope

from service.access.request.addresses import UNKNOWN, ClientAddresses
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.qa.schemas import QaRunRequest
from service.storage.database import queries
from service.storage.database.base import Base
from service.storage.database.engine import Database
from service.web.problems.table import problem_of
from verification.fuzz.target import Target, as_file

BODIES = (sessions.SessionRequest, QaRunRequest, sessions.OperatorRequest)


class RefusedBodyError(Exception):
    """A body that became a problem."""


def read_body(content: bytes) -> None:
    """The first byte picks the call; a refusal becomes the problem that is answered."""
    kind = BODIES[content[0] % len(BODIES)] if content else BODIES[0]
    try:
        body = json.loads(content[1:])  # as the web framework does
    except (ValueError, RecursionError):
        return
    try:
        kind.model_validate(body)
    except ValidationError as error:
        errors = [{**one, "loc": ("body", *one["loc"])} for one in error.errors()]
        problem = problem_of(RequestValidationError(errors, body=body))
        assert problem.status == 422
        assert len(problem.model_dump_json()) < 100_000
        raise RefusedBodyError(problem.detail) from error


def bodies() -> Iterator[bytes]:
    amplitude = {"lower_mm": -1.0, "upper_mm": 3.0, "dwell_ms": 100.0}
    phase = {"kind": "phase", "from_percent": 30.0, "to_percent": 70.0}
    hold = {"kind": "breath_hold", "lower_mm": 8.0, "upper_mm": 12.0}
    base = {
        "operator": "A. Therapist",
        "patient_reference": "P1",
        "plan_id": "p",
        "fraction_id": "1",
        "fraction_number": 1,
        "calibration_id": "0" * 32,
        "source": {"kind": "recording", "path": "a.oni"},
    }
    for window in (amplitude, phase, {**hold, "join": "and", "further": [phase]}):
        yield b"\x00" + json.dumps({**base, "window": window}).encode()
    yield b"\x01" + json.dumps({"source": {"kind": "phantom"}}).encode()
    yield b"\x02" + json.dumps({"operator": "A. Therapist"}).encode()


@cache
def _database() -> Database:
    database = Database(as_file(b"", "cursors.sqlite"))
    with database.connect() as connection:
        Base.metadata.create_all(connection)
        connection.commit()
    return database


def read_cursor(content: bytes) -> None:
    cursor = content.decode(errors="replace")
    with _database().read() as db:
        try:
            queries.session_page(db, cursor, 10)
        except BoundError:
            queries.audit_page(db, cursor, 10, None)


def cursors() -> Iterator[bytes]:
    yield b"2026-11-22T00:00:00.000000Z_" + b"0" * 32
    yield b"9999-12-31T23:59:59-23:59_x"
    yield b"123456789012345678"


def read_address(content: bytes) -> None:
    """Whatever a proxy's header says, what comes out is an address or nothing."""
    callers = ClientAddresses(behind_proxy=True, trusted_proxies=("127.0.0.1", "10.0.0.0/8"))
    scope: Scope = {"type": "http", "client": ("127.0.0.1", 1), "headers": [(b"x-forwarded-for", content)]}
    address = callers.address(scope)
    assert address == UNKNOWN or ipaddress.ip_address(address)


TARGETS = (
    Target(
        name="body",
        reads="bodies of sessions, windows, QA runs and commands, and the problems they become "
        "(`service.core.schemas.sessions`)",
        read=read_body,
        refusals=(RefusedBodyError,),
        seeds=bodies,
        words=("further", "breath_hold", "lower_percent", "settle_ms", "named", "1e999", '"\\\\ud800"'),
    ),
    Target(
        name="cursor",
        reads="cursors of lists, down to the database (`service.storage.database.queries`)",
        read=read_cursor,
        refusals=(BoundError,),
        seeds=cursors,
        max_bytes=128,
    ),
    Target(
        name="address",
        reads="a proxy's header with the client's address (`service.access.request.addresses`)",
        read=read_address,
        refusals=(),
        seeds=lambda: (b"192.0.2.1, 10.0.0.1", b"[2001:db8::1]:443", b"::ffff:192.0.2.1"),
        max_bytes=256,
    ),
)
