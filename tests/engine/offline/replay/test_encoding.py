"""Values as a tape spells them."""

import json
from dataclasses import replace

import pytest

from engine.capture.source import SourceDescription
from engine.core.breath import BreathEventKind, GateSignal, SignalChoice
from engine.core.commands import ActivateModel, Arm, CorrectBaseline, Retrain
from engine.core.errors import BeamLineMismatchError, InvalidValueError, RecordingError, SourceAwayError
from engine.core.gate_state import HoldReason
from engine.gating.active_window import SetWindow
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits
from engine.gating.windows import (
    AmplitudeWindow,
    BreathHoldWindow,
    Join,
    JoinedWindow,
    PhaseWindow,
    Unit,
    amplitude_window,
)
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.named_regions import NamedRegion
from engine.motion.settings import PipelineSettings
from engine.offline.replay.encoding import FrameHead, Raised, TapeEncoding
from tests.support.replay.scripted_tape import NO_MODELS
from tests.support.service.fake_engine import make_model

CHOICE = SignalChoice(signal=GateSignal.THORAX)
WINDOWS = (
    amplitude_window(lower_mm=-1.0, upper_mm=0.1 + 0.2),
    AmplitudeWindow(choice=CHOICE, lower=20.0, upper=70.0, unit=Unit.PERCENT),
    BreathHoldWindow(level=amplitude_window(lower_mm=8.0, upper_mm=12.0)),
    PhaseWindow(from_percent=90.0, to_percent=20.0),
    JoinedWindow(
        conditions=(amplitude_window(lower_mm=-1.0, upper_mm=3.0), PhaseWindow(from_percent=30.0, to_percent=70.0)),
        join=Join.OR,
    ),
)
EVENTS = frozenset({BreathEventKind.COUGH, BreathEventKind.SIGH})
SQUARE = NamedRegion(name="belly", vertices=((220.0, 40.0), (220.0, 160.0), (320.0, 100.0)))
VALUES = (
    None,
    True,
    7,
    1e-17,
    "words",
    [Arm(operator="A"), Retrain(operator="B", keeps_zero=False), CorrectBaseline(operator="C", by=-0.1)],
    *(
        SetWindow(operator="D", window=one, dwell_ms=120.5, min_on_ms=0.0, min_off_ms=1.0, max_cycles_per_min=9)
        for one in WINDOWS
    ),
    (HoldReason.DISK_LOW, "full"),
    Interruption(HoldReason.OPERATOR_LOST, "no request"),
    FrameHead(
        index=0, device_index=9, missed_frames=2, timestamp_us=2**53, color_timestamp_us=-1, received_ns=2**62 + 1
    ),
    SourceDescription(kind="k", name="n", depth_size=(6, 4), color_size=(6, 4), fps=29.97, is_live=True, serial="1"),
    PipelineSettings(named=(SQUARE,), points=((1, 2),), split=(100.0, 120.5), training=TrainingSettings(min_frames=30)),
    *(GateLimits(window=window, holding_events=EVENTS, max_lag_ms=33.3) for window in WINDOWS),
)


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_a_value_is_read_as_it_was_encoded(value):
    again = NO_MODELS.decode(json.loads(json.dumps(NO_MODELS.encode(value))))
    assert again == value
    assert type(again) is type(value)


def test_a_model_is_encoded_by_its_stored_name():
    known = make_model()
    encoding = TapeEncoding(name_of=lambda _model: "abc", model_of=lambda name: replace(known, cycles=len(name)))
    encoded = encoding.encode(ActivateModel(operator="A", model=known))
    assert encoded["d"][1]["model"] == {"m": "abc"}
    assert encoding.decode(encoded).model.cycles == 3


def test_what_has_no_place_on_a_tape_is_refused():
    with pytest.raises(TypeError, match="Path"):
        NO_MODELS.encode(__import__("pathlib").Path())


@pytest.mark.parametrize(
    "encoded",
    [{"d": ["Popen", {}]}, {"e": ["HoldReason", "none such"]}, {"x": []}, {"d": ["Arm", {"who": "A"}]}, {"d": 1}, {}],
    ids=str,
)
def test_an_encoding_of_no_known_value_is_damage_and_makes_nothing(encoded):
    with pytest.raises(RecordingError, match="the tape is damaged"):
        NO_MODELS.decode(encoded)


ERRORS = (SourceAwayError("away"), BeamLineMismatchError("on"), InvalidValueError("f", 1, "2"), OSError("gone"))


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_comes_again_under_its_name_with_its_words(error):
    again = Raised(name=type(error).__name__, text=str(error)).again()
    assert (type(again).__name__, str(again)) == (type(error).__name__, str(error))
    assert isinstance(again, Exception)
