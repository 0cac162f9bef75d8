"""What becomes of a fraction whose session was broken off: who may have it begun again, and with what."""

import pytest

from lab.simulated_tps.delivery import Beam
from lab.simulated_tps.fraction import FractionRun, FractionSettings
from lab.simulated_tps.prescription import FractionEndedError, Prescription, SessionOverError
from lab.simulated_tps.session_driver import DeliverySettings

PLAN = Prescription(
    plan_id="p",
    label="PLAN",
    patient_reference="P-1",
    fractions_planned=1,
    beams=(Beam(number=1, name="AP", seconds=1.0),),
)
SETTINGS = FractionSettings(source={"kind": "device"}, calibration_id="c", window={}, delivery=DeliverySettings())


class Caller:
    """Prepares sessions, and remembers what it was asked; each is broken off as soon as it is started."""

    def __init__(self, *, status="interrupted", models=()):
        self.asked = []
        self.status = status
        self.models = models

    def prepare_session(self, _plan_id, request):
        self.asked.append(dict(request))
        return {"id": f"s-{len(self.asked)}"}

    def start(self, _session_id):
        raise SessionOverError(self.status, "as it is")

    def session_models(self, _session_id):
        return iter(self.models)


def run_of(tps, therapist, tmp_path):
    return FractionRun(
        number=3,
        prescription=PLAN,
        settings=SETTINGS,
        tps=tps,
        therapist=therapist,
        folder=tmp_path,
        on_progress=lambda _: None,
    )


def test_without_a_person_a_broken_off_fraction_stays_broken_off(tmp_path):
    tps = Caller()
    with pytest.raises(FractionEndedError, match="only a person"):
        run_of(tps, None, tmp_path)._deliver()
    assert [one["fraction_number"] for one in tps.asked] == [3]
    assert "repeats_fraction" not in tps.asked[0]


def test_a_person_has_it_begun_again_with_the_model_that_was_learned_and_not_for_ever(tmp_path):
    tps, therapist = Caller(models=({"id": "m"},)), Caller()
    with pytest.raises(FractionEndedError, match="broke off 5 sessions"):
        run_of(tps, therapist, tmp_path)._deliver()
    assert len(tps.asked) == 1
    assert len(therapist.asked) == 4
    assert therapist.asked[0]["model_id"] == "m"
    assert therapist.asked[0]["repeats_fraction"]


@pytest.mark.parametrize("status", ["ended", "stopped"])
def test_a_session_that_somebody_closed_is_not_begun_again(status, tmp_path):
    tps, therapist = Caller(status=status), Caller()
    with pytest.raises(FractionEndedError, match=status):
        run_of(tps, therapist, tmp_path)._deliver()
    assert therapist.asked == []
