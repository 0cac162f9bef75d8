"""The event loop's turns, as the application reports them to its engine."""

import threading

from service.core.settings.settings import Settings
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.fake_engine import FakeEngine
from tests.support.waiting import eventually


class CountingEngine(FakeEngine):
    """Counts the turns that are reported."""

    def __init__(self) -> None:
        super().__init__()
        self.turns = 0

    def note_server_turn(self, turned_ns: int) -> None:
        super().note_server_turn(turned_ns)
        self.turns += 1


def test_every_turn_of_the_event_loop_is_reported_and_none_while_it_is_blocked(tmp_path):
    engine = CountingEngine()
    app = create_app(Settings(data_dir=tmp_path / "data"), lambda _: engine)
    with PeopleClient(app) as client:
        eventually(lambda: engine.turns > 3)
        is_blocked, go_on = threading.Event(), threading.Event()

        def block() -> None:
            is_blocked.set()
            go_on.wait()

        client.portal.start_task_soon(_run, block)
        assert is_blocked.wait(60.0)
        before = engine.turns, engine.server_turned_ns
        assert not threading.Event().wait(0.2)
        assert (engine.turns, engine.server_turned_ns) == before
        go_on.set()
        eventually(lambda: engine.turns > before[0])
    assert client.portal is None
    ended = engine.turns
    assert not threading.Event().wait(0.1)
    assert engine.turns == ended


async def _run(block) -> None:
    block()
