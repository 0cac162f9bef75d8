"""A commit without an answer, or not done: each row is written once, and nothing is removed too early."""

from collections.abc import Callable
from contextlib import contextmanager

import pytest
from sqlalchemy import select
from sqlalchemy.exc import OperationalError

from engine.core.gate_state import GateState, HoldReason
from service.storage.audit import AuditRow
from service.storage.database.engine import Database
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.fake_engine import make_model
from tests.support.service.model_events import SWAPPED
from tests.support.waiting import eventually

pytestmark = [pytest.mark.both_databases, pytest.mark.slow]

NEWEST = select(AuditRow.action).order_by(AuditRow.sequence.desc()).limit(1)
WRITTEN = ("gate.transition", "model.swapped", "model.in_use", "session.close")


class Answers:
    """Loses the answer of the first commit that ends with each of the actions named, or the commit itself."""

    def __init__(self) -> None:
        self.lost: list[str] = []
        self.wanted: set[str] = set()
        self.is_committed = True
        self.then: Callable[[], object] = lambda: None

    def of(self, real):
        @contextmanager
        def write(database):
            with real(database) as db:
                yield db
                action = db.scalar(NEWEST)
                is_lost = action in self.wanted - set(self.lost)
                if is_lost and not self.is_committed:
                    self._lose(action)
            if is_lost:
                self._lose(action)

        return write

    def _lose(self, action):
        self.lost.append(action)
        self.then()
        raise OperationalError("COMMIT", {}, Exception("the server has not answered for 1 s"))


@pytest.fixture
def answers(running, monkeypatch):
    answers = Answers()
    monkeypatch.setattr(Database, "write", answers.of(Database.write))
    return answers


@pytest.mark.parametrize("is_committed", [True, False])
def test_whatever_became_of_a_commit_it_is_written_once(client, session_id, running, answers, is_committed, settings):
    answers.wanted, answers.is_committed = set(WRITTEN), is_committed
    running.transition(GateState.HOLD, HoldReason.DWELL)
    eventually(lambda: len(answers.lost) == 1 and HoldReason.AUDIT_BEHIND in running.faults)
    running.notices.put(SWAPPED)
    eventually(lambda: len(answers.lost) == 2)
    running.model = make_model(1)
    eventually(lambda: len(answers.lost) == 3)
    act(client, session_id, "stop")
    assert answers.lost == list(WRITTEN)
    found = [row["action"] for row in audit_rows(client)]
    assert [found.count(action) for action in WRITTEN] == [2, 1, 1, 1]  # the engine's end is a transition too
    assert len(list((settings.data_dir / "models").iterdir())) == 1
    assert audit_rows(client, "session.close")[0]["detail"]["summary"]["transitions"] == 2
    assert 'tidegate_gate_transitions_total{reason="dwell",to_state="hold"} 1.0' in client.get("/metrics").text
    assert client.get("/api/v1/audit/verify").json()["is_intact"]


def test_what_came_while_an_answer_was_lost_is_written_behind_it(client, session_id, running, answers):
    answers.wanted, answers.then = {"gate.transition"}, lambda: running.transition(GateState.BEAM_ON)
    running.transition(GateState.HOLD, HoldReason.DWELL)
    eventually(lambda: len(audit_rows(client, "gate.transition")) > 1)
    act(client, session_id, "stop")
    states = [row["detail"]["to_state"] for row in audit_rows(client, "gate.transition")]
    assert states == ["hold", "beam_on", "hold"]


def test_the_samples_stream_stays_until_the_end_is_committed(client, session_id, running, answers, settings):
    stream = settings.data_dir / "samples" / f"{session_id}.arrows"
    seen = []
    answers.wanted, answers.is_committed = {"session.close"}, False
    answers.then = lambda: seen.append(stream.exists())
    running.frame()
    act(client, session_id, "stop")
    assert seen == [True]
    assert not stream.exists()
    assert stream.with_suffix(".parquet").exists()
