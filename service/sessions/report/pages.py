"""The report's pages: one list of sections, typeset as PDF by typst, and written as HTML; the same numbers in both."""

import html
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from service.core.schemas.reports import Range, SessionReport
from service.core.typeset import typeset
from service.sessions.report.picture import trace_svg
from service.sessions.report.reports import StoredReport

NONE = "\N{EN DASH}"
NOTE = "Research and commissioning only; not cleared for clinical use. Times of permitted beam are not a dose."
DIFFERS = "This is not what was signed, or not what the audit has"
SIGNED = "Notes and signatures"
_STYLE = (
    "body{font:15px/1.4 sans-serif;max-width:62em;margin:2em auto;padding:0 1em;color:#131a20}h1{font-size:1.5em}"
    "h2{font-size:1.05em;border-bottom:1px solid #ccd5dd;margin:1.4em 0 .3em}table{border-collapse:collapse;width:100%}"
    "td,th{text-align:left;padding:.15em .8em .15em 0;vertical-align:top}td:first-child{color:#4a5a68}"
    "svg{width:100%;height:auto}p.note{color:#4a5a68}"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A titled table; the first of ``rows`` are its headings where it has some.

    On paper two that are half as wide stand side by side, and details come behind the signatures.
    """

    title: str
    rows: Sequence[Sequence[str]]
    has_headings: bool = False
    is_detail: bool = False
    is_half: bool = False


def report_pdf(stored: StoredReport) -> bytes:
    """Typeset the report: the same bytes for the same session."""
    report = stored.report
    made_at = report.session.ended_at or report.session.created_at
    document = {
        "title": _title(report),
        "note": NOTE,
        "warnings": report.differs,
        "svg": _trace(stored),
        "unsigned": _missing_signatures(report),
        "signed": SIGNED,
        "date": [made_at.year, made_at.month, made_at.day],
        "sections": [
            {
                "title": one.title,
                "rows": one.rows,
                "headings": one.has_headings,
                "detail": one.is_detail,
                "half": one.is_half,
            }
            for one in sections(report)
        ],
    }
    return typeset("service.sessions.report", "report.typ", document, made_at=made_at, form="pdf")


def report_html(stored: StoredReport) -> str:
    """Write the report as a page without scripts, that needs nothing else."""
    report = stored.report
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        f"<title>{html.escape(_title(report))}</title><style>{_STYLE}</style></head><body>",
        *(f"<p class='warning'><strong>{html.escape(one)}</strong></p>" for one in report.differs),
        f"<h1>{html.escape(_title(report))}</h1><p class='note'>{html.escape(NOTE)}</p>",
        _trace(stored),
    ]
    for section in sections(report):
        parts.append(f"<h2>{html.escape(section.title)}</h2><table>")
        for number, row in enumerate(section.rows):
            cell = "th" if section.has_headings and number == 0 else "td"
            parts.append("<tr>" + "".join(f"<{cell}>{html.escape(one)}</{cell}>" for one in row) + "</tr>")
        parts.append("</table>")
    return "".join([*parts, "</body></html>"])


def sections(report: SessionReport) -> list[Section]:
    """Return everything that the report states, in its order."""
    return [
        *([Section(title=DIFFERS, rows=[[one] for one in report.differs])] if report.differs else []),
        Section(title=f"Session ({_zone(report)})", rows=list(_session(report))),
        Section(title="To be looked at", rows=[[one] for one in report.deviations or ["nothing"]]),
        Section(title="Beam", rows=list(_beam(report)), is_half=True),
        Section(title="Motion while the beam was on [mm]", rows=list(_motion(report)), has_headings=True, is_half=True),
        Section(title="Breathing", rows=list(_breathing(report)), is_half=True),
        Section(title="Holds while armed", rows=list(_holds(report)), has_headings=True, is_half=True),
        Section(title="Measurement", rows=list(_measurement(report)), is_half=True),
        *(
            [Section(title="Position against the plan", rows=list(_position(report)), is_half=True)]
            if report.position
            else []
        ),
        *([Section(title=SIGNED, rows=list(_signatures(report)))] if report.signatures else []),
        Section(title="Who did what", rows=list(_events(report)), has_headings=True, is_detail=True),
        Section(title="Pulses", rows=list(_pulses(report)), has_headings=True, is_detail=True),
        *(
            [
                Section(
                    title="Motion by cell while the beam was on, 95 % within [mm]",
                    rows=list(_cells(report)),
                    has_headings=True,
                    is_detail=True,
                )
            ]
            if report.figures.cells
            else []
        ),
        Section(title="Versions and hashes", rows=list(_versions(report)), is_detail=True),
    ]


def _title(report: SessionReport) -> str:
    session = report.session
    return f"{session.patient_reference}, {session.plan_id}, fraction {session.fraction_id}"


def _session(report: SessionReport) -> Iterator[list[str]]:
    session, head = report.session, report.head
    number = "" if session.fraction_number is None else f" (no. {session.fraction_number})"
    yield ["patient", session.patient_reference]
    yield ["plan, fraction", f"{session.plan_id}, {session.fraction_id}{number}"]
    if head.plan_uid:
        yield ["RT Plan", f"{head.plan_label}, {head.plan_uid}"]
    yield ["state", session.status]
    yield ["time", f"{_at(session.started_at)} to {_at(session.ended_at)}"]
    yield ["created by; armed by", f"{session.operator}; {', '.join(head.armed_by) or 'nobody'}"]
    yield ["room; machine", f"{head.room or NONE}; {head.machine or NONE}"]
    yield ["camera", f"{head.camera or NONE}, calibration of {_at(head.calibrated_at)}"]
    yield ["daily QA", head.qa or "none within 24 h before the start"]
    for one in report.windows:
        reason = f" ({one.reason})" if one.reason else ""
        yield [f"window, {_time(one.at)} {one.actor}", f"{one.text}{reason}"]
    if session.source.kind == "recording":
        yield ["recording", session.source.path]
    yield ["session", report.session_id]


def _trace(stored: StoredReport) -> str:
    report = stored.report
    return trace_svg(stored.columns, report.windows, report.events, report.head.first_sample_at, _unit(report))


def _unit(report: SessionReport) -> str:
    return "l" if report.session.window.signal == "volume" else "mm"


def _pulses(report: SessionReport) -> Iterator[list[str]]:
    unit, begin = _unit(report), report.head.first_sample_at
    yield ["pulse", "from", "to", "s", f"largest less least, {unit}"]
    for number, one in enumerate(report.figures.pulse_list, 1):
        ends = (
            f"{at_s:.2f} s" if begin is None else _time(begin + timedelta(seconds=at_s))
            for at_s in (one.from_s, one.to_s)
        )
        yield [str(number), *ends, f"{one.seconds:.2f}", NONE if one.spread is None else f"{one.spread:.2f}"]
    if not report.figures.pulse_list:
        yield [NONE] * 5


def _beam(report: SessionReport) -> Iterator[list[str]]:
    figures = report.figures
    yield ["beam on", f"{figures.beam_on_s:.2f} s"]
    yield ["armed", f"{figures.armed_s:.2f} s"]
    yield ["duty cycle while armed", NONE if figures.duty_percent is None else f"{figures.duty_percent:.1f} %"]
    yield ["pulses", str(figures.pulses)]
    yield ["length of a pulse, median (5 to 95 %)", _range(figures.pulse_s, "s")]


def _motion(report: SessionReport) -> Iterator[list[str]]:
    yield ["region", "mean", "standard deviation", "95 % within", "frames"]
    for one in report.figures.motion:
        yield [
            one.signal,
            _signed(one.mean_mm),
            f"{one.deviation_mm:.2f}",
            f"±{one.within_95_mm:.2f}",
            str(one.frames),
        ]
    if not report.figures.motion:
        yield [NONE] * 5


def _cells(report: SessionReport) -> Iterator[list[str]]:
    cells = report.figures.cells
    yield ["", "right", *[""] * (len(cells[0]) - 2), "left"]
    for number, row in enumerate(cells):
        place = {0: "superior", len(cells) - 1: "inferior"}.get(number, "")
        yield [place, *(NONE if one is None else f"{one:.2f}" for one in row)]


def _breathing(report: SessionReport) -> Iterator[list[str]]:
    figures, unit = report.figures, _unit(report)
    yield ["period, median (5 to 95 %)", _range(figures.period_s, "s")]
    yield ["amplitude, median (5 to 95 %)", _range(figures.amplitude, unit)]
    first, last = figures.baseline_first, figures.baseline_last
    known = [_signed(one) for one in (first, last) if one is not None]
    yield ["end of exhale, first to last 30 s", f"{' to '.join(known)} {unit}" if known else NONE]


def _holds(report: SessionReport) -> Iterator[list[str]]:
    yield ["cause", "holds", "time"]
    for one in report.figures.holds:
        yield [one.text, str(one.count), f"{one.seconds:.2f} s"]
    if not report.figures.holds:
        yield ["none", "0", "0.00 s"]


def _measurement(report: SessionReport) -> Iterator[list[str]]:
    figures = report.figures
    yield ["recorded", f"{figures.recorded_s:.2f} s, {figures.frames} frames"]
    yield ["not measured; never received", f"{figures.lost}; {figures.missed_frames}"]
    times = (figures.latency.p50_ms, figures.latency.p99_ms, figures.latency.max_ms)
    yield ["latency, median; 99 %; longest", "; ".join(NONE if one is None else f"{one:.1f} ms" for one in times)]


def _position(report: SessionReport) -> Iterator[list[str]]:
    for one in report.position:
        value = NONE if one.value is None else f"{_signed(one.value)} {one.unit}"
        yield [one.name, f"{value}, tolerance {one.tolerance:g} {one.unit}"]


def _signatures(report: SessionReport) -> Iterator[list[str]]:
    for one in report.signatures:
        other = "" if one.is_of_this or not one.is_signed else ", another content"
        meaning = "" if one.meaning is None else f" as {one.meaning}"
        act = f"{'signed' if one.is_signed else 'noted'}{meaning} {_at(one.at)}{other}"
        yield [one.name, f"{act}{f': {one.note}' if one.note else ''}"]


def _missing_signatures(report: SessionReport) -> list[str]:
    """Return the lines that are left for pen and paper."""
    names = ("checked by, date", "second person, date")
    return list(names[sum(one.is_signed and one.is_of_this for one in report.signatures) :])


def _events(report: SessionReport) -> Iterator[list[str]]:
    yield ["time", "who", "what"]
    for one in report.events:
        yield [_time(one.at), one.actor, one.text]


def _versions(report: SessionReport) -> Iterator[list[str]]:
    yield ["Tidegate", report.software or NONE]
    yield ["model", report.model or NONE]
    yield ["content of this report, SHA-256", report.content_sha256]
    yield ["samples, SHA-256", report.samples_sha256 or NONE]
    yield ["calibration, SHA-256", report.calibration_sha256 or NONE]
    yield ["settings, SHA-256", report.settings_sha256 or NONE]


def _at(moment: datetime | None) -> str:
    return NONE if moment is None else f"{moment.astimezone():%Y-%m-%d %H:%M:%S}"


def _range(one: Range | None, unit: str) -> str:
    return NONE if one is None else f"{one.median:.2f} ({one.low:.2f} to {one.high:.2f}) {unit}"


def _signed(value: float) -> str:
    text = f"{value:+.2f}"
    return "0.00" if text in {"+0.00", "-0.00"} else text.replace("-", "\N{MINUS SIGN}")


def _time(moment: datetime) -> str:
    return f"{moment.astimezone():%H:%M:%S}"


def _zone(report: SessionReport) -> str:
    """Name the zone of the service's clock, in which all times of the report are."""
    return f"times in {(report.session.started_at or report.session.created_at).astimezone():%Z, UTC%z}"
