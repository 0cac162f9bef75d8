"""Positions of the patient at the last ends of exhale and inhale, of which a reference is proposed.

An end of exhale is known when the next inhale has begun, so the frames of the last breath are kept as coefficients. A
position is stored as a reference, which does not depend on the model: it is transferred with the reference in use.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from engine.core.breath import Breath, SignalChoice
from engine.core.frames import FloatArray, Motion, SeenShares, frozen
from engine.core.reference import ReferenceMoment, ReferenceProposal
from engine.core.signals import Ranges
from engine.motion.learning.prepared_model import PreparedModel, Reference, of_regions
from engine.motion.learning.reference_transfer import ReferenceTransfer
from engine.motion.stages.surface import vertices_mm

RELEASED_AT_ONCE = 8
"""Frames of an earlier model that are released with a later one: all at once would take half a millisecond."""
KEPT_US = 20_000_000
"""Frames of this long are kept: a slow breath and the beginning of the next."""
MAX_AGE_US = 45_000_000
"""A position of a breath before that is not proposed."""
MAX_GAP_US = 1_000_000
"""After a longer time without a measurement the patient may lie elsewhere."""
AVERAGED_US = 150_000
"""Frames this close to the end of exhale or inhale are averaged."""
ALIKE_SHARE = 0.2
LEAST_ALIKE_MM = 1.0
"""Levels that differ from the newest by at most this share of a breath, or this much, are of one position: breaths
before the patient moved are not averaged with those after it."""
MOST_BREATHS = 5
LEAST_BREATHS = 2


class _Frame(NamedTuple):
    """A measured frame: coefficients, shape (k + e,), level of the signal, and what was seen."""

    timestamp_us: int
    coefficients: FloatArray
    level: float
    seen: SeenShares


class PastMotion(NamedTuple):
    """What is followed of a frame from before the model: ``motion`` is measured from ``reference``."""

    coefficients: FloatArray
    motion: Motion
    breath: Breath
    reference: Reference


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Position:
    """The patient's position at the end of an exhale or an inhale."""

    timestamp_us: int
    level: float
    reference: Reference


class ReferenceProposals:
    """Follows the breath's turning points; owned by the pipeline's thread.

    Attributes
    ----------
    measured_from
        The reference that the levels of past frames are measured from, until `move`; None without past frames.
    """

    def __init__(self) -> None:
        self._active: PreparedModel | None = None
        self._frames: deque[_Frame] = deque()
        self._released: deque[_Frame] = deque()
        self._positions: dict[ReferenceMoment, deque[_Position]] = {
            moment: deque(maxlen=MOST_BREATHS) for moment in (ReferenceMoment.END_EXHALE, ReferenceMoment.END_INHALE)
        }
        self._exhale_us: int | None = None
        self._signal: SignalChoice | None = None
        self._alike = 0.0
        self._is_changed = False
        self.measured_from: Reference | None = None

    def restart_breaths(self) -> None:
        """Expect another breathing monitor from now on: it does not know the last end of exhale yet."""
        self._exhale_us, self._is_changed = None, True

    def clear(self) -> None:
        """Forget all positions: the patient or the camera may be elsewhere."""
        self._is_changed = True
        self._frames.clear()
        for positions in self._positions.values():
            positions.clear()

    def transfer(self, transfer: ReferenceTransfer) -> None:
        """Keep the positions for another model that the reference is transferred to."""
        for positions in self._positions.values():
            moved = [replace(one, reference=transfer.applied(one.reference)) for one in positions]
            positions.clear()
            positions.extend(moved)

    def move(self, before: Motion, now: Motion) -> None:
        """Measure levels from another reference: the motion of one frame from both."""
        self.measured_from = None
        if self._signal is None:
            return
        by = self._signal.value_in(now) - self._signal.value_in(before)
        moved_frames = [one._replace(level=one.level + by) for one in self._frames]
        self._frames.clear()
        self._frames.extend(moved_frames)
        for moment, positions in self._positions.items():
            moved = (replace(one, level=one.level + by) for one in positions)
            self._positions[moment] = deque(moved, maxlen=MOST_BREATHS)

    def follow(
        self,
        active: PreparedModel,
        coefficients: FloatArray,
        motion: Motion,
        breath: Breath,
        timestamp_us: int,
    ) -> bool:
        """Add a measured frame, with the breath of the gated signal; return whether positions were added or dropped."""
        self._keep(active, coefficients, motion, breath.signal, timestamp_us)
        self._alike = max(LEAST_ALIKE_MM * breath.signal.per_mm, ALIKE_SHARE * (breath.amplitude or 0.0))
        exhale_us, before_us = breath.exhale_us, self._exhale_us
        if exhale_us != before_us:
            self._is_changed, self._exhale_us = True, exhale_us
            if exhale_us is None or (before_us is not None and exhale_us < before_us):
                self._withdraw(exhale_us)
            else:
                self._add_breath(active, before_us, exhale_us, motion)
        is_changed, self._is_changed = self._is_changed, False
        return is_changed

    def _add_breath(self, active: PreparedModel, before_us: int | None, exhale_us: int, motion: Motion) -> None:
        """Add the end of exhale, and the end of inhale before it."""
        self._add(ReferenceMoment.END_EXHALE, active, exhale_us, motion)
        inhale_us = None if before_us is None else self._inhale_us(before_us, exhale_us)
        if inhale_us is not None:
            self._add(ReferenceMoment.END_INHALE, active, inhale_us, motion)

    def _keep(
        self, active: PreparedModel, coefficients: FloatArray, motion: Motion, signal: SignalChoice, timestamp_us: int
    ) -> None:
        """Keep a frame; after a gap, and for another signal, nothing before it counts."""
        frames = self._frames
        is_gap = bool(frames) and not 0 < timestamp_us - frames[-1].timestamp_us <= MAX_GAP_US
        if is_gap or (self._signal is not signal and self._signal != signal):
            self.clear()
        if active is not self._active:
            self._released, self._frames = frames, deque()
            frames = self._frames
        for _ in range(min(RELEASED_AT_ONCE, len(self._released))):
            self._released.popleft()
        self._active, self._signal = active, signal
        level = signal.value_in(motion)
        if math.isfinite(level):
            frames.append(_Frame(timestamp_us, coefficients, level, motion.seen))
        while frames and timestamp_us - frames[0].timestamp_us > KEPT_US:
            frames.popleft()

    def _inhale_us(self, before_us: int, exhale_us: int) -> int | None:
        """Return when the signal was highest between two ends of exhale; None if the breath is not kept whole."""
        inhaled = [one for one in self._frames if before_us < one.timestamp_us < exhale_us]
        if not inhaled or inhaled[0].timestamp_us - before_us > AVERAGED_US:
            return None
        return max(inhaled, key=lambda one: one.level).timestamp_us

    def _withdraw(self, exhale_us: int | None) -> None:
        """Drop what lies behind the last end of exhale: a cough was taken for breaths."""
        for moment, positions in self._positions.items():
            kept = (one for one in positions if exhale_us is not None and one.timestamp_us <= exhale_us)
            self._positions[moment] = deque(kept, maxlen=MOST_BREATHS)

    def _add(self, moment: ReferenceMoment, active: PreparedModel, timestamp_us: int, motion: Motion) -> None:
        """Add the mean position of the frames around a turning point; none if they are not kept any more."""
        around = [one for one in self._frames if abs(one.timestamp_us - timestamp_us) <= AVERAGED_US]
        if not around:
            return
        coefficients = np.mean([one.coefficients for one in around], axis=0)
        rays = motion.surface_mm[:, :2] / motion.surface_mm[:, 2:]
        reference = active.reference(
            coefficients,
            vertices_mm(rays, active.node_depth_mm(coefficients)),
            frozen(np.min([of_regions(one.seen) for one in around], axis=0)),
        )
        level = float(np.mean([one.level for one in around]))
        self._positions[moment].append(_Position(timestamp_us=timestamp_us, level=level, reference=reference))

    def position(self, moment: ReferenceMoment, now_us: int) -> Reference | None:
        """Return the mean position at the last such turning points; None if fewer than two are known."""
        positions = self._recent(moment, now_us)
        if len(positions) < LEAST_BREATHS:
            return None
        references = [one.reference for one in positions]
        return Reference(
            regions_mm=frozen(np.mean([one.regions_mm for one in references], axis=0)),
            plane_mm=float(np.mean([one.plane_mm for one in references])),
            volume_l=float(np.mean([one.volume_l for one in references])),
            seen_shares=frozen(np.min([one.seen_shares for one in references], axis=0)),
            surface_mm=frozen(np.mean([one.surface_mm for one in references], axis=0)),
            uncertainty_mm=max(one.uncertainty_mm for one in references),
        )

    def proposals(self, ranges: Ranges, now_us: int) -> tuple[ReferenceProposal, ...]:
        """Return what is proposed at present; ``ranges`` are the learned ones against the present reference."""
        found = []
        for moment in self._positions:
            levels = [one.level for one in self._recent(moment, now_us)]
            if len(levels) >= LEAST_BREATHS and self._signal is not None:
                learned, level = ranges.get(self._signal), float(np.mean(levels))
                found.append(
                    ReferenceProposal(
                        moment=moment,
                        signal=self._signal,
                        level=level,
                        scatter=float(np.std(levels, ddof=1)),
                        breaths=len(levels),
                        percent=None if learned is None else learned.percent(level),
                    )
                )
        return tuple(found)

    def _recent(self, moment: ReferenceMoment, now_us: int) -> list[_Position]:
        """Return the last positions that are alike; none behind a gap, of which no frame may have come yet."""
        if not self._frames or not 0 <= now_us - self._frames[-1].timestamp_us <= MAX_GAP_US:
            return []
        found: list[_Position] = []
        for one in reversed(self._positions.get(moment, ())):
            is_of_now = 0 <= now_us - one.timestamp_us <= MAX_AGE_US
            if not is_of_now or (found and abs(one.level - found[0].level) > self._alike):
                break
            found.append(one)
        return found
