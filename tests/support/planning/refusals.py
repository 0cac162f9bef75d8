"""Reading a plan that is refused."""

import pytest

from service.planning.rt_plan.errors import PlanError
from service.planning.rt_plan.reading import read_plan


def refused(content: bytes) -> PlanError:
    with pytest.raises(PlanError) as caught:
        read_plan(content)
    assert str(caught.value)
    assert caught.value.bound
    return caught.value
