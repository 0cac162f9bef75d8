"""A session's breathing curve, whom it is about, and its report, as an export has them."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from service.exchange.curve import BreathingCurve
from service.exchange.dicom import Subject
from tests.support.exchange.breaths import breath

BEGUN = datetime(2026, 11, 27, 9, 30, 0, 250_000, tzinfo=UTC)
PDF = b"%PDF-1.7\n% a report of odd length\n%%EOF"


def curve(frames=300, lost=(), missing=(), rate=30.03):
    """A breath of 4 s, without what was not measured (``lost``) and what never came (``missing``)."""
    at = np.arange(frames + len(missing)) / rate
    at = np.delete(at, list(missing))
    thorax, abdomen = 3.0 * np.sin(np.pi / 2.0 * at), 8.0 * np.sin(np.pi / 2.0 * at - 0.3)
    for one in lost:
        thorax[one] = abdomen[one] = np.nan
    gates = np.array(["disarmed"] * 50 + ["hold"] * 50 + ["beam_on"] * (frames - 100), dtype=object)
    reasons = np.array(["disarmed"] * 50 + ["outside_window"] * 50 + [""] * (frames - 100), dtype=object)
    return BreathingCurve(
        time_s=at - at[0],
        motion_mm={"whole": abdomen, "thorax": thorax, "abdomen": abdomen},
        phase=np.full(frames, np.nan),
        gates=gates,
        reasons=reasons,
        is_on=gates == "beam_on",
        begun_at=BEGUN,
    )


def subject(**changed):
    given = {
        "patient_id": "P-0001",
        "session_id": "5e" * 16,
        "plan_label": "LUNG",
        "plan_uid": "1.2.276.0.7230010.3.1",
        "fraction": "FX 3",
        "room": "Linac 2",
        "machine": "TrueBeam",
        "camera": "Xtion 1206",
        "begun_at": BEGUN,
    }
    return Subject(**given | changed)


def breathing_curve():
    """A breath of 8 mm over an exhale at 2 mm; the beam was on from 20 to 50 % of it."""
    at, motion = breath()
    given = dict.fromkeys(("whole", "thorax", "abdomen"), motion + 2.0)
    gates = np.where((motion >= 1.6) & (motion <= 4.0), "beam_on", "hold").astype(object)
    none = np.full(len(at), "", dtype=object)
    return replace(
        curve(),
        time_s=at,
        motion_mm=given,
        phase=np.full(len(at), np.nan),
        gates=gates,
        reasons=none,
        is_on=gates == "beam_on",
    )
