"""Why a simulated fraction does not go on."""

from engine.errors import TidegateError


class TpsError(TidegateError):
    """The simulated planning system cannot go on; the message says why."""

    code = "tps_failed"


class FractionEndedError(TpsError):
    """The fraction ends before all of it is delivered."""

    code = "tps_fraction_ended"


class SessionOverError(TpsError):
    """The session is over, while the fraction is not."""

    code = "tps_session_over"

    def __init__(self, status: str, detail: str) -> None:
        self.status = status
        super().__init__(f"the session is {status}: {detail or 'no reason given'}")
