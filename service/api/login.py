"""Log in, log out, who am I, my password, my log-ins."""

import asyncio
from concurrent.futures import Future
from functools import partial
from typing import TypeVar

from fastapi import APIRouter, Request, Response

from service import access_schemas as schemas
from service import deps
from service.access.cookies import drop_login_cookie, set_login_cookie, token_in
from service.access.desk import AccessDesk
from service.access.identity import Identity
from service.access.logins import Attempt
from service.access.permissions import permissions_of
from service.access.records import Login, User
from service.api import problems
from service.errors import (
    BoundError,
    LocalLoginRefusedError,
    LockedOutError,
    LoginFailedError,
    NotFoundError,
    OutsideUserError,
    PasswordDeskFullError,
    WrongPasswordError,
)

router = APIRouter(tags=["access"])
LOG_IN = problems(BoundError, LoginFailedError, LocalLoginRefusedError, LockedOutError, PasswordDeskFullError)
PASSWORD = problems(
    NotFoundError, BoundError, OutsideUserError, WrongPasswordError, LockedOutError, PasswordDeskFullError
)
ResultT = TypeVar("ResultT")


@router.post("/login", name="user.login", responses=LOG_IN)
async def log_in(
    body: schemas.LoginRequest, desk: deps.Access, address: deps.Address, request: Request, response: Response
) -> schemas.Me:
    """Check name and password and set the cookie; one answer for whatever is wrong, in one time."""
    desk.logins.refuse_locked(body.name, address)
    attempt = Attempt(
        name=body.name,
        password=body.password.get_secret_value(),
        address=address,
        reason=body.reason,
        former_token=token_in(request.headers, is_secure=desk.is_secure),
    )
    opened = await _done(desk.passwords.submit(partial(desk.logins.log_in, attempt)))
    set_login_cookie(response, opened.token, is_secure=desk.is_secure)
    return person_view(desk, opened.user, opened.login)


@router.post("/logout", status_code=204, name="user.logout")
def log_out(caller: deps.Caller, desk: deps.Access, response: Response) -> None:
    """End this log-in; it changes nothing of a session, and takes no beam away or gives one."""
    login = desk.doorkeeper.login_of(caller.identity)
    if login is not None:
        desk.logins.log_out(login)
    drop_login_cookie(response, is_secure=desk.is_secure)


@router.get("/me")
def who_am_i(caller: deps.Caller, desk: deps.Access) -> schemas.Me:
    """Tell who asks, and what they may do."""
    login = desk.doorkeeper.login_of(caller.identity)
    if login is None:
        return _machine_view(caller.identity)
    return person_view(desk, desk.person(caller.identity), login)


@router.post("/me/password", status_code=204, name="user.password", responses=PASSWORD)
async def change_password(
    body: schemas.PasswordRequest, caller: deps.Caller, desk: deps.Access, address: deps.Address
) -> None:
    """Change one's own password; ends one's other log-ins. A wrong old one counts as a failed log-in."""
    work = partial(
        desk.logins.change_password,
        desk.person(caller.identity),
        body.old_password.get_secret_value(),
        body.new_password.get_secret_value(),
        address=address,
        keep=desk.doorkeeper.login_of(caller.identity),
    )
    await _done(desk.passwords.submit(work))


@router.get("/me/logins", responses=problems(NotFoundError))
def list_my_logins(caller: deps.Caller, desk: deps.Access) -> schemas.LoginList:
    """List where one is logged in."""
    return logins_view(desk, desk.person(caller.identity), caller.identity)


@router.post("/me/logins/{login_id}/end", status_code=204, name="user.logout_other", responses=problems(NotFoundError))
def end_my_login(login_id: schemas.LoginId, caller: deps.Caller, desk: deps.Access) -> None:
    """End a log-in of one's own, here or elsewhere."""
    person = desk.person(caller.identity)
    desk.logins.end(desk.logins.find(person, login_id), by=person.name)


def person_view(desk: AccessDesk, user: User, login: Login) -> schemas.Me:
    """Tell a person who they are."""
    return schemas.Me(
        name=user.name,
        kind="user" if user.issuer is None else "oidc",
        roles=sorted(user.roles),
        permissions=sorted(permissions_of(user.roles)),
        must_change_password=user.must_change_password,
        is_break_glass=login.is_break_glass,
        way=login.way,
        expires_at=login.expires_at,
        idle_minutes=desk.logins.idle.total_seconds() / 60.0,
    )


def logins_view(desk: AccessDesk, user: User, asker: Identity) -> schemas.LoginList:
    """Tell a person's log-ins."""
    return schemas.LoginList(
        items=[
            schemas.LoginView(
                id=login.id,
                way=login.way,
                address=login.address,
                created_at=login.created_at,
                expires_at=login.expires_at,
                seen_at=desk.store.seen_at(login),
                is_this=login.token_sha256 == asker.anchor,
            )
            for login in desk.store.logins_of(user)
        ]
    )


def _machine_view(identity: Identity) -> schemas.Me:
    return schemas.Me(
        name=identity.name,
        kind=identity.kind,
        roles=[],
        permissions=sorted(identity.permissions),
        must_change_password=False,
    )


async def _done(future: "Future[ResultT]") -> ResultT:
    """Wait for a password without holding a worker thread, of which stop and hold need one."""
    return await asyncio.wrap_future(future)
