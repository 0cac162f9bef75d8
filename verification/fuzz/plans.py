"""Targets: RT Plans and RT Ion Plans."""

from collections.abc import Iterator

from service.planning.rt_plan.errors import PlanError
from service.planning.rt_plan.reading import read_plan
from tests.support.planning.dicom_plans import ion_plan, motion, open_lengths, photon_plan, setup, written
from verification.fuzz.target import Target


def plans() -> Iterator[bytes]:
    yield written(photon_plan())
    yield written(ion_plan(), "implicit little")
    yield written(open_lengths(photon_plan()))
    yield written(photon_plan(PatientSetupSequence=[setup(1, motion())]), "deflated")


TARGETS = (
    Target(
        name="plan",
        reads="RT Plans and RT Ion Plans, in every transfer syntax that is taken (`service.planning.rt_plan.reading`)",
        read=read_plan,
        refusals=(PlanError,),
        seeds=plans,
        max_bytes=8192,
        words=("DICM", "\\xfe\\xff\\x00\\xe0", "\\xfe\\xff\\xdd\\xe0", "\\xff\\xff\\xff\\xff", "SQ", "ISO_IR 192"),
    ),
)
