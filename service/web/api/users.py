"""Routes of people and their roles. People are never deleted, because the audit log refers to them."""

from fastapi import APIRouter, Response

from service.access.accounts import schemas
from service.access.accounts.people import Change, Issued
from service.access.accounts.records import User
from service.core.conditional import etag_of
from service.web import dependencies
from service.web.api.login import logins_view

router = APIRouter(prefix="/users", tags=["access"])


@router.get("")
def list_users(desk: dependencies.Access) -> schemas.UserList:
    """List all people, by name."""
    return schemas.UserList(items=[_view(user) for user in desk.accounts.all()])


@router.post("", status_code=201, name="user.create")
def add_user(body: schemas.UserRequest, caller: dependencies.Caller, desk: dependencies.Access) -> schemas.UserView:
    """Create a person; the answer contains a password that must be changed at the first log-in."""
    issued = desk.accounts.add(body.name, body.roles, by=caller.name, is_break_glass=body.is_break_glass)
    return _issued(issued)


@router.get("/{name}")
def read_user(name: schemas.PersonName, desk: dependencies.Access, fresh: dependencies.IfNoneMatch) -> schemas.UserView:
    """Read a person; the ETag covers what an administrator changes, not the log-ins."""
    user = desk.accounts.get(name)
    return fresh.answer(_view(user), user_etag(user))


@router.patch(
    "/{name}",
    name="user.change",
)
def change_user(
    name: schemas.PersonName,
    body: schemas.UserChange,
    caller: dependencies.Caller,
    desk: dependencies.Access,
    if_match: dependencies.IfMatch,
    response: Response,
) -> schemas.UserView:
    """Change roles, disable, or reset the password; disabling and a reset end the person's log-ins."""
    change = Change(
        roles=None if body.roles is None else frozenset(body.roles),
        is_disabled=body.is_disabled,
        is_break_glass=body.is_break_glass,
        reset_password=body.reset_password,
    )
    issued = desk.accounts.change(name, change, by=caller.name, check=lambda user: if_match.require(user_etag(user)))
    response.headers["ETag"] = user_etag(issued.user)
    return _issued(issued)


@router.get("/{name}/logins")
def list_user_logins(
    name: schemas.PersonName, caller: dependencies.Caller, desk: dependencies.Access
) -> schemas.LoginList:
    """List the log-ins of a person."""
    return logins_view(desk, desk.accounts.get(name), caller.identity)


@router.post("/{name}/logins/{login_id}/end", status_code=204, name="user.end_login")
def end_user_login(
    name: schemas.PersonName, login_id: schemas.LoginId, caller: dependencies.Caller, desk: dependencies.Access
) -> None:
    """End a log-in of a person; its live stream closes within seconds."""
    desk.logins.end(desk.logins.find(desk.accounts.get(name), login_id), by=caller.name)


def user_etag(user: User) -> str:
    """Return the ETag of the fields that an administrator can change."""
    decided = (sorted(user.roles), user.is_disabled, user.is_break_glass, user.must_change_password, user.issuer)
    return etag_of("user", user.key, user.created_at, *decided)


def _issued(issued: Issued) -> schemas.UserView:
    return _view(issued.user).model_copy(update={"one_time_password": issued.one_time_password})


def _view(user: User) -> schemas.UserView:
    return schemas.UserView(
        name=user.name,
        roles=sorted(user.roles),
        is_disabled=user.is_disabled,
        must_change_password=user.must_change_password,
        is_break_glass=user.is_break_glass,
        issuer=user.issuer,
        created_at=user.created_at,
        last_login_at=user.last_login_at,
    )
