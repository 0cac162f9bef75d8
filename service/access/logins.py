"""Log-ins: opened by a password or by an identity provider, and ended."""

import hashlib
import secrets
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import timedelta

from service.access import lockout
from service.access.ledger import RefusalLedger
from service.access.names import check_name, name_key
from service.access.passwords import Hashing, check_password
from service.access.permissions import Role
from service.access.records import Attempts, Login, User, Way
from service.access.store import AccessStore
from service.audit import Event
from service.errors import LockedOutError, LoginFailedError, NotFoundError, OutsideUserError, WrongPasswordError

LOGIN = "user.login"
BREAK_GLASS = "user.break_glass"
LOGOUT = "user.logout"
PASSWORD = "user.password"  # noqa: S105 - the name of an action
TOKEN_BYTES = 32
MOST_LOGINS = 16
LocalRule = Callable[[User, str | None], bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """Somebody tries to log in; ``repr`` shows no password."""

    name: str
    password: str
    address: str
    reason: str | None = None
    former_token: str | None = None

    def __repr__(self) -> str:
        return f"Attempt(name={self.name!r}, address={self.address!r})"


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedLogin:
    """A log-in that was just opened; the token goes to the browser and nowhere else."""

    token: str
    login: Login
    user: User

    def __repr__(self) -> str:
        return f"OpenedLogin(user={self.user.name!r})"


def hashed(secret: str) -> str:
    """Hash a token of 256 random bits: what is as random needs no salt, and no time."""
    return hashlib.sha256(secret.encode()).hexdigest()


class LoginDesk:
    """Opens and ends log-ins; everything is audited in the transaction that makes it true."""

    def __init__(
        self, store: AccessStore, hashing: Hashing, ledger: RefusalLedger, *, lasts: timedelta, idle: timedelta
    ) -> None:
        self._store = store
        self._hashing = hashing
        self._ledger = ledger
        self._lasts = lasts
        self.idle = idle
        self.local_rule: LocalRule = lambda _user, _reason: False
        """Asked once the password was right: whether a local log-in is a breaking of the glass; may refuse it."""

    def refuse_locked(self, name: str, address: str) -> None:
        """Raise LockedOutError where this name or this address has to wait; known or not, it is the same."""
        now = self._store.now()
        subjects = (lockout.name_subject(name), lockout.address_subject(address))
        left_s = max(lockout.wait_s(self._store.attempts.get(subject), now) for subject in subjects)
        if left_s > 0:
            self._ledger.count("locked out", address)
            raise LockedOutError(left_s)

    def log_in(self, attempt: Attempt) -> OpenedLogin:
        """Check a name and a password, and open a log-in; run where nothing waits for it.

        The password is checked exactly once whoever is named, against nobody's where there is nobody, so that neither
        the answer nor its time tells which names there are.
        """
        self.refuse_locked(attempt.name, attempt.address)
        user = self._store.users.get(name_key(attempt.name))
        is_right = self._hashing.verify(None if user is None else user.password_hash, attempt.password)
        if user is None or not is_right or user.is_disabled:
            self._note_failure(attempt, user)
            raise LoginFailedError
        is_break_glass = self.local_rule(user, attempt.reason)
        with self._store.changing:
            user = self._store.users[user.key]
            if user.is_disabled:  # while the password was checked
                raise LoginFailedError
            if user.password_hash is not None and self._hashing.is_outdated(user.password_hash):
                user = replace(user, password_hash=self._hashing.hash(attempt.password))
            detail: dict[str, object] = {"way": "password"}
            if is_break_glass:
                detail |= {"reason": attempt.reason}
            action = BREAK_GLASS if is_break_glass else LOGIN
            return self._open(user, attempt.address, "password", action, detail, former=attempt.former_token)

    def open_outside(
        self, *, issuer: str, subject: str, name: str, name_if_taken: str, roles: frozenset[Role], address: str
    ) -> OpenedLogin:
        """Open a log-in for somebody whom an identity provider knows; the roles are those it gives today."""
        with self._store.changing:
            found = next(
                (one for one in self._store.users.values() if (one.issuer, one.subject) == (issuer, subject)), None
            )
            if found is not None and found.is_disabled:
                raise LoginFailedError
            if found is None:
                chosen = check_name(name_if_taken if name_key(name) in self._store.users else name)
                if name_key(chosen) in self._store.users:
                    raise LoginFailedError
                found = User(
                    name=chosen,
                    password_hash=None,
                    roles=roles,
                    issuer=issuer,
                    subject=subject,
                    created_at=self._store.now(),
                )
            detail: dict[str, object] = {
                "way": "oidc",
                "issuer": issuer,
                "subject": subject,
                "roles": sorted(roles),
                "roles_before": sorted(found.roles),
            }
            return self._open(replace(found, roles=roles), address, "oidc", LOGIN, detail)

    def _open(
        self,
        user: User,
        address: str,
        way: Way,
        action: str | None,
        detail: dict[str, object],
        *,
        former: str | None = None,
    ) -> OpenedLogin:
        now = self._store.now()
        token = secrets.token_urlsafe(TOKEN_BYTES)
        login = Login(
            id=uuid.uuid4().hex,
            token_sha256=hashed(token),
            user_key=user.key,
            way=way,
            address=address,
            is_break_glass=action == BREAK_GLASS,
            created_at=now,
            expires_at=now + self._lasts,
            seen_at=now,
        )
        user = replace(user, last_login_at=now)
        mine = self._store.logins_of(user)
        dropped: list[Login | Attempts] = list(mine[: max(0, len(mine) - MOST_LOGINS + 1)])
        if former is not None and (old := self._store.logins.get(hashed(former))) is not None and old not in dropped:
            dropped.append(old)
        failures = self._store.attempts.get(lockout.name_subject(user.name))
        if failures is not None:
            dropped.append(failures)
        told = {"roles": sorted(user.roles), **detail, "login_id": login.id, "address": address}
        event = None if action is None else Event(actor=user.name, action=action, detail=told)
        self._store.write(save=[user, login], drop=dropped, event=event)
        return OpenedLogin(token=token, login=login, user=user)

    def _note_failure(self, attempt: Attempt, user: User | None) -> None:
        """Count it for the name and the address; in memory also where the database does not take it."""
        store = self._store
        with store.changing:
            now = store.now()
            subjects = (lockout.name_subject(attempt.name), lockout.address_subject(attempt.address))
            failed = [lockout.failed_again(store.attempts.get(subject), subject, now) for subject in subjects]
            store.attempts.update({one.subject: one for one in failed})
            dropped = _crowded_out(store.attempts, keep=set(subjects))
            if user is None:
                self._ledger.count("failed log-ins of unknown names", attempt.address)
            else:
                detail = {"address": attempt.address, "failures": failed[0].failures, "is_disabled": user.is_disabled}
                self._ledger.note(Event(actor=user.name, action=LOGIN, outcome="refused", detail=detail))
            store.write(save=failed, drop=dropped)

    def log_out(self, login: Login) -> None:
        """End one's own log-in."""
        self.end(login, by=self._store.users[login.user_key].name)

    def end(self, login: Login, *, by: str) -> None:
        """End a log-in; its open sockets close within seconds."""
        name = self._store.users[login.user_key].name
        event = Event(actor=by, action=LOGOUT, detail={"login_id": login.id, "user": name})
        self._store.write(drop=[login], event=event)

    def find(self, user: User, login_id: str) -> Login:
        """Find a person's log-in, or raise NotFoundError."""
        for login in self._store.logins_of(user):
            if login.id == login_id:
                return login
        msg = "there is no such log-in"
        raise NotFoundError(msg, field="login_id", value=login_id)

    def change_password(self, user: User, old: str, new: str, *, address: str, keep: Login | None) -> None:
        """Change one's own password; ends the person's other log-ins. Run where nothing waits for it."""
        if user.issuer is not None:
            msg = "the password is kept by the identity provider: change it there"
            raise OutsideUserError(msg)
        self.refuse_locked(user.name, address)
        check_password(new, user.name)
        if not self._hashing.verify(user.password_hash, old):
            self._note_failure(Attempt(name=user.name, password="", address=address), user)
            msg = "the old password is wrong"
            raise WrongPasswordError(msg, field="old_password", bound="the present password")
        if new == old:
            msg = "the new password must be another one"
            raise WrongPasswordError(msg, field="new_password", bound="another one than the old")
        made = self._hashing.hash(new)
        with self._store.changing:
            now = self._store.users[user.key]
            changed = replace(now, password_hash=made, must_change_password=False)
            others = [one for one in self._store.logins_of(now) if keep is None or one.id != keep.id]
            self._store.write(save=[changed], drop=others, event=Event(actor=user.name, action=PASSWORD))


def _crowded_out(attempts: dict[str, Attempts], keep: set[str]) -> list[Attempts]:
    """Return who is forgotten first where there are too many: those who need not wait, the oldest first."""
    beyond = len(attempts) - lockout.MOST_SUBJECTS
    if beyond <= 0:
        return []
    others = sorted(
        (one for one in attempts.values() if one.subject not in keep),
        key=lambda one: (one.locked_until is not None, one.last_at),
    )
    return others[:beyond]
