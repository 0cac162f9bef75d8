"""Refusals of plan files and of sessions from a plan. They never contain values of patient elements.

`field` is the path of the DICOM element, with tag and name: ``(300A,00B0)[2].(300A,00C0) Beam Number``.
"""

from typing import ClassVar

from engine.core.errors import TidegateError


class PlanError(TidegateError):
    """The file is a plan with an impossible or unusable value; `field`, `value` and `bound` state it."""

    code: ClassVar[str] = "plan_invalid"

    def __init__(
        self, message: str, *, field: str | None = None, value: str | None = None, bound: str | None = None
    ) -> None:
        self.field = field
        self.value = value
        self.bound = bound
        super().__init__(message)


class PlanFormatError(PlanError):
    """The file is no DICOM file or breaks the encoding rules."""

    code = "plan_not_dicom"


class PlanTruncatedError(PlanError):
    """The file ends before the length that it declares."""


class PlanKindError(PlanError):
    """The file is DICOM, but neither an RT Plan nor an RT Ion Plan."""

    code = "plan_wrong_kind"


class PlanBoundError(PlanError):
    """The file exceeds the bounds on elements, items, depth or bytes."""

    code = "plan_too_complex"


class PlanConflictError(PlanError):
    """A stored plan has this SOP Instance UID and other content."""


class PlanGatingError(PlanError):
    """The session's window does not match the technique that the plan prescribes."""


class PlanPositionError(PlanError):
    """The plan's Patient Position is not supported, or contradicts the session's head direction."""


class PlanRejectedError(PlanError):
    """The plan's approval status is REJECTED."""


class PlanContradictedError(PlanError):
    """A later file with the plan's UID has other content."""


class FractionDoneError(PlanError):
    """A session of this fraction was started before."""


class OverrideNotPersonalError(PlanError):
    """A machine requested an override; only a person may override the plan."""

    code = "override_needs_person"


class PlanBusyError(PlanError):
    """The service reads its maximum number of plans at a time already."""

    headers: ClassVar[dict[str, str]] = {"Retry-After": "1"}
