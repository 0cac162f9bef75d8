"""What the simulated record-and-verify system does about what it sees: it goes by the frames, never by hope."""

from datetime import UTC, datetime

import pytest

from lab.simulated_tps.delivery import Beam, DeliveredBeams
from lab.simulated_tps.prescription import FractionEndedError, SessionOverError, TpsError
from lab.simulated_tps.session_driver import DeliverySettings, FractionEvents, SessionDriver
from service.client import ProblemError, UnreachableError

FRAME_US = 100_000
SETTINGS = DeliverySettings(between_s=0.3, settle_s=0.2, beam_timeout_s=5.0, restart_wait_s=3.0)
REFUSED = ProblemError(409, {"code": "command_refused"}, {})


class Room:
    """A service with one session, as the stream and the calls show it; a beam that is on whenever it may be."""

    def __init__(self, *, status="running"):
        self.status = status
        self.frame = 0
        self.is_armed = self.has_reference = False
        self.holds = []
        self.fault = None
        self.calls = []
        self.present_at = []
        """Frames at which somebody reported their presence."""
        self.becomes = {}
        """What a call becomes, once: an error before it is done, or ``(error,)`` once it is done."""
        self.at_frame = {}
        self.age_ms = 4.0
        self.lag_s = 0.0
        """How long messages wait in a buffer on their way."""
        self.somebody = "key: tps"
        self.form = "full"
        self.between = None
        """What happens two frames behind the next hold."""

    def live(self, *, session_id, after_frame, form):
        assert (session_id, form) == ("s", "full")
        self.calls.append(f"live after {after_frame}")
        while self.status == "running":
            self.frame += 1
            self.at_frame.pop(self.frame, lambda: None)()
            if self.status == "running":
                yield self.sample()
        yield {"type": "idle"}

    def sample(self):
        is_on = self.is_armed and self.fault is None and not self.holds
        state = "fault" if self.fault else "disarmed" if not self.is_armed else "beam_on" if is_on else "hold"
        return {
            "type": "sample",
            "form": self.form,
            "session_id": "s",
            "frame_index": self.frame,
            "timestamp_us": self.frame * FRAME_US,
            "age_ms": self.age_ms,
            "sent_at": datetime.fromtimestamp(self.frame * FRAME_US / 1e6 - self.lag_s, UTC).isoformat(),
            "session_status": "running",
            "state": "measuring" if self.frame > 2 else "training",
            "training": None,
            "whole_mm": 0.0,
            "gate": state,
            "is_armed": self.is_armed and self.fault is None,
            "line_on": is_on,
            "hold_reason": self.fault or (None if is_on else "operator_hold" if self.holds else "disarmed"),
            "hold_text": None,
            "hold_detail": "",
            "operator_holds": list(self.holds),
        }

    def read_session(self, _session_id):
        proposed = [{"at": "end_exhale", "level": -1.25}] if self.frame > 6 else []
        detail = {"status": self.status, "status_detail": "as it is"}
        return {**detail, "has_reference": self.has_reference, "reference_proposals": proposed}

    def start(self, _session_id):
        self._call("start", lambda: setattr(self, "status", "running"))

    def set_reference(self, _session_id, *, level_seen, setup_confirmed):
        assert (level_seen, setup_confirmed) == (-1.25, True)
        return self._call("reference", lambda: setattr(self, "has_reference", True))

    def arm(self, _session_id, **_confirmed):
        return self._call("arm", lambda: setattr(self, "is_armed", True))

    def hold(self, _session_id):
        def held():
            self.holds += [] if self.somebody in self.holds else [self.somebody]
            if self.between is not None:
                self.at_frame[self.frame + 2], self.between = self.between, None

        return self._call("hold", held)

    def release(self, _session_id):
        return self._call("release", lambda: self.holds.remove(self.somebody))

    def me(self):
        return {"name": self.somebody}

    def stop(self, _session_id):
        return self._call("stop", lambda: setattr(self, "status", "stopped"))

    def note_presence(self, _session_id):
        self.present_at.append(self.frame)
        if self.frame % 2:
            raise UnreachableError("lost")

    def acknowledge(self, _session_id):
        def seen():
            self.fault, self.is_armed = None, False

        return self._call("acknowledge", seen)

    def _call(self, name, done):
        self.calls.append(name)
        becomes = self.becomes.pop(name, None)
        if isinstance(becomes, Exception):
            raise becomes
        done()
        if becomes is not None:
            raise becomes[0]
        return {"gate": {"operator_holds": list(self.holds)}}

    def done(self, *leaving_out):
        return [call for call in self.calls if not call.startswith("live") and call not in leaving_out]


BEAMS = (Beam(number=1, name="AP", seconds=1.0), Beam(number=2, name="LAT", seconds=0.5))


def treat(room, *, has_therapist=True, therapist=None, beams=BEAMS, events=None):
    therapist = therapist or (room if has_therapist else None)
    delivered = DeliveredBeams(beams)
    stretch = SessionDriver(
        "s",
        tps=room,
        therapist=therapist,
        delivered=delivered,
        events=events or FractionEvents(),
        settings=SETTINGS,
        on_progress=lambda _: None,
        sleep=lambda _: None,
        now_s=lambda: room.frame * FRAME_US / 1e6,
    )
    stretch.run()
    return delivered, stretch


def test_a_therapist_who_takes_part_is_present_every_second_and_a_key_never_is():
    room = Room(status="created")
    room.has_reference = True
    treat(room, has_therapist=False)
    assert room.present_at == []
    therapist = Room()
    room = Room(status="created")
    room.has_reference = True
    treat(room, therapist=therapist)
    assert len(therapist.present_at) >= room.frame * FRAME_US // 1_000_000
    assert room.present_at == []


def test_no_one_sees_old_frames():
    room, therapist = Room(status="created"), Room()
    room.age_ms = 5_000.0
    room.at_frame[30] = lambda: setattr(room, "status", "stopped")
    with pytest.raises(SessionOverError):
        treat(room, therapist=therapist)
    assert therapist.present_at == []


WHOLE = ["start", "reference", "arm", "hold", "release", "hold", "stop"]


def test_a_fraction_is_started_armed_delivered_beam_by_beam_and_stopped():
    room = Room()
    delivered, stretch = treat(room)
    assert room.done() == WHOLE
    assert delivered.is_done
    assert [one.delivered_s for one in delivered.reports()] == pytest.approx([1.0, 0.5], abs=0.21)
    assert stretch.clock.on_s == pytest.approx(1.5, abs=0.41)


@pytest.mark.parametrize("becomes", [UnreachableError("lost"), REFUSED], ids=["lost", "refused"])
def test_who_leaves_stops_the_session_although_the_hold_failed(becomes):
    room = Room()
    room.becomes = {"arm": RuntimeError("broken"), "hold": becomes}
    with pytest.raises(RuntimeError):
        treat(room)
    assert (room.done()[-2:], room.status) == (["hold", "stop"], "stopped")


def test_between_beams_the_beam_is_held_for_as_long_as_the_gantry_takes():
    room = Room()
    treat(room)
    at = room.frame
    assert at * FRAME_US >= (1.5 + SETTINGS.between_s) * 1e6


@pytest.mark.parametrize("call", ["arm", "reference", "release"])
@pytest.mark.parametrize("becomes", [UnreachableError("lost"), REFUSED], ids=["never sent", "refused"])
def test_what_was_not_done_is_asked_for_again_once_the_frames_show_it(call, becomes):
    room = Room()
    room.becomes[call] = becomes
    delivered, _ = treat(room)
    assert delivered.is_done
    assert room.calls.count(call) == 2


def test_arming_whose_answer_was_lost_is_seen_in_the_frames_and_not_asked_for_again():
    room, events = Room(), FractionEvents()
    room.becomes["arm"] = (UnreachableError("lost"),)
    delivered, _ = treat(room, events=events)
    assert delivered.is_done
    assert (room.done(), events.lost_answers) == (WHOLE, 1)


def test_a_start_whose_answer_was_lost_is_not_started_twice():
    room = Room()
    room.becomes["start"] = (UnreachableError("lost"),)
    treat(room)
    assert room.done() == WHOLE


def test_without_a_person_the_reference_is_waited_for_and_not_set():
    room = Room()
    room.at_frame[15] = lambda: setattr(room, "has_reference", True)
    delivered, _ = treat(room, has_therapist=False)
    assert delivered.is_done
    assert room.done() == [call for call in WHOLE if call != "reference"]


def test_a_reference_that_no_person_sets_ends_in_a_time_out():
    room = Room()
    with pytest.raises(FractionEndedError, match="no beam for 5 s"):
        treat(room, has_therapist=False)
    assert "arm" not in room.calls


def test_a_hold_without_an_answer_is_repeated_at_the_next_frame():
    room = Room()
    room.becomes["hold"] = UnreachableError("lost")
    treat(room)
    assert room.done() == ["start", "reference", "arm", "hold", "hold", "release", "hold", "stop"]


def test_without_a_person_a_fault_ends_the_fraction_with_the_beam_held():
    room = Room()
    room.has_reference = True
    room.at_frame[12] = lambda: setattr(room, "fault", "frame_stale")
    with pytest.raises(FractionEndedError, match="frame_stale"):
        treat(room, has_therapist=False)
    assert room.done()[-2:] == ["hold", "stop"]
    assert "acknowledge" not in room.calls


def test_a_person_acknowledges_a_fault_and_the_rest_of_the_beam_is_delivered():
    room, events = Room(), FractionEvents()
    room.at_frame[12] = lambda: setattr(room, "fault", "frame_stale")
    delivered, _ = treat(room, has_therapist=True, events=events)
    assert delivered.is_done
    assert room.done() == ["start", "reference", "arm", "acknowledge", "arm", "hold", "release", "hold", "stop"]
    assert (events.faults, events.acknowledged) == (["frame_stale"], 1)


def test_a_fault_between_beams_leads_to_the_next_beam():
    room = Room()
    room.somebody = "A. Therapist"
    treated = []

    def fault_between():
        room.fault = "frame_stale"
        treated.append(list(room.holds))

    room.between = fault_between
    delivered, _ = treat(room, has_therapist=True)
    assert treated == [["A. Therapist"]]
    assert [one.delivered_s for one in delivered.reports()] == pytest.approx([1.0, 0.5], abs=0.21)


def test_faults_without_end_are_not_acknowledged_without_end():
    room = Room()
    for frame in range(8, 400, 8):
        room.at_frame[frame] = lambda: setattr(room, "fault", "latency_high")
    with pytest.raises(FractionEndedError, match="10 faults"):
        treat(room, has_therapist=True, beams=(Beam(number=1, name="AP", seconds=60.0),))
    assert room.calls.count("acknowledge") == 10


def test_who_disarms_has_a_reason_and_no_machine_arms_again():
    room = Room()
    room.has_reference = True
    room.at_frame[12] = lambda: setattr(room, "is_armed", False)
    with pytest.raises(FractionEndedError, match="disarmed"):
        treat(room, has_therapist=False)
    assert room.calls.count("arm") == 1


def test_somebody_else_s_hold_is_theirs_to_release():
    room = Room()
    room.at_frame[10] = lambda: room.holds.append("C. Nurse")
    room.at_frame[20] = room.holds.clear
    delivered, _ = treat(room)
    assert delivered.is_done
    assert room.done() == WHOLE


def test_a_hold_that_no_person_can_release_ends_in_a_time_out():
    room = Room()
    room.at_frame[10] = lambda: room.holds.append("C. Nurse")
    with pytest.raises(FractionEndedError, match="no beam for 5 s"):
        treat(room)
    assert "release" not in room.calls


@pytest.mark.parametrize("first", [True, False])
def test_beside_a_person_s_hold_between_beams_the_planning_system_releases_its_own_and_waits(first):
    room = Room()

    def nurse():
        room.holds.insert(0 if first else 1, "C. Nurse")
        room.at_frame[room.frame + 30] = lambda: room.holds.remove("C. Nurse")

    room.between = nurse
    delivered, _ = treat(room)
    assert delivered.is_done
    assert room.done() == WHOLE


def test_a_hold_between_beams_that_somebody_released_is_taken_again():
    room = Room()
    room.between = room.holds.clear
    treat(room)
    assert room.done() == ["start", "reference", "arm", "hold", "hold", "release", "hold", "stop"]


def test_nothing_is_done_because_of_a_frame_that_is_old():
    room = Room()
    room.age_ms = 60_000.0
    room.at_frame[100] = lambda: setattr(room, "status", "ended")
    with pytest.raises(SessionOverError):
        treat(room)
    assert room.done() == ["start"]


def test_frames_that_waited_on_their_way_lead_to_nothing_but_a_hold():
    room = Room()
    room.at_frame[3] = lambda: setattr(room, "lag_s", 5.0)
    room.at_frame[60] = lambda: (setattr(room, "lag_s", 0.0), room.calls.append("quick again"))
    delivered, _ = treat(room)
    assert delivered.is_done
    assert room.done() == ["start", "quick again", *WHOLE[1:]]


def test_a_beam_that_is_done_is_held_however_old_the_frames_are():
    room = Room()
    room.at_frame[12] = lambda: setattr(room, "lag_s", 5.0)
    room.at_frame[60] = lambda: setattr(room, "lag_s", 0.0)
    delivered, _ = treat(room)
    assert delivered.is_done
    assert delivered.reports()[0].delivered_s <= 1.21


def test_frames_from_before_the_arming_was_answered_do_not_arm_again():
    class Late(Room):
        def sample(self):
            shown = super().sample()
            is_before = self.armed_at is not None and self.frame < self.armed_at + 2
            return {**shown, "is_armed": False, "gate": "disarmed", "line_on": False} if is_before else shown

    room = Late()
    room.armed_at = None
    room.arm = lambda _, **_confirmed: (
        room.calls.append("arm"),
        setattr(room, "is_armed", True),
        setattr(room, "armed_at", room.frame),
    )
    treat(room)
    assert room.calls.count("arm") == 1


def test_frames_from_the_record_are_counted_and_nothing_is_done_because_of_them():
    room = Room()
    room.at_frame[20] = lambda: setattr(room, "form", "recorded")
    room.at_frame[40] = lambda: (setattr(room, "form", "full"), room.calls.append("full again"))
    delivered, stretch = treat(room)
    assert delivered.is_done
    assert sorted(stretch.clock.frames) == list(range(1, room.frame + 1))
    assert room.done() == ["start", "reference", "arm", "full again", *WHOLE[3:]]


def test_a_stream_that_broke_for_long_goes_on_behind_the_last_frame():
    class Breaking(Room):
        def live(self, **asked):
            for message in super().live(**asked):
                yield message
                if self.frame == 12 and self.calls.count("live after 12") == 0:
                    raise UnreachableError("broken")

    room = Breaking()
    delivered, _ = treat(room)
    assert delivered.is_done
    assert [call for call in room.calls if call.startswith("live")] == ["live after -1", "live after 12"]


def test_a_service_that_does_not_come_back_is_given_up():
    class Gone(Room):
        def live(self, **_):
            raise UnreachableError("gone")
            yield

        def read_session(self, _):
            raise UnreachableError("gone")

    with pytest.raises(TpsError, match="gone for 3 s"):
        treat(Gone())


def test_a_session_that_a_restart_interrupted_is_reported_with_its_status():
    room = Room()
    room.at_frame[12] = lambda: setattr(room, "status", "interrupted")
    with pytest.raises(SessionOverError) as over:
        treat(room)
    assert over.value.status == "interrupted"
    assert room.done()[-1] == "arm"
