"""The distance view as an eye 3 m away gets it: angular heights, contrasts, and colours under colour blindness."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from playwright.sync_api import Page

from tests.support.browser.fake_service import sample

SIZE_PX = (1920, 1080)
PIXEL_MM = 0.2767
"""Of 1920 x 1080 on 24 inch."""
DISTANCE_MM = 3000.0
LEAST_ARCMIN, LEAST_CONTRAST, LEAST_LUMINANCE_RATIO = 16.0, 4.5, 3.0
LEAST_DIFFERENCE = 25.0
"""Colour difference (CIE 1976) of BEAM ON and FAULT; 2.3 is just noticed side by side."""

COUNT_COLOR = """(rgb) => {
  const canvas = document.querySelector('#trace');
  const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  let found = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    const away = rgb.map((value, channel) => Math.abs(pixels[i + channel] - value));
    if (Math.max(...away) < 30 && pixels[i + 3] > 200) found += 1;
  }
  return found;
}"""

STATES: dict[str, dict[str, Any]] = {
    "beam_on": sample(
        gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True, accelerator_beam="on"
    ),
    "hold": sample(accelerator_beam="off"),
    "dwell": sample(gate="dwell", hold_reason="dwell", hold_text="Inside the window, dwell time is running"),
    "disarmed": sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed"),
    "fault": sample(
        gate="fault",
        is_armed=False,
        hold_reason="beam_line_mismatch",
        hold_text="The beam line's read-back differs from the command",
        accelerator_beam="unknown",
    ),
}
WANTED = ("word", "reason", "instruction", "call", "time", "gate lamp", "beam lamp", "age", "warning")
"""Texts that have to be read at 3 m."""

# Severity 1, linear RGB: Machado, Oliveira and Fernandes 2009, doi:10.1109/TVCG.2009.113.
BLINDNESS: dict[str, npt.NDArray[np.float64]] = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
    "grey": np.tile([0.2126, 0.7152, 0.0722], (3, 1)),
}

_READ = """() => {
  const pick = {
    word: '#gate-word', reason: '#gate-reason', instruction: '#gate-do', call: '#gate-call', time: '#gate-time',
    'gate lamp': '#lamp-gate strong', 'beam lamp': '#lamp-beam strong', age: '#gate-age', warning: '#gate-warning',
  };
  const context = document.createElement('canvas').getContext('2d');
  const rgb = (text) => (text.match(/[\\d.]+/g) ?? []).map(Number);
  const ground = (element) => {
    for (let one = element; one; one = one.parentElement) {
      const found = rgb(getComputedStyle(one).backgroundColor);
      if (found.length === 3 || found[3] > 0.99) return found.slice(0, 3);
    }
    return [0, 0, 0];
  };
  const gate = document.querySelector('#gate').getBoundingClientRect();
  return Object.entries(pick).flatMap(([name, selector]) => {
    const element = document.querySelector(selector);
    const style = getComputedStyle(element);
    const box = element.getBoundingClientRect();
    if (element.textContent === '' || box.width === 0) return [];
    context.font = `${style.fontWeight} ${style.fontSize} ${style.fontFamily}`;
    const isInside = box.left >= gate.left && box.right <= gate.right
      && box.top >= gate.top && box.bottom <= gate.bottom;
    return [{name, text: element.innerText, font_px: parseFloat(style.fontSize), ink: rgb(style.color).slice(0, 3),
      capital_px: context.measureText('H').actualBoundingBoxAscent, ground: ground(element), is_inside: isInside}];
  });
}"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenText:
    """One text of the distance view."""

    state: str
    name: str
    text: str
    font_px: float
    capital_px: float
    contrast: float
    is_inside: bool

    @property
    def arcmin(self) -> float:
        """Angle under which a capital is seen [arcmin]."""
        return 60.0 * math.degrees(math.atan(self.capital_px * PIXEL_MM / DISTANCE_MM))


def texts_of(page: Page, state: str) -> list[SeenText]:
    """Read the texts that the page shows in this state."""
    found = page.evaluate(_READ)
    return [
        SeenText(
            state=state,
            name=one["name"],
            text=one["text"],
            font_px=one["font_px"],
            capital_px=one["capital_px"],
            contrast=contrast(one["ink"], one["ground"]),
            is_inside=one["is_inside"],
        )
        for one in found
    ]


def ground_of(page: Page) -> list[int]:
    """Return the colour that fills the gate's panel."""
    text = page.evaluate("() => getComputedStyle(document.querySelector('#gate')).backgroundColor")
    return [int(part) for part in text.removeprefix("rgb(").removesuffix(")").split(",")[:3]]


def linear(rgb: list[int]) -> npt.NDArray[np.float64]:
    """Return linear light of 8-bit sRGB."""
    part = np.asarray(rgb, dtype=float) / 255.0
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def luminance(light: npt.NDArray[np.float64]) -> float:
    """Return the relative luminance of linear light, 0 to 1 (WCAG 2)."""
    return float(light @ np.array([0.2126, 0.7152, 0.0722]))


def contrast(one: list[int], other: list[int]) -> float:
    """Return the contrast ratio of two colours, 1 to 21 (WCAG 2)."""
    return ratio(linear(one), linear(other))


def ratio(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> float:
    """Return the contrast ratio of two colours in linear light."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def as_seen(rgb: list[int], vision: str) -> npt.NDArray[np.float64]:
    """Return a colour in linear light as an eye with this vision has it."""
    return np.clip(BLINDNESS[vision] @ linear(rgb), 0.0, 1.0)


def difference(one: list[int], other: list[int], vision: str) -> float:
    """Return the colour difference (CIE 1976, L*a*b*) of two colours for an eye with this vision."""
    pair = np.array([[as_seen(one, vision), as_seen(other, vision)]], dtype=np.float32)
    lab = cv2.cvtColor(pair, cv2.COLOR_LRGB2Lab)[0]
    return float(np.linalg.norm(lab[0] - lab[1]))
