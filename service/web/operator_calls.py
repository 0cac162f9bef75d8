"""The two kinds of calls that act on a running session: one needs a name and a condition, the other is never refused.

What may lead to a permit, and everything else that changes a session, is done in the name of the logged-in person and
only where the session's ETag still matches ``If-Match``. What takes permission away (disarm, hold, stop) needs neither:
it runs on threads of its own, so that no other call can delay it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Annotated, TypeVar

from fastapi import Depends

from engine.core.signals import HeadDirection
from service.access.request.identity import RequestCaller
from service.core.conditional import Precondition
from service.core.permissions import Permission
from service.core.schemas import sessions
from service.engine_host.protocols import CommandName
from service.sessions.lifecycle.operator_commands import OperatorCommands
from service.sessions.lifecycle.runner import SessionRunner
from service.web import dependencies
from service.web.dependencies import Services
from service.web.middleware.reserved_threads import ReservedThreads

AnswerT = TypeVar("AnswerT")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OperatorCall:
    """A call that changes a session in the name of an operator."""

    caller: RequestCaller
    services: Services
    if_match: Precondition

    @property
    def commands(self) -> OperatorCommands:
        """What operators tell the running session."""
        return self.services.runner.commands

    @contextmanager
    def acting(self, session_id: str, claimed: str) -> Iterator[str]:
        """Give the operator's name, where ``If-Match`` still holds until the end; ``claimed`` is the body's operator.

        Raises
        ------
        PreconditionFailedError
            The session's ETag is another one by now.
        OperatorMismatchError
            The body names another person than the one who is logged in.
        """
        with self.services.revisions.only_if(session_id, self.if_match):
            yield self.caller.checked_actor(claimed)

    def arm(self, session_id: str, request: sessions.ArmRequest) -> sessions.SessionDetail:
        """Arm the gate, with the head direction that the operator confirms; a practice ends with that."""
        self.services.coaching.end_practice(session_id)
        head = None if request.head_direction is None else HeadDirection(request.head_direction)
        seen = request.state
        if seen is None and self.if_match.names_a_state:
            # Read before the ETag is compared: what was decided earlier changed the ETag, what comes later the state.
            seen = self.commands.arming_state(session_id)
        with self.acting(session_id, request.operator) as operator:
            return self.commands.arm(
                session_id,
                operator,
                head=head,
                is_person=self.caller.identity.is_person,
                seen=seen,
                reason=request.reason.strip(),
            )

    @property
    def may_exceed(self) -> bool:
        """Whether the caller is a person who may arm: only such a person goes beyond a fraction's budget."""
        identity = self.caller.identity
        return identity.is_person and Permission.GATE_ARM in identity.permissions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WithdrawalCall:
    """A call that takes permission away: the operator's name is noted, never checked."""

    operator: str
    is_person: bool
    runner: SessionRunner
    threads: ReservedThreads

    async def act(self, session_id: str, action: Callable[[str, str], AnswerT]) -> AnswerT:
        """Run ``action(session_id, operator)`` on a reserved thread; on an ordinary one if the session does not run."""
        call = partial(action, session_id, self.operator)
        return await self.threads.run(call, takes=self.runner.is_running(session_id))

    async def command(self, session_id: str, name: CommandName) -> sessions.SessionDetail:
        """Submit a command to the engine; answer once it is executed."""
        return await self.act(session_id, partial(self._submitted, name))

    def _submitted(self, name: CommandName, session_id: str, operator: str) -> sessions.SessionDetail:
        return self.runner.commands.command(session_id, name, operator, is_person=self.is_person)


# On the event loop, like all dependencies: a request takes one worker thread, for its route.
async def _operator_call(
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    if_match: dependencies.IfMatch,
) -> OperatorCall:
    return OperatorCall(caller=caller, services=services, if_match=if_match)


async def _withdrawal_call(
    operator: dependencies.WithdrawingOperator,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    threads: dependencies.WithdrawalThreads,
) -> WithdrawalCall:
    return WithdrawalCall(
        operator=operator, is_person=caller.identity.is_person, runner=services.runner, threads=threads
    )


Operated = Annotated[OperatorCall, Depends(_operator_call)]
Withdrawing = Annotated[WithdrawalCall, Depends(_withdrawal_call)]
