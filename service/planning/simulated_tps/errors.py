"""Errors that end a simulated fraction."""

from engine.core.errors import TidegateError


class TpsError(TidegateError):
    """The simulated planning system cannot continue; the message gives the reason."""

    code = "tps_failed"


class FractionEndedError(TpsError):
    """The fraction ends before all its beams are delivered."""

    code = "tps_fraction_ended"


class SessionOverError(TpsError):
    """The session has ended before the fraction is delivered."""

    code = "tps_session_over"

    def __init__(self, status: str, detail: str) -> None:
        self.status = status
        super().__init__(f"the session is {status}: {detail or 'no reason given'}")
