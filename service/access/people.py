"""People: made, changed, disabled; never deleted, for the audit names them."""

import secrets
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from service.access.names import check_name, name_key
from service.access.permissions import Role
from service.access.records import User
from service.access.store import AccessStore
from service.audit import Event
from service.errors import BoundError, LastAdminError, NameTakenError, NotFoundError, OutsideUserError

ADD = "user.create"
CHANGE = "user.change"
ONE_TIME_BYTES = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class Issued:
    """A person, and the password that was made for them, to be told once; None where none was."""

    user: User
    one_time_password: str | None

    def __repr__(self) -> str:
        return f"Issued(user={self.user.name!r})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What of a person is changed; None leaves it."""

    roles: frozenset[Role] | None = None
    is_disabled: bool | None = None
    is_break_glass: bool | None = None
    reset_password: bool = False


class PeopleDesk:
    """Keeps the people."""

    def __init__(self, store: AccessStore, make_hash: Callable[[str], str]) -> None:
        self._store = store
        self._hash = make_hash

    def all(self) -> list[User]:
        """List everybody, by name."""
        return sorted(self._store.users.values(), key=lambda user: user.key)

    def get(self, name: str) -> User:
        """Find somebody, or raise NotFoundError."""
        user = self._store.users.get(name_key(name))
        if user is None:
            msg = "there is no such person"
            raise NotFoundError(msg, field="name", value=name)
        return user

    def add(
        self,
        name: str,
        roles: Iterable[Role],
        *,
        by: str,
        password: str | None = None,
        is_break_glass: bool = False,
    ) -> Issued:
        """Make a person with a password to be changed at the first log-in; or with one that stays."""
        self._refuse_taken(check_name(name))
        one_time = secrets.token_urlsafe(ONE_TIME_BYTES) if password is None else None
        user = User(
            name=name,
            password_hash=self._hash(one_time or password or ""),
            roles=_some(roles),
            must_change_password=one_time is not None,
            is_break_glass=is_break_glass,
            created_at=self._store.now(),
        )
        detail = {"user": name, "roles": sorted(user.roles), "is_break_glass": is_break_glass}
        with self._store.changing:
            self._refuse_taken(name)
            self._store.write(save=[user], event=Event(actor=by, action=ADD, detail=detail))
        return Issued(user=user, one_time_password=one_time)

    def change(
        self, name: str, change: Change, *, by: str, check: Callable[[User], None] = lambda _user: None
    ) -> Issued:
        """Change somebody; the audit keeps what was and what is. Disabling and a reset end all their log-ins.

        ``check`` may refuse the person as they are now.
        """
        self._refuse_of_outside(self.get(name), change)
        one_time = secrets.token_urlsafe(ONE_TIME_BYTES) if change.reset_password else None
        made = None if one_time is None else self._hash(one_time)
        with self._store.changing:
            before = self.get(name)
            check(before)
            after = replace(
                before,
                roles=before.roles if change.roles is None else _some(change.roles),
                is_disabled=before.is_disabled if change.is_disabled is None else change.is_disabled,
                is_break_glass=before.is_break_glass if change.is_break_glass is None else change.is_break_glass,
                password_hash=made or before.password_hash,
                must_change_password=before.must_change_password or one_time is not None,
            )
            self._refuse_no_admin(after)
            ends = after.is_disabled or one_time is not None
            detail: dict[str, object] = {"user": before.name, "before": _told(before), "after": _told(after)}
            event = Event(actor=by, action=CHANGE, detail=detail | {"password_reset": one_time is not None})
            self._store.write(save=[after], drop=self._store.logins_of(before) if ends else [], event=event)
        return Issued(user=after, one_time_password=one_time)

    def _refuse_taken(self, name: str) -> None:
        if name_key(name) in self._store.users:
            msg = "somebody has this name, or had it"
            raise NameTakenError(msg, field="name", value=name, bound="a name that nobody had")

    def _refuse_no_admin(self, after: User) -> None:
        """Refuse to leave nobody who could make another administrator."""
        others = (user for user in self._store.users.values() if user.key != after.key)
        if not any(_administers(user) for user in (*others, after)):
            msg = "nobody would be left who may administer: give somebody else the role first"
            raise LastAdminError(msg, field="name", value=after.name)

    @staticmethod
    def _refuse_of_outside(user: User, change: Change) -> None:
        if user.issuer is not None and (change.roles is not None or change.reset_password or change.is_break_glass):
            msg = "roles and password of this person are the identity provider's: they may be disabled here, no more"
            raise OutsideUserError(msg, field="name", value=user.name)


def _administers(user: User) -> bool:
    return Role.ADMIN in user.roles and not user.is_disabled and user.password_hash is not None


def _some(roles: Iterable[Role]) -> frozenset[Role]:
    found = frozenset(roles)
    if not found:
        bound = f"at least one of {', '.join(Role)}"
        raise BoundError(f"roles must be {bound}", field="roles", value="none", bound=bound)
    return found


def _told(user: User) -> dict[str, object]:
    return {
        "roles": sorted(user.roles),
        "is_disabled": user.is_disabled,
        "is_break_glass": user.is_break_glass,
        "must_change_password": user.must_change_password,
    }
