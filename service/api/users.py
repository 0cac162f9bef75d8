"""People: who may log in, as what. Nobody is deleted: the audit names them."""

from fastapi import APIRouter, Response

from service import access_schemas as schemas
from service import deps
from service.access.people import Change, Issued
from service.access.records import User
from service.api import problems
from service.api.login import logins_view
from service.conditional import etag_of
from service.errors import (
    BoundError,
    LastAdminError,
    NameTakenError,
    NotFoundError,
    OutsideUserError,
    PasswordDeskFullError,
)

router = APIRouter(prefix="/users", tags=["access"])


@router.get("")
def list_users(desk: deps.Access) -> schemas.UserList:
    """List everybody, by name."""
    return schemas.UserList(items=[_view(user) for user in desk.people.all()])


@router.post(
    "", status_code=201, name="user.create", responses=problems(BoundError, NameTakenError, PasswordDeskFullError)
)
def add_user(body: schemas.UserRequest, caller: deps.Caller, desk: deps.Access) -> schemas.UserView:
    """Make a person; the answer has a password for the first log-in, which asks for another."""
    issued = desk.people.add(body.name, body.roles, by=caller.name, is_break_glass=body.is_break_glass)
    return _issued(issued)


@router.get("/{name}", responses=problems(NotFoundError))
def read_user(name: schemas.PersonName, desk: deps.Access, fresh: deps.IfNoneMatch) -> schemas.UserView:
    """Read a person; the ETag changes with what is decided about them, not with their log-ins."""
    user = desk.people.get(name)
    return fresh.told(_view(user), user_etag(user))


@router.patch(
    "/{name}",
    name="user.change",
    responses=problems(NotFoundError, BoundError, LastAdminError, OutsideUserError, PasswordDeskFullError),
)
def change_user(
    name: schemas.PersonName,
    body: schemas.UserChange,
    caller: deps.Caller,
    desk: deps.Access,
    if_match: deps.IfMatch,
    response: Response,
) -> schemas.UserView:
    """Change roles, disable, reset the password; disabling and a reset end the person's log-ins."""
    change = Change(
        roles=None if body.roles is None else frozenset(body.roles),
        is_disabled=body.is_disabled,
        is_break_glass=body.is_break_glass,
        reset_password=body.reset_password,
    )
    issued = desk.people.change(name, change, by=caller.name, check=lambda user: if_match.require(user_etag(user)))
    response.headers["ETag"] = user_etag(issued.user)
    return _issued(issued)


@router.get("/{name}/logins", responses=problems(NotFoundError))
def list_user_logins(name: schemas.PersonName, caller: deps.Caller, desk: deps.Access) -> schemas.LoginList:
    """List where a person is logged in."""
    return logins_view(desk, desk.people.get(name), caller.identity)


@router.post("/{name}/logins/{login_id}/end", status_code=204, name="user.end_login", responses=problems(NotFoundError))
def end_user_login(name: schemas.PersonName, login_id: schemas.LoginId, caller: deps.Caller, desk: deps.Access) -> None:
    """End a person's log-in; its live stream closes within seconds."""
    desk.logins.end(desk.logins.find(desk.people.get(name), login_id), by=caller.name)


def user_etag(user: User) -> str:
    """Return the ETag of what an administrator decides about a person."""
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
