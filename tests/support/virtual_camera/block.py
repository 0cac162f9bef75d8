"""The mapped file that driver and controller share, as ctypes; ``block.h`` says what each number means."""

import ctypes
import enum

MAGIC = 0x6E6F697458314456
VERSION = 1
SLOTS = 256
WIDTH_PX, HEIGHT_PX = 640, 480


class Kind(enum.IntEnum):
    """What the camera can be reported."""

    UNDO = 0
    STALL = 1
    REPEAT = 2
    AGAIN = 3
    LATE = 4
    RATE = 5
    CLOCK = 6
    STUCK_CLOCK = 7
    TIMESTAMP = 8
    INDEX = 9
    MALFORM = 10
    STATE = 11
    UNPLUG = 12
    HANG = 13
    FILL = 20
    OFFSET = 21
    DROPOUT = 22
    NOISE = 23
    SHIFT = 24
    SPEED = 25
    TORN = 26
    AVERAGED = 27


class Streams(enum.IntFlag):
    """Which streams a command is for."""

    DEPTH = 1
    COLOR = 2
    BOTH = 3


class Field(enum.IntEnum):
    """What can be wrong in a frame's head."""

    DATA_SIZE = 1
    WIDTH = 2
    HEIGHT = 3
    STRIDE = 4
    SENSOR = 5
    FORMAT = 6
    NO_DATA = 7


class Call(enum.IntFlag):
    """Which of the runtime's calls into the driver hang; READ is what a wait for frames makes."""

    OPEN = 1
    CLOSE = 2
    START = 4
    STOP = 8
    SET = 16
    GET = 32
    READ = 64
    DESTROY = 128


class State(enum.IntEnum):
    """Device states of OpenNI2."""

    OK = 0
    ERROR = 1
    NOT_READY = 2


_word = ctypes.c_int64
_pair = ctypes.c_int64 * 2


class Command(ctypes.Structure):
    """One order."""

    _fields_ = (
        ("kind", _word),
        ("streams", _word),
        ("from_frame", _word),
        ("for_frames", _word),
        ("n", _word * 8),
        ("x", ctypes.c_double * 4),
    )


class ReceiptWords(ctypes.Structure):
    """What came of an order."""

    _fields_ = tuple(
        (name, _word)
        for name in (
            "number",
            "taken_ns",
            "begun_ns",
            "depth_index",
            "depth_ns",
            "color_index",
            "color_ns",
            "ended_ns",
        )
    )


class StatusWords(ctypes.Structure):
    """How the camera stands."""

    _fields_ = (
        *((name, _word) for name in ("pid", "ticks", "is_plugged", "is_open")),
        *(
            (name, _pair)
            for name in ("is_running", "raised", "index", "timestamp_us", "raised_ns", "mirrored", "width_px")
        ),
        *((name, _word) for name in ("registration", "position", "backlog", "overruns", "hung", "refused_frames")),
    )


class Block(ctypes.Structure):
    """The whole file."""

    _fields_ = (
        ("magic", _word),
        ("version", _word),
        ("size", _word),
        ("ring_path", ctypes.c_char * 1024),
        ("starts_plugged", _word),
        ("can_register", _word),
        ("fps", ctypes.c_double),
        ("color_lag", ctypes.c_double),
        ("asked", _word),
        ("taken", _word),
        ("status", StatusWords),
        ("receipts", ReceiptWords * SLOTS),
        ("commands", Command * SLOTS),
    )


class RingHead(ctypes.Structure):
    """The head of a file of baked frames."""

    _fields_ = (
        *((name, _word) for name in ("magic", "frames", "width", "height", "frames_at", "rays_at")),
        *((name, ctypes.c_double) for name in ("color_fx", "color_fy", "color_cx", "color_cy")),
        ("distortion", ctypes.c_double * 5),
        ("translation_mm", ctypes.c_double * 3),
        ("depth_fx", ctypes.c_double),
        ("depth_fy", ctypes.c_double),
        ("depth_table_mm", ctypes.c_uint16 * 2048),
    )
