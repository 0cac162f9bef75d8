"""The patient's position against the plan's as a value: compared, signed, or lapsed."""

from dataclasses import dataclass
from typing import NamedTuple

from engine.core.position_check import PositionCheck, PositionTolerance


class Signature(NamedTuple):
    """Who signed which reference's position, and why where it was beyond the tolerance."""

    operator: str
    reference_number: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionState:
    """The comparison of the reference in use with the plan's position, and its signature.

    Attributes
    ----------
    is_required
        Whether the gate may be armed with a signature only: another fraction of the plan has a position.
    reference_number
        Number of the reference in use; None while none is set.
    check
        Its comparison; None without one.
    signature
        The person who signed; None before the signature and after a lapse.
    lapse
        Why a signature of this reference is not valid any more; empty where it is.
    """

    is_required: bool = False
    reference_number: int | None = None
    check: PositionCheck | None = None
    tolerance: PositionTolerance
    signature: Signature | None = None
    lapse: str = ""

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """What keeps the position from being within the tolerance; empty where nothing does, or it is not compared."""
        return () if self.check is None else self.tolerance.shortcomings(self.check)
