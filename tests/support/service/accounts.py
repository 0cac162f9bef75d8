"""Tests speak as somebody: people made on demand through the real store, without what a password costs.

`PeopleClient` sends every request as the person that its body's ``operator`` names, or as the one it was reported;
`provision` puts people and keys into a data folder before a real service is started in it.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient

from service.access.accounts.records import User, name_key
from service.access.accounts.store import AccessStore
from service.access.login.cookies import CookieScope, cookie_name
from service.access.login.keys import KeyService
from service.access.login.lockout import RefusedLogins
from service.access.login.logins import LoginService, OpenedLogin
from service.access.request.rules import RuleTable
from service.access.service import AccessService
from service.core.permissions import KEY_PERMISSIONS, Permission, Role
from service.core.settings.settings import Settings
from service.storage.database.engine import Database
from tests.support.repository import ROOT

SOMEBODY = "A. Therapist"
PASSWORD = "a password for the tests"
EVERY_ROLE = frozenset(Role)
CONTRACT = ROOT / "openapi" / "openapi.json"
PROBLEM = "application/problem+json"


class QuickHashing:
    """Hashes that cost nothing, and are worth as much; counts how often it is asked to verify."""

    def __init__(self) -> None:
        self.verified: list[str | None] = []

    def hash(self, password: str) -> str:
        return f"quick:{password}"

    def verify(self, hashed: str | None, password: str) -> bool:
        self.verified.append(hashed)
        return hashed == f"quick:{password}"

    def is_outdated(self, _hashed: str) -> bool:
        return False


def open_login(
    store: AccessStore, name: str, roles: Iterable[Role] = EVERY_ROLE, *, password_hash: str | None = None
) -> OpenedLogin:
    """Open a log-in for a person, made where there is none; no audit row tells of it."""
    user = store.users.get(name_key(name))
    if user is None:
        user = User(
            name=name,
            password_hash=password_hash or QuickHashing().hash(PASSWORD),
            roles=frozenset(roles),
            created_at=store.now(),
        )
    desk = LoginService(store, QuickHashing(), RefusedLogins(), lasts=timedelta(hours=12), idle=timedelta(minutes=30))
    return desk._open(user, "127.0.0.1", "password", None, {})


PLAIN = CookieScope(is_secure=False)


def headers_of(opened: OpenedLogin, origin: str = "http://testserver", cookies: CookieScope = PLAIN) -> dict[str, str]:
    """Return what the browser of this log-in sends."""
    return {"Cookie": f"{cookie_name(cookies)}={opened.token}", "Origin": origin}


class PeopleClient(TestClient):
    """Speaks as the person whom the request names, who has every role; ``speaks_as`` is who else it is."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.speaks_as: str | None = SOMEBODY
        self._logins: dict[str, OpenedLogin] = {}

    def __enter__(self) -> "PeopleClient":
        super().__enter__()
        self.headers_as(SOMEBODY)
        return self

    def __exit__(self, *exception: object) -> None:
        super().__exit__(*exception)
        self._logins.clear()  # of the application that has ended

    @property
    def desk(self) -> AccessService:
        return self.app.state.access

    def headers_as(self, name: str, roles: Iterable[Role] = EVERY_ROLE) -> dict[str, str]:
        if name not in self._logins:
            self._logins[name] = open_login(self.desk.store, name, roles)
        return headers_of(self._logins[name], cookies=self.desk.cookies)

    def request(self, method: str, url: Any, **options: Any) -> Any:
        name = _named(options) or self.speaks_as
        if name is not None:
            options["headers"] = {**self.headers_as(name), **dict(options.get("headers") or {})}
        answer = super().request(method, url, **options)
        check_documented(method, answer)
        return answer

    def websocket_connect(self, url: str, subprotocols: Any = None, **options: Any) -> Any:
        if self.speaks_as is not None:
            mine = self.headers_as(self.speaks_as)
            mine.pop("Origin")
            options["headers"] = {**mine, **dict(options.get("headers") or {})}
        return super().websocket_connect(url, subprotocols, **options)


@cache
def contract() -> dict[str, Any]:
    """Return the contract that is kept in the repository."""
    read: dict[str, Any] = json.loads(CONTRACT.read_text(encoding="utf-8"))
    return read


def check_documented(method: str, answer: Any) -> None:
    """Fail a test that got a problem of which the contract says nothing: whatever is refused is reported beforehand."""
    if answer.headers.get("content-type") != PROBLEM or answer.status_code == 405:
        return
    templates = RuleTable().templates(answer.request.url.path)
    operations = [contract()["paths"].get(template, {}).get(method.lower()) for template in templates]
    reported = next((operation for operation in operations if operation is not None), None)
    if reported is None:
        return
    codes = reported["x-problem-codes"].get(str(answer.status_code), [])
    code = answer.json()["code"]
    assert code in codes, f"{reported['operationId']} answered {answer.status_code} {code}: the contract has {codes}"


def _named(options: Mapping[str, Any]) -> str | None:
    """Return the person whom a request names, if anyone can have that name."""
    body = options.get("json")
    if body is None and isinstance(options.get("content"), bytes | str):
        try:
            body = json.loads(options["content"])
        except (ValueError, RecursionError):
            body = None
    named = body.get("operator") if isinstance(body, dict) else None
    if named is None and isinstance(options.get("params"), dict):
        named = options["params"].get("operator")
    is_name = isinstance(named, str) and 1 <= len(named) <= 80 and named.isprintable() and named.strip() != ""
    return named if is_name else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Provisioned:
    """What was put into a data folder; ``headers`` are those of the first person, or of the key."""

    headers: dict[str, str]
    people: dict[str, dict[str, str]]
    key: dict[str, str]
    key_secret: str


def provision(
    data_dir: Path,
    *,
    people: Mapping[str, Iterable[Role]] | None = None,
    origin: str = "http://127.0.0.1:8000",
    scopes: Iterable[Permission] = KEY_PERMISSIONS,
    password: str | None = None,
    settings: Settings | None = None,
) -> Provisioned:
    """Put people who are logged in already, and an API key, into a data folder; before its service starts.

    ``origin`` is the page's: ``http://127.0.0.1:<port>``. With a ``password`` people can log in with it, too, at the
    full cost of its hash; one more may be provisioned into a folder that has some.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    settings = settings or Settings(data_dir=data_dir)
    database = Database(settings.database_place)
    try:
        database.migrate()
        store = AccessStore(database)
        store.load()
        made = _hash(password)
        chosen = {SOMEBODY: EVERY_ROLE} if people is None else people
        opened = {name: open_login(store, name, roles, password_hash=made) for name, roles in chosen.items()}
        keys = KeyService(store, longest=timedelta(days=2))
        number = len(store.keys) + 1
        key = keys.create(f"tests {number}", scopes, datetime.now(UTC) + timedelta(days=1), by=SOMEBODY)
    finally:
        database.close()
    sent = {
        name: headers_of(one, origin, CookieScope(is_secure=settings.is_secure, room=settings.room))
        for name, one in opened.items()
    }
    bearer = {"Authorization": f"Bearer {key.secret}"}
    return Provisioned(headers=next(iter(sent.values()), bearer), people=sent, key=bearer, key_secret=key.secret)


def _hash(password: str | None) -> str | None:
    if password is None:
        return None
    from service.access.accounts.passwords import Argon2Hashing

    return Argon2Hashing().hash(password)
