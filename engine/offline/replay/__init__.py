"""Tapes of an engine's inputs, and sessions replayed from them (ADR 0013)."""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.offline.replay.comparison import (
        MOTION_MM as MOTION_MM,
        PROCESSOR as PROCESSOR,
        Comparison as Comparison,
        comparison_of as comparison_of,
        this_machine as this_machine,
    )
    from engine.offline.replay.encoding import (
        TapeEncoding as TapeEncoding,
    )
    from engine.offline.replay.header import (
        METHOD as METHOD,
        RAW as RAW,
        RECORDING as RECORDING,
        Frames as Frames,
        TapeHeader as TapeHeader,
        read_head as read_head,
        this_software as this_software,
    )
    from engine.offline.replay.outcomes import (
        Row as Row,
        same as same,
        text_of as text_of,
    )
    from engine.offline.replay.recording_tap import (
        RecordingTap as RecordingTap,
        TappedTrainer as TappedTrainer,
    )
    from engine.offline.replay.replaying import (
        Replay as Replay,
        Survey as Survey,
        replay as replay,
        survey as survey,
    )
    from engine.offline.replay.replaying_tap import (
        Difference as Difference,
    )
    from engine.offline.replay.tape_file import (
        SUFFIX as SUFFIX,
        read_tape as read_tape,
    )
    from engine.offline.replay.tape_writer import (
        TapeWriter as TapeWriter,
        sha256_of as sha256_of,
    )

__getattr__, __all__ = lazy_exports(__name__)
