"""Why a file is no plan, or no session comes of one. What a patient's elements say is never part of it.

`field` is the DICOM tag with its name, and where it stands: ``(300A,00B0)[2].(300A,00C0) Beam Number``.
"""

from typing import ClassVar

from engine.errors import TidegateError


class PlanError(TidegateError):
    """The file is a plan by its kind, and cannot be true or cannot be used."""

    code: ClassVar[str] = "plan_invalid"

    def __init__(
        self, message: str, *, field: str | None = None, value: str | None = None, bound: str | None = None
    ) -> None:
        self.field = field
        self.value = value
        self.bound = bound
        super().__init__(message)


class PlanFormatError(PlanError):
    """The file is no DICOM file, or is not written as one has to be."""

    code = "plan_not_dicom"


class PlanTruncatedError(PlanError):
    """The file ends before what it says is in it."""

    code = "plan_truncated"


class PlanKindError(PlanError):
    """The file is DICOM, and no RT Plan or RT Ion Plan."""

    code = "plan_wrong_kind"


class PlanBoundError(PlanError):
    """The file asks for more work or memory than any plan needs."""

    code = "plan_too_complex"


class PlanConflictError(PlanError):
    """Another plan has this SOP Instance UID."""

    code = "plan_conflict"


class PlanGatingError(PlanError):
    """The session's window is of another technique than the plan prescribes."""

    code = "plan_gating"


class PlanRejectedError(PlanError):
    """The plan was rejected where it was made."""

    code = "plan_rejected"


class PlanContradictedError(PlanError):
    """A later file with the plan's UID says something else."""

    code = "plan_contradicted"


class FractionDoneError(PlanError):
    """A session of this fraction has been started already."""

    code = "fraction_done"


class OverrideNotPersonalError(PlanError):
    """A machine asks to go against the plan; a person has to."""

    code = "override_needs_person"


class PlanBusyError(PlanError):
    """As many plans are being read as the service reads at once."""

    code = "plan_busy"
    headers: ClassVar[dict[str, str]] = {"Retry-After": "1"}
