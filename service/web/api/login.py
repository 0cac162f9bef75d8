"""Routes of the caller's own account: log in, log out, password, log-ins."""

import asyncio
from concurrent.futures import Future
from functools import partial
from typing import TypeVar

from fastapi import APIRouter, Request, Response

from service.access.accounts import schemas
from service.access.accounts.records import Login, User
from service.access.login.cookies import drop_login_cookie, set_login_cookie, token_in
from service.access.login.logins import Attempt
from service.access.request.identity import Identity
from service.access.service import AccessService
from service.core.permissions import permissions_of
from service.web import dependencies

router = APIRouter(tags=["access"])
ResultT = TypeVar("ResultT")


@router.post("/login", name="user.login")
async def log_in(
    body: schemas.LoginRequest,
    desk: dependencies.Access,
    address: dependencies.Address,
    request: Request,
    response: Response,
) -> schemas.Me:
    """Check name and password and set the cookie; every failure has the same answer and timing."""
    desk.logins.refuse_locked(body.name, address)
    attempt = Attempt(
        name=body.name,
        password=body.password.get_secret_value(),
        address=address,
        reason=body.reason,
        former_token=token_in(request.headers, desk.cookies),
    )
    opened = await _done(desk.passwords.submit(partial(desk.logins.log_in, attempt)))
    set_login_cookie(response, opened.token, desk.cookies)
    return person_view(desk, opened.user, opened.login)


@router.post("/logout", status_code=204, name="user.logout")
def log_out(caller: dependencies.Caller, desk: dependencies.Access, response: Response) -> None:
    """End this log-in; sessions and the beam are not affected."""
    login = desk.authenticator.login_of(caller.identity)
    if login is not None:
        desk.logins.log_out(login)
    drop_login_cookie(response, desk.cookies)


@router.get("/me")
def who_am_i(caller: dependencies.Caller, desk: dependencies.Access) -> schemas.Me:
    """Return the caller and the caller's permissions."""
    login = desk.authenticator.login_of(caller.identity)
    if login is None:
        return _machine_view(caller.identity)
    return person_view(desk, desk.person(caller.identity), login)


@router.post("/me/password", status_code=204, name="user.password")
async def change_password(
    body: schemas.PasswordRequest, caller: dependencies.Caller, desk: dependencies.Access, address: dependencies.Address
) -> None:
    """Change the caller's password and end the other log-ins; a wrong old password counts as a failed log-in."""
    work = partial(
        desk.logins.change_password,
        desk.person(caller.identity),
        body.old_password.get_secret_value(),
        body.new_password.get_secret_value(),
        address=address,
        keep=desk.authenticator.login_of(caller.identity),
    )
    await _done(desk.passwords.submit(work))


@router.get("/me/logins")
def list_my_logins(caller: dependencies.Caller, desk: dependencies.Access) -> schemas.LoginList:
    """List the caller's log-ins."""
    return logins_view(desk, desk.person(caller.identity), caller.identity)


@router.post("/me/logins/{login_id}/end", status_code=204, name="user.logout_other")
def end_my_login(login_id: schemas.LoginId, caller: dependencies.Caller, desk: dependencies.Access) -> None:
    """End one of the caller's log-ins."""
    person = desk.person(caller.identity)
    desk.logins.end(desk.logins.find(person, login_id), by=person.name)


def person_view(desk: AccessService, user: User, login: Login) -> schemas.Me:
    """Return a person's account and permissions."""
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


def logins_view(desk: AccessService, user: User, asker: Identity) -> schemas.LoginList:
    """Return the log-ins of a person."""
    return schemas.LoginList(
        items=[
            schemas.LoginView(
                id=login.id,
                way=login.way,
                address=login.address,
                created_at=login.created_at,
                expires_at=login.expires_at,
                seen_at=desk.store.last_used_at(login),
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
    """Await a password check without blocking a worker thread; hold and stop need those."""
    return await asyncio.wrap_future(future)
