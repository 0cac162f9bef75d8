"""Schemas of a plan's simulation day: the breathing that the plan was made on."""

import base64
import binascii
from typing import Annotated, Literal, Self

from pydantic import AwareDatetime, Field, SecretStr, StringConstraints, model_validator

from service.core.schemas.base import Answer, Identifier, broken
from service.core.schemas.sessions import OperatorRequest

MOST_FILE = 4_000_000
"""Characters of a file in base64: an hour of a ``.vxp``, half an hour of a waveform."""
SimulationSignal = Literal["whole", "thorax", "abdomen"]


class SimulationRequest(OperatorRequest):
    """Sign what a session's plan was made on: a session that is over, or a file of another system."""

    session_id: Identifier | None = Field(default=None, description="A session of the same patient that is over")
    file: Annotated[str, StringConstraints(max_length=MOST_FILE)] | None = Field(
        default=None,
        description="In base64: `waveform.dcm` of another Tidegate, or an RPM `.vxp`; it must name the patient",
    )
    signal: SimulationSignal | None = Field(
        default=None,
        description="whole of a session when left out; abdomen of `waveform.dcm`, which has no whole; a `.vxp` has one",
    )
    password: SecretStr | None = Field(
        default=None,
        min_length=1,
        max_length=1_000,
        description="The person's own; left out by people of an identity provider, who log in again just before",
    )

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if (self.session_id is None) == (self.file is None):
            raise broken("session_id", self.session_id, "given, or file in its place")
        try:
            _ = self.content
        except binascii.Error as error:
            raise broken("file", str(error), "base64") from error
        return self

    @property
    def content(self) -> bytes | None:
        """The file; None without one."""
        return None if self.file is None else base64.b64decode(self.file, validate=True)


class Simulation(Answer):
    """The simulation day of a session's plan. Nothing of it is applied by itself."""

    of_session: Identifier = Field(description="The session at which it was signed; later ones of its plan have it too")
    origin: Literal["session", "dicom", "vxp"]
    session_id: Identifier | None = Field(description="The session that it is; null for a file")
    file_sha256: str | None = Field(description="Of the file; null for a session")
    begun_at: AwareDatetime | None
    signal: str
    peak_to_peak_mm: float = Field(description="Range of all values: shows a wrong unit or column at once")
    end_exhale_mm: float = Field(description="Median over the breaths")
    end_inhale_mm: float
    period_s: float = Field(description="Median length of a breath")
    lower_percent: float | None = Field(
        description="Lower edge of its window in per cent of the breath, 0 at the end of exhale; null without one"
    )
    upper_percent: float | None
    window_from: Literal["window", "beam", "none"] = Field(
        description="window: the session's own; beam: the levels from the 1st to the 99th per cent with the beam on"
    )
    has_position: bool = Field(
        description="Whether it has a confirmed reference: the position is then compared with it from the start on, "
        "where camera, calibration and regions are the same"
    )
    trace: list[Annotated[list[float], Field(min_length=2, max_length=2)]] = Field(
        max_length=600, description="[s, mm] of its last minute, ten a second"
    )
    signed_by: str
    signed_at: AwareDatetime
    confirmed_by: Literal["password", "login"]
