"""The catalogue of falsified recordings: kinds, sizes, and what is done to the scene."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

from engine.core.errors import InvalidValueError
from engine.core.frames import LostReason
from engine.core.gate_state import HoldReason
from engine.core.signals import HeadDirection
from lab.phantom.builds import CLOTHING, NO_DEPARTURE, SKINS, STICKERS, Departure
from lab.phantom.falsifications import (
    BLACK_RGB,
    Blind,
    CameraFault,
    Cover,
    Falsification,
    Limb,
    Move,
    MovedMarker,
    Part,
    Rolling,
    Stale,
)

HONEST_S = 3.0
"""Honest frames before a falsification [s]."""
FALSE_S = 8.0
POSITION = "position"
COVERED = (LostReason.SURFACE_CHANGED, LostReason.RESIDUAL_HIGH)
DISPLACED = (LostReason.LAYOUT_CHANGED,)
UNSEEN = (LostReason.COVERAGE_LOW, *COVERED)
MOVED = (POSITION, HoldReason.PATIENT_SHIFTED)
CAMERA = (LostReason.CAMERA_MOVED,)
OLD = (LostReason.FRAME_FROZEN, LostReason.FRAME_TORN, HoldReason.FRAME_STALE)
HONEST = "honest"
HONEST_BREATHING_S = 40.0
"""Long enough for a breath hold, or an isovolume manoeuvre [s]."""
SLOW_S = 60.0
CONDITION_S, COLD_S = 20.0, 180.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One falsified recording.

    Attributes
    ----------
    kind, size
        Row of the table.
    falsification
        What is done, from `HONEST_S` on.
    seconds
        Time measured after it began [s].
    is_rigid
        Whether body or camera move as a whole: then motion is right, and the move has to be named.
    is_turned
        Whether the patient lies feet first from the beginning, while the model is learned.
    head_direction
        As given to the measurement; without one it is assumed at the top, and only the whole region may gate.
    causes
        The codes of losses and holds that name it, `POSITION` for a reported movement of the patient; empty where
        nothing is to be named.
    departure
        Light, skin, clothing or a cold camera, from the beginning: the model is learned under it.
    scenario
        How the patient breathes; the model is learned from regular breathing in any case.
    hazard
        The hazard of docs/2-clinical/hazards.md that it tries; empty for an honest recording.
    is_condition
        Whether nothing is false, but room or patient are others than usual.
    """

    kind: str
    size: str
    falsification: Falsification
    seconds: float = FALSE_S
    is_rigid: bool = False
    is_turned: bool = False
    head_direction: HeadDirection | None = HeadDirection.TOP
    causes: tuple[str, ...] = ()
    scenario: str = "regular"
    departure: Departure = NO_DEPARTURE
    hazard: str = ""
    is_condition: bool = False

    @property
    def is_honest(self) -> bool:
        """Whether nothing is false: then no frame may be lost."""
        return self.kind == HONEST or self.is_condition

    @property
    def name(self) -> str:
        """Kind and size in one phrase."""
        return f"{self.kind}, {self.size}"


def cases(*, is_slow: bool = False) -> list[Case]:
    """Return all cases; ``is_slow`` adds what takes longer than 20 s."""
    makers: tuple[tuple[str, tuple[Callable[[], Iterator[Case]], ...]], ...] = (
        ("", (_honest,)),
        ("S2", (_covers, _markers, _limbs, _blankets, _stickers)),
        ("S11", (_blind_areas,)),
        ("P1", (_moves,)),
        ("S13", (_camera_moves, _camera_faults)),
        ("S1", (_delays,)),
        ("S8", (_stale, _old_in_part)),
        ("P7", (_orientations,)),
        ("S16", (_silent_checks,)),
    )
    slow: tuple[tuple[str, tuple[Callable[[], Iterator[Case]], ...]], ...] = (
        ("P1", (_slow_moves,)),
        ("S13", (partial(_slow_moves, is_camera=True),)),
        ("S2", (_slow_halves, _slow_covers)),
    )
    return [
        replace(case, hazard=hazard)
        for hazard, yielded in (*makers, *(slow if is_slow else ()))
        for make in yielded
        for case in make()
    ]


def conditions() -> list[Case]:
    """Return honest recordings under the light, skin and clothing that rooms and patients have, and a cold camera."""
    found = [("usual", "-", NO_DEPARTURE)]
    found += [("room light", f"1/{share}", Departure(light=1.0 / share)) for share in (4, 16, 64, 256)]
    found += [("gantry's shadow", f"{share:.0%}", Departure(shadow=share)) for share in (0.5, 0.8, 0.95)]
    for sticker in STICKERS:
        found += [
            (f"bare skin, {sticker} stickers", f"type {skin}", Departure(clothing="bare", skin=skin, sticker=sticker))
            for skin in SKINS
        ]
        found += [
            (f"{clothing} shirt, {sticker} stickers", "-", Departure(clothing=clothing, sticker=sticker))
            for clothing in CLOTHING
            if clothing != "bare"
        ]
    made = [
        Case(kind=kind, size=size, falsification=_false(), departure=one, seconds=CONDITION_S, is_condition=True)
        for kind, size, one in found
    ]
    cold = [
        Case(
            kind="cold camera",
            size=f"{drift_mm:g} mm",
            falsification=_false(),
            departure=Departure(drift_mm=-drift_mm),
            seconds=COLD_S,
            causes=CAMERA,
            hazard="S13",
        )
        for drift_mm in (4.0, 12.0)
    ]
    return made + cold


def falsification_of(kind: str, size: str | None, *, start_s: float) -> Falsification:
    """Return what is done to the scene of a kind and size of the catalogue, from ``start_s`` on [s].

    Raises
    ------
    InvalidValueError
        No case has this kind or size, several sizes have no choice, or it is none of the scene: old pictures, and a
        patient who lies the other way round from the beginning.
    """
    offered = [case for case in cases(is_slow=True) if case.falsification.stale is None and not case.is_turned]
    kinds = dict.fromkeys(case.kind for case in offered if not case.is_honest)
    if kind not in kinds:
        raise InvalidValueError("falsify", kind, f"one of {', '.join(kinds)}")
    sizes = {case.size: case for case in offered if case.kind == kind}
    if size not in sizes and (size is not None or len(sizes) > 1):
        raise InvalidValueError("size", str(size), f"one of {', '.join(sizes)}")
    case = next(iter(sizes.values())) if size is None else sizes[size]
    return replace(case.falsification, start_s=start_s)


def _false(**parts: object) -> Falsification:
    return Falsification(start_s=HONEST_S, **parts)  # type: ignore[arg-type]


def _honest() -> Iterator[Case]:
    for scenario in ("regular", "irregular", "dibh", "isovolume", "drift"):
        seconds = FALSE_S if scenario == "regular" else HONEST_BREATHING_S
        yield Case(kind=HONEST, size=scenario, falsification=_false(), scenario=scenario, seconds=seconds)
    yield Case(kind="marker hidden", size="0.7 s", falsification=_false(hides_marker_s=0.7))
    yield Case(kind="marker hidden", size="3 s", falsification=_false(hides_marker_s=3.0))


def _covers() -> Iterator[Case]:
    for part in Part:
        for height_mm in (3.0, 5.0, 8.0, 12.0):
            yield Case(
                kind=f"sheet laid over {part}",
                size=f"{height_mm:g} mm",
                falsification=_false(cover=Cover(height_mm=height_mm, part=part)),
                causes=COVERED,
            )
        for height_mm in (2.0, 3.0, 5.0):
            yield Case(
                kind=f"sheet of the skin's colour laid over {part}",
                size=f"{height_mm:g} mm",
                falsification=_false(cover=Cover(height_mm=height_mm, part=part, has_color=False)),
                causes=COVERED,
            )
    for height_mm in (3.0, 5.0, 8.0, 12.0):
        yield Case(
            kind="sheet laid over half while a marker is hidden",
            size=f"{height_mm:g} mm",
            falsification=_false(cover=Cover(height_mm=height_mm), hides_marker_s=0.7),
            causes=COVERED,
        )
    for part, height_mm, speed_mm_s in (
        (Part.HALF, 3.0, 150.0),
        (Part.HALF, 5.0, 150.0),
        (Part.HALF, 8.0, 150.0),
        (Part.SIDE, 5.0, 60.0),
        (Part.WHOLE, 5.0, 150.0),
    ):
        for has_color in (True, False):
            cover = Cover(height_mm=height_mm, part=part, edge_mm=60.0, speed_mm_s=speed_mm_s, has_color=has_color)
            drape = "drape" if has_color else "drape of the skin's colour"
            yield Case(
                kind=f"{drape} with a soft edge drawn over {part}",
                size=f"{height_mm:g} mm, {speed_mm_s:g} mm/s",
                falsification=_false(cover=cover),
                causes=COVERED,
            )


def _markers() -> Iterator[Case]:
    for outward_mm in (8.0, 15.0, 20.0, 30.0, -15.0):
        yield Case(
            kind="marker re-attached",
            size=f"{abs(outward_mm):g} mm {'out' if outward_mm > 0.0 else 'in'}wards",
            falsification=_false(marker=MovedMarker(marker=2, outward_mm=outward_mm)),
            causes=DISPLACED,
        )
    for up_mm in (5.0, 12.0):
        yield Case(
            kind="marker on a sheet over half",
            size=f"{up_mm:g} mm",
            falsification=_false(
                marker=MovedMarker(marker=2, up_mm=up_mm), cover=Cover(height_mm=up_mm), hides_marker_s=0.7
            ),
            causes=(*DISPLACED, *COVERED),
        )


def _blind_areas() -> Iterator[Case]:
    for first, raised_mm in ((0.8, 0.0), (0.8, 4.0), (0.8, 8.0), (0.88, 8.0)):
        yield Case(
            kind=f"no depth over the lowest {1.0 - first:.0%}, skin raised",
            size=f"{raised_mm:g} mm",
            falsification=_false(blind=Blind(first=first, last=1.05, raised_mm=raised_mm)),
            causes=UNSEEN,
        )


def _moves() -> Iterator[Case]:
    for up_mm in (2.0, -2.0, 4.0, -4.0, 10.0, -10.0, 20.0):
        yield _move("body raised" if up_mm > 0.0 else "body lowered", f"{abs(up_mm):g} mm", Move(up_mm=up_mm))
    for y_mm in (5.0, 10.0):
        yield _move("body shifted", f"{y_mm:g} mm", Move(y_mm=y_mm))
    for angle_deg in (1.0, 3.0, 5.0):
        yield _move("body turned", f"{angle_deg:g} deg", Move(turn_deg=angle_deg))
        yield _move("body tilted", f"{angle_deg:g} deg", Move(tilt_deg=angle_deg))
        yield _move("body rolled", f"{angle_deg:g} deg", Move(roll_deg=angle_deg))


def _camera_moves() -> Iterator[Case]:
    for up_mm in (4.0, 10.0):
        yield _move("camera lowered", f"{up_mm:g} mm", Move(up_mm=up_mm), is_camera=True)
    for up_mm in (2.0, 5.0):
        couch = _false(camera=Move(up_mm=-up_mm), floor_stays=True)
        yield Case(kind="couch lowered", size=f"{up_mm:g} mm", falsification=couch, is_rigid=True, causes=CAMERA)
    yield _move("camera raised", "4 mm", Move(up_mm=-4.0), is_camera=True)
    yield _move("camera tilted", "1 deg", Move(tilt_deg=1.0), is_camera=True)
    yield replace(_move("camera turned", "1 deg", Move(turn_deg=1.0), is_camera=True), causes=(*CAMERA, *MOVED))
    tilted = _false(camera=Move(roll_deg=1.0), floor_stays=True)
    yield Case(kind="couch rolled", size="1 deg", falsification=tilted, is_rigid=True, causes=(*CAMERA, *MOVED))
    # In the picture this is a patient who was shifted: couch and floor are flat.
    yield replace(_move("camera shifted", "5 mm", Move(x_mm=5.0), is_camera=True), causes=(*CAMERA, *MOVED))


def _slow_moves(*, is_camera: bool = False) -> Iterator[Case]:
    for what, move in (
        ("lowered", Move(up_mm=-4.0, over_s=SLOW_S, steps=40)),
        ("tilted", Move(tilt_deg=2.0, over_s=SLOW_S, steps=40)),
    ):
        far = f"{abs(move.up_mm or move.tilt_deg):g} in {SLOW_S:g} s"
        yield replace(
            _move(f"{'camera' if is_camera else 'body'} {what}", far, move, is_camera=is_camera), seconds=SLOW_S
        )


def _move(kind: str, size: str, move: Move, *, is_camera: bool = False) -> Case:
    falsification = _false(camera=move) if is_camera else _false(body=move)
    causes = CAMERA if is_camera else MOVED
    return Case(kind=kind, size=size, falsification=falsification, is_rigid=True, causes=causes)


def _stale() -> Iterator[Case]:
    for ring, flicker in ((1, 0.0), (1, 0.01), (1, 0.05), (2, 0.0), (9, 0.0), (16, 0.0), (64, 0.0), (9, 0.01)):
        kind = "frozen picture" if ring == 1 else f"ring of {ring} old pictures"
        stale = Stale(ring=ring, flicker=flicker)
        size = f"{flicker:.0%} flicker"
        yield Case(kind=kind, size=size, falsification=_false(stale=stale), seconds=2.0 * FALSE_S, causes=OLD)


def _delays() -> Iterator[Case]:
    for rate in (0.05, 0.2):
        stale = Stale(delay_s_per_s=rate)
        yield Case(kind="growing delay", size=f"{rate:g} s/s", falsification=_false(stale=stale), causes=OLD)


def _old_in_part() -> Iterator[Case]:
    for frames in (2, 8):
        stale = Stale(torn_frames=frames)
        size = f"{frames} frames"
        yield Case(kind="lower half of the pictures old", size=size, falsification=_false(stale=stale), causes=OLD)
    for frames in (4, 8):
        stale = Stale(averaged_frames=frames)
        size = f"{frames} frames"
        yield Case(kind="depth averaged over frames", size=size, falsification=_false(stale=stale), causes=OLD)


def _silent_checks() -> Iterator[Case]:
    """Yield what passes a check that cannot work, or that compares with the frame before."""
    for part in (Part.HALF, Part.WHOLE):
        cover = Cover(height_mm=3.0, part=part, rgb=BLACK_RGB)
        kind = f"black cover laid over {part}"
        yield Case(kind=kind, size="3 mm", falsification=_false(cover=cover), causes=COVERED)
    sheet = Cover(height_mm=3.0, has_color=False)
    yield Case(kind="holes that roll", size="-", falsification=_false(rolling=Rolling()))
    yield Case(
        kind="holes that roll, a sheet over half",
        size="3 mm",
        falsification=_false(rolling=Rolling(), cover=sheet),
        causes=COVERED,
    )
    lower = Move(up_mm=-2.8)
    yield Case(
        kind="camera lowered, couch and floor hidden at the reference",
        size="2.8 mm",
        falsification=_false(camera=lower, scene_seen_s=HONEST_S - 1.3),
        is_rigid=True,
        causes=(*CAMERA, *MOVED),
    )


def _stickers() -> Iterator[Case]:
    for slide_mm in (2.0, 5.0):
        yield Case(
            kind="stickers slide with the breath", size=f"{slide_mm:g} mm", falsification=_false(slide_mm=slide_mm)
        )


def _camera_faults() -> Iterator[Case]:
    for percent in (2.0, -2.0):
        size = f"{percent:+g} %"
        fault = CameraFault(scale=1.0 + percent / 100.0)
        yield Case(
            kind="depth scale changed", size=size, falsification=_false(fault=fault), causes=(*CAMERA, *DISPLACED)
        )
    mirrored = CameraFault(is_mirrored=True)
    yield Case(
        kind="pictures mirrored",
        size="-",
        falsification=_false(fault=mirrored),
        causes=COVERED,
    )
    for above_mm in (0.0, -6.0):
        fault = CameraFault(clips_mm=above_mm)
        yield Case(
            kind="depth saturated",
            size="at the chest" if above_mm == 0.0 else f"{-above_mm:g} mm over the chest",
            falsification=_false(fault=fault),
            causes=UNSEEN,
        )
    for warms_mm, warms_s in ((4.0, 8.0), (12.0, 8.0)):
        fault = CameraFault(warms_mm=warms_mm, warms_s=warms_s)
        size = f"{warms_mm:g} mm in {warms_s:g} s"
        yield Case(kind="sensor warms up", size=size, falsification=_false(fault=fault), causes=CAMERA)


def _limbs() -> Iterator[Case]:
    """Yield arms across the region and beside it, and a person who leans into the view."""
    arms = (
        ("another person's arm across the belly", Limb(y_mm=70.0, reach_mm=-60.0)),
        ("the patient's own arm on the belly", Limb(y_mm=70.0, reach_mm=-20.0, over_mm=25.0, follows=1.0)),
        ("a hand on the region's edge", Limb(y_mm=20.0, reach_mm=75.0, over_mm=15.0, radius_mm=22.0, follows=1.0)),
    )
    for kind, limb in arms:
        causes = (*COVERED, LostReason.MARKER_LOST, *UNSEEN)
        yield Case(kind=kind, size="-", falsification=_false(limb=limb), causes=causes)
    beside = Limb(y_mm=0.0, reach_mm=300.0, over_mm=150.0, radius_mm=130.0)
    yield Case(kind="a person leans over the couch", size="beside the region", falsification=_false(limb=beside))


def _blankets() -> Iterator[Case]:
    for part in (Part.HALF, Part.WHOLE):
        for has_color in (True, False):
            cover = Cover(height_mm=6.0, part=part, follows=0.7, has_color=has_color)
            what = "blanket" if has_color else "blanket of the skin's colour"
            kind = f"{what} that follows 70 % laid over {part}"
            yield Case(kind=kind, size="6 mm", falsification=_false(cover=cover), causes=COVERED)


def _slow_covers() -> Iterator[Case]:
    for speed_mm_s in (10.0, 30.0):
        cover = Cover(height_mm=5.0, part=Part.HALF, edge_mm=60.0, speed_mm_s=speed_mm_s, has_color=False)
        yield Case(
            kind="drape of the skin's colour with a soft edge drawn over half",
            size=f"5 mm, {speed_mm_s:g} mm/s",
            falsification=_false(cover=cover),
            seconds=30.0,
            causes=COVERED,
        )
    soaked = Cover(height_mm=-3.0, edge_mm=40.0, has_color=False, laid_s=20.0, darkens=0.5)
    yield Case(
        kind="cloth that soaks, darkens and sinks",
        size="3 mm in 20 s",
        falsification=_false(cover=soaked),
        seconds=28.0,
        causes=COVERED,
    )


def _slow_halves() -> Iterator[Case]:
    for height_mm, laid_s in ((4.0, 15.0), (2.5, 25.0)):
        swelling = Cover(height_mm=height_mm, edge_mm=80.0, has_color=False, laid_s=laid_s)
        size = f"{height_mm:g} mm in {laid_s:g} s"
        yield Case(
            kind="half rises slowly",
            size=size,
            falsification=_false(cover=swelling),
            seconds=laid_s + FALSE_S,
            causes=COVERED,
        )


def _orientations() -> Iterator[Case]:
    for head, size in ((HeadDirection.BOTTOM, "head direction given"), (None, "head direction unknown")):
        yield Case(kind="feet first", size=size, falsification=_false(), is_turned=True, head_direction=head)
