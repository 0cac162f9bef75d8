"""The ten virtual volunteers: parameters of body, breathing and camera position.

Body mass index follows the article's Table 1. Lengths are mm over the couch or across the body; the rest of a body
follows from these numbers (:mod:`lab.phantom.anatomy`).
"""

from dataclasses import dataclass, fields, replace

from engine.core.bounds import check_number, check_whole_number
from engine.core.errors import InvalidValueError

SKINS = {
    1: (243, 214, 195),
    2: (231, 190, 161),
    3: (214, 168, 142),
    4: (172, 119, 86),
    5: (120, 75, 51),
    6: (71, 46, 36),
}
"""Colour of skin of the six types of Fitzpatrick, as a camera shows it; the volunteers' own is the third."""
WHITE_RGB, BLACK_RGB, NAVY_RGB = (225, 226, 224), (22, 22, 24), (34, 40, 62)
CLOTHING = ("white", "black", "striped", "bare")
"""What covers the trunk in place of the volunteer's own shirt; ``bare`` is skin."""
STICKERS = ("plain", "ringed")
"""White discs, or the same discs on black ones of three times their diameter."""
_NAVY, _COAL, _GREEN, _WINE = (34, 40, 62), (44, 44, 48), (34, 54, 46), (62, 36, 44)
# One column per volunteer.
# fmt: off
_NUMBERS = {
    "bmi":             (  26.4,   28.7,   27.4,   21.5,   26.9,   26.5,   19.3,   24.3,   20.9,   24.0),
    "half_width_mm":   ( 168.0,  182.0,  176.0,  156.0,  172.0,  170.0,  146.0,  164.0,  152.0,  162.0),
    "chest_mm":        ( 214.0,  226.0,  220.0,  198.0,  216.0,  212.0,  188.0,  208.0,  194.0,  206.0),
    "belly_base_mm":   ( 206.0,  228.0,  218.0,  178.0,  212.0,  208.0,  164.0,  194.0,  172.0,  192.0),
    "breast_mm":       (   9.0,   12.0,   10.0,    6.0,   11.0,    8.0,    5.0,    9.0,    6.0,    8.0),
    "belly_mm":        (  14.0,   32.0,   22.0,   -4.0,   18.0,   20.0,   -8.0,    8.0,   -5.0,   10.0),
    "asymmetry":       (  0.06,  -0.04,   0.08,   0.03,  -0.07,   0.05,  -0.05,   0.09,  -0.08,   0.04),
    "roi_length_mm":   ( 385.0,  395.0,  380.0,  400.0,  390.0,  375.0,  392.0,  405.0,  388.0,  398.0),
    "amplitude_mm":    (  11.2,   11.5,    9.0,    8.6,   11.0,    9.6,    8.2,   10.6,    8.0,   12.0),
    "period_s":        (   4.0,    3.6,    4.5,    3.2,    4.2,    3.8,    3.4,    4.8,    5.0,    3.0),
    "thorax_share":    (  0.45,   0.32,   0.50,   0.62,   0.40,   0.36,   0.70,   0.48,   0.66,   0.38),
    "thorax_lag_s":    (  0.25,   0.15,   0.35,   0.20,   0.30,   0.10,   0.28,   0.38,   0.22,   0.18),
    "spread_lag_s":    (  0.30,   0.22,   0.34,   0.18,   0.26,   0.24,   0.20,   0.32,   0.36,   0.16),
    "camera_mm":       ( 850.0,  830.0,  870.0,  900.0,  845.0,  810.0,  780.0,  920.0,  860.0,  840.0),
    "roll_deg":        (   1.2,   -2.4,    0.6,    2.8,   -1.5,    1.9,   -0.8,    0.2,   -2.0,    1.0),
    "tilt_x_deg":      (   2.5,    4.0,    1.0,    3.0,    2.0,    5.0,    1.6,    3.4,    2.2,    4.4),
    "tilt_y_deg":      (  -1.2,    1.0,    2.2,    0.4,   -2.6,    0.8,    1.6,   -0.6,   -1.8,    1.4),
    "depth_scale":     ( 1.021,  0.984,  1.013,  0.978,  1.030,  0.992,  1.016,  0.987,  1.008,  1.025),
    "depth_offset_mm": (  -3.0,    6.0,    2.0,    4.0,   -8.0,    3.0,   -2.0,    5.0,   -5.0,    1.0),
}
# fmt: on
_SHIRTS = (_NAVY, _COAL, _GREEN, _NAVY, _WINE, _COAL, _GREEN, _NAVY, _WINE, _COAL)
DEPARTURE_BOUNDS = {
    "camera_mm": (550.0, 1500.0),
    "amplitude_mm": (0.5, 60.0),
    "hole_share": (0.0, 0.9),
    "drift_mm": (-30.0, 30.0),
    "light": (0.001, 1.0),
    "shadow": (0.0, 1.0),
}
"""Lowest and highest value of each departure; at a smaller distance the four stickers leave the picture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Build:
    """One volunteer.

    Attributes
    ----------
    breast_mm, belly_mm
        How far pectorals and belly stand out of the trunk; the belly of a lean person lying down is hollow.
    asymmetry
        Share by which the right side of the chest stands and moves more than the left.
    thorax_share
        Chest amplitude as a share of the abdomen's.
    thorax_lag_s, spread_lag_s
        How late the chest is against the abdomen, and how late the latest part of each is against its earliest.
    camera_mm
        Height of the camera over the chest.
    roll_deg, tilt_x_deg, tilt_y_deg
        How the camera is turned about its axis and away from the plumb line.
    depth_scale, depth_offset_mm
        How this camera unit's true depth follows from its reading.
    """

    bmi: float
    half_width_mm: float
    chest_mm: float
    belly_base_mm: float
    breast_mm: float
    belly_mm: float
    asymmetry: float
    roi_length_mm: float
    amplitude_mm: float
    period_s: float
    thorax_share: float
    thorax_lag_s: float
    spread_lag_s: float
    camera_mm: float
    roll_deg: float
    tilt_x_deg: float
    tilt_y_deg: float
    depth_scale: float
    depth_offset_mm: float
    shirt_rgb: tuple[int, int, int]
    stripe_rgb: tuple[int, int, int] | None
    skin_rgb: tuple[int, int, int]


BUILDS = tuple(
    Build(
        **{field: values[column] for field, values in _NUMBERS.items()},
        shirt_rgb=shirt,
        stripe_rgb=None,
        skin_rgb=SKINS[3],
    )
    for column, shirt in enumerate(_SHIRTS)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Departure:
    """Changes of one recording against its volunteer's parameters, for the sweeps of the accuracy evaluation.

    Attributes
    ----------
    camera_mm
        Height of the camera over the chest.
    amplitude_mm
        Amplitude of the abdomen in free breathing.
    hole_share
        Share of the body, 0 to 1, without a reading, in patches in addition to the usual holes.
    drift_mm
        How far the readings of the cold camera are off at the chest when it starts; the drift fades as it warms up.
    light
        Light of the room, as a share of the usual; the camera's exposure follows, up to sixteen times.
    shadow
        Share of the light that the gantry takes where its shadow falls; its edge moves to and fro over the patient.
    skin
        Type of skin, 1 to 6, as in `SKINS`.
    clothing
        One of `CLOTHING`.
    sticker
        One of `STICKERS`.
    """

    camera_mm: float | None = None
    amplitude_mm: float | None = None
    hole_share: float | None = None
    drift_mm: float | None = None
    light: float | None = None
    shadow: float | None = None
    skin: int | None = None
    clothing: str | None = None
    sticker: str | None = None

    def __post_init__(self) -> None:
        """Check the values against `DEPARTURE_BOUNDS` and the names; raise InvalidValueError."""
        for field, (low, high) in DEPARTURE_BOUNDS.items():
            value = getattr(self, field)
            if value is not None:
                check_number(field, value, low, high)
        if self.skin is not None:
            check_whole_number("skin", self.skin, 1, len(SKINS))
        for field, names in (("clothing", CLOTHING), ("sticker", STICKERS)):
            value = getattr(self, field)
            if value is not None and value not in names:
                raise InvalidValueError(field, value, "one of " + ", ".join(names))

    def of(self, build: Build) -> Build:
        """Return the volunteer's parameters with these changes."""
        skin_rgb = build.skin_rgb if self.skin is None else SKINS[self.skin]
        shirts = {"white": WHITE_RGB, "striped": WHITE_RGB, "black": BLACK_RGB, "bare": skin_rgb}
        return replace(
            build,
            camera_mm=build.camera_mm if self.camera_mm is None else float(self.camera_mm),
            amplitude_mm=build.amplitude_mm if self.amplitude_mm is None else float(self.amplitude_mm),
            skin_rgb=skin_rgb,
            shirt_rgb=shirts.get(self.clothing or "", build.shirt_rgb),
            stripe_rgb=NAVY_RGB if self.clothing == "striped" else None,
        )

    @property
    def labels(self) -> dict[str, float | str]:
        """The changed parameters and their values, for a recording's truth."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: value if isinstance(value, str) else float(value)
            for name, value in values.items()
            if value is not None
        }


NO_DEPARTURE = Departure()


def find_build(volunteer: int) -> Build:
    """Return volunteer ``volunteer``, 1 to 10; raise InvalidValueError for any other."""
    return BUILDS[check_whole_number("volunteer", volunteer, 1, len(BUILDS)) - 1]
