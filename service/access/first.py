"""The first start: nobody could log in to make the first person, so the service makes one."""

from collections.abc import Callable

from service.access.people import PeopleDesk
from service.access.permissions import Role
from service.access.store import AccessStore
from service.audit import SYSTEM

FIRST_NAME = "admin"
TellFirst = Callable[[str, str], None]
"""Told the name and the password, which stand nowhere else."""


def make_first_admin(store: AccessStore, people: PeopleDesk, tell: TellFirst) -> None:
    """Make an administrator where there is nobody at all, with a password to be changed at the first log-in.

    It is a break-glass account: at a site whose people log in at an identity provider no other password counts.
    """
    if store.users:
        return
    issued = people.add(FIRST_NAME, [Role.ADMIN], by=SYSTEM, is_break_glass=True)
    tell(issued.user.name, issued.one_time_password or "")
