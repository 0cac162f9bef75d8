"""What a run came to, as figures with names: for the table, for a file, and for the marks."""

from collections import defaultdict
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from verification.load.frames import Block, FrameTimes, times_in
from verification.load.run import Counted, Outcome
from verification.load.usage import Usage

TWO_FRAMES_MS = 67.0
P99_MARK_MS, P999_MARK_MS = 10.0, 33.0
QUIET_P50_MARK_MS, QUIET_P99_MARK_MS = 1.5, 3.0
P99_MARK_RATIO, P999_MARK_RATIO = 1.5, 2.5
"""Loaded over quiet, of the same run."""
READY_MARK_S = 1.5
IDLE_MARK_MB, ARMED_MARK_MB = 200.0, 350.0
GROWTH_MARK_SHARE = 0.02
MOST_OFF_PERCENT = 90.0
"""A gate that has latched does less work than one in a treatment: its figures would be too good."""
LEAST_TO_JUDGE_MEMORY_S = 600.0
COURSE = 12
WARM_S = 60.0


def figures_of(outcome: Outcome) -> dict[str, Any]:
    """Work everything out."""
    whole = Block(kind="all", begin_s=outcome.begun_s, end_s=outcome.ended_s)
    frames = {
        "quiet": times_in(outcome.frames, outcome.quiet.blocks),
        "loaded": times_in(outcome.frames, outcome.loaded.blocks),
        "all": times_in(outcome.frames, [whole]),
    }
    found: dict[str, Any] = {
        "frames": {name: _frames(times) for name, times in frames.items()},
        "processor": {name: _processor(one) for name, one in (("quiet", outcome.quiet), ("loaded", outcome.loaded))},
        "clients": _clients(outcome.loaded),
        "requests": _requests(outcome.loaded),
        "answers": dict(sorted(outcome.answers.items())),
        "ready_s": round(outcome.ready_s, 2),
        "memory": {"idle_mb": round(outcome.idle.resident_mb, 1), **_memory(outcome.memory)},
        "session": {
            "status": outcome.session["status"],
            "frames": len(outcome.frames),
            "gate": _counts(outcome.frames["gate"].to_pylist()),
            "hold_reasons": _counts([reason for reason in outcome.frames["hold_reason"].to_pylist() if reason]),
            "transitions": outcome.transitions,
        },
        "load_average": list(outcome.load_averages),
        "log_lines": outcome.log.count("\n"),
        "is_cut_short": outcome.is_cut_short,
    }
    found["marks"] = marks_of(found)
    return found


def marks_of(found: dict[str, Any]) -> list[dict[str, Any]]:
    """Hold the figures against what is promised."""
    quiet, loaded, clients = found["frames"]["quiet"], found["frames"]["loaded"], found["clients"]
    memory, gate = found["memory"], found["session"]["gate"]
    off = 1.0 - gate.get("beam_on", 0) / max(sum(gate.values()), 1)
    marks = [
        _mark("the service answers", found["ready_s"], "s", f"at most {READY_MARK_S:g}", READY_MARK_S),
        _mark("memory, idle", memory["idle_mb"], "MB", f"at most {IDLE_MARK_MB:g}", IDLE_MARK_MB),
        _mark("memory, armed", memory["start_mb"], "MB", f"at most {ARMED_MARK_MB:g}", ARMED_MARK_MB),
        *(
            _mark(f"received to decided, quiet, {name}", quiet[f"decision_{name}_ms"], "ms", f"at most {most:g}", most)
            for name, most in (("p50", QUIET_P50_MARK_MS), ("p99", QUIET_P99_MARK_MS))
        ),
        *(
            _mark(
                f"received to decided, {name} over quiet",
                loaded[f"decision_{name}_ms"] / max(quiet[f"decision_{name}_ms"], 1e-9),
                "times",
                f"at most {most:g}",
                most,
            )
            for name, most in (("p99", P99_MARK_RATIO), ("p999", P999_MARK_RATIO))
        ),
        _mark("received to decided, p99", loaded["decision_p99_ms"], "ms", f"at most {P99_MARK_MS:g}", P99_MARK_MS),
        _mark(
            "received to decided, p99.9", loaded["decision_p999_ms"], "ms", f"at most {P999_MARK_MS:g}", P999_MARK_MS
        ),
        _mark("frames in a fault", gate.get("fault", 0), "", "none", 0),
        _mark("frames without beam on", round(100.0 * off, 2), "%", f"at most {MOST_OFF_PERCENT:g}", MOST_OFF_PERCENT),
        _mark("frames lost", found["frames"]["all"]["absent"] + found["frames"]["all"]["missed"], "", "none", 0),
        _mark("frames read more than a frame's time late", found["frames"]["all"]["late_33_ms"], "", "none", 0),
    ]
    if clients["healthy"]:
        marks += [
            _mark("the slowest client is behind the newest", clients["worst_lag_frames"], "frames", "at most 2", 2),
            _mark("healthy clients that were closed", clients["closed"], "", "none", 0),
        ]
    failed = sum(count for name, count in found["answers"].items() if not _is_fine(name))
    marks.append(_mark("requests that failed", failed, "", "none", 0))
    if memory["seconds"] >= LEAST_TO_JUDGE_MEMORY_S:
        bound = 100.0 * GROWTH_MARK_SHARE
        grown = 100.0 * (memory["end_mb"] / memory["warm_mb"] - 1.0)
        marks.append(_mark("memory grown since the first minute", grown, "%", f"at most {bound:g}", bound))
    return marks


def _mark(name: str, value: float, unit: str, bound: str, most: float) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "bound": bound, "is_met": bool(value <= most)}


def _is_fine(answer: str) -> bool:
    """Tell whether an answer is what it should be: a log-in of a flood is refused, all else is not."""
    status = answer.rpartition(" ")[2]
    return status in {"401", "429", "503"} if answer.startswith("log-in") else status.startswith("2")


def _frames(times: FrameTimes) -> dict[str, float]:
    found: dict[str, float] = {"count": times.count, "absent": times.absent, "missed": times.missed}
    found |= {"over_33_ms": times.over, "late_33_ms": times.come_late}
    for name, values in (("decision", times.decision_ms), ("command", times.reported_ms), ("late", times.late_ms)):
        p50, p99, p999, most = np.percentile(values, [50.0, 99.0, 99.9, 100.0]) if times.count else [float("nan")] * 4
        found |= {f"{name}_p50_ms": p50, f"{name}_p99_ms": p99, f"{name}_p999_ms": p999, f"{name}_max_ms": most}
    return {name: round(float(value), 2) for name, value in found.items()}


def _processor(counted: Counted) -> dict[str, float]:
    seconds = max(counted.seconds, 1e-9)
    found = {
        "seconds": seconds,
        "service_cores": counted.processor_s / seconds,
        "service_waited": counted.waited_s / seconds,
        "load_cores": counted.own_s / seconds,
        "others_cores": counted.others_cores,
    }
    return {name: round(value, 3) for name, value in found.items()}


def _clients(loaded: Counted) -> dict[str, Any]:
    reported = [client for block in loaded.watchers for client in block["clients"]]
    healthy = [client for client in reported if not client["is_stalled"]]
    stalled = [client for client in reported if client["is_stalled"]]
    seconds = max(loaded.seconds, 1e-9)
    rates = [client["samples"] for client in healthy]
    others: defaultdict[str, int] = defaultdict(int)
    for client in healthy:
        for kind, count in client["other"].items():
            others[kind] += count
    blocks = max(len(loaded.watchers), 1)
    return {
        "healthy": len(healthy) // blocks,
        "stalled": len(stalled) // blocks,
        "samples": sum(rates),
        "samples_per_s_least": round(min(rates, default=0) * blocks / seconds, 2),
        "samples_per_s_most": round(max(rates, default=0) * blocks / seconds, 2),
        "other_messages": dict(others),
        "skipped_reported": sum(client["skipped_reported"] for client in healthy),
        "gaps": sum(client["gaps"] for client in healthy),
        "lost_to_gaps": sum(client["lost_to_gaps"] for client in healthy),
        "backwards": sum(client["backwards"] for client in healthy),
        "worst_lag_frames": max((client["worst_lag_frames"] for client in healthy), default=0),
        "behind_two": sum(client["behind_two"] for client in healthy),
        "longest_silence_ms": round(max((client["longest_silence_ms"] for client in healthy), default=0.0), 1),
        "closed": sum(client["closed"] is not None for client in healthy),
        "closed_why": _counts([client["closed"] for client in reported if client["closed"]]),
        "watchers_late_ms": round(max((block["late_ms"] for block in loaded.watchers), default=0.0), 1),
        "watchers_latest_ms": round(max((block["latest_ms"] for block in loaded.watchers), default=0.0), 1),
        **_ages(loaded, healthy),
    }


def _ages(loaded: Counted, healthy: list[dict[str, Any]]) -> dict[str, float]:
    if not healthy:
        return {}
    edges = loaded.watchers[0]["edges_ms"]
    bins = np.array([client["ages"] for client in healthy]).sum(axis=0)
    total = max(int(bins.sum()), 1)
    up_to = list(accumulate(bins.tolist()))
    found: dict[str, float] = {"age_max_ms": round(max(client["worst_age_ms"] for client in healthy), 1)}
    for name, share in (("age_p50_ms", 0.5), ("age_p99_ms", 0.99), ("age_p999_ms", 0.999)):
        found[name] = _within(edges, up_to, share * total, found["age_max_ms"])
    old = sum(count for count, edge in zip(bins.tolist()[1:], edges, strict=True) if edge >= TWO_FRAMES_MS)
    found["older_than_two_frames_share"] = round(old / total, 6)
    return found


def _within(edges: list[float], up_to: list[int], rank: float, most: float) -> float:
    """Interpolate within the bin that holds the rank."""
    bounds = [0.0, *edges, max(most, edges[-1])]
    for (low, high), (before, after) in zip(pairwise(bounds), pairwise([0, *up_to]), strict=True):
        if after >= rank:
            return round(min(low + (high - low) * (rank - before) / max(after - before, 1), most), 1)
    return most


def _requests(loaded: Counted) -> dict[str, Any]:
    by_name: defaultdict[str, list[float]] = defaultdict(list)
    for block in loaded.callers:
        for name, latencies in block["latencies_ms"].items():
            by_name[name] += latencies
    exports = [export for block in loaded.callers for export in block["exports"]]
    every = [latency for latencies in by_name.values() for latency in latencies]
    found: dict[str, Any] = {name: _latencies(values) for name, values in sorted(by_name.items())}
    return {
        "by_name": found,
        "all": _latencies(every) if every else {},
        "per_s": round(len(every) / max(loaded.seconds, 1e-9), 1),
        "unsent": sum(block["unsent"] for block in loaded.callers),
        "failures": [failure for block in loaded.callers for failure in block["failures"]],
        "exports": len(exports),
        "export_s": round(float(np.median([seconds for seconds, _ in exports])), 2) if exports else None,
        "export_mb": round(max((size for _, size in exports), default=0) / 1e6, 2),
    }


def _latencies(values: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return {"count": len(values), "p50_ms": round(p50, 1), "p99_ms": round(p99, 1), "max_ms": round(max(values), 1)}


def _memory(seen: list[Usage]) -> dict[str, Any]:
    begun_s = seen[0].at_s
    warm = next((one for one in seen if one.at_s - begun_s >= WARM_S), seen[-1])
    return {
        "seconds": round(seen[-1].at_s - begun_s, 1),
        "start_mb": round(seen[0].resident_mb, 1),
        "warm_mb": round(warm.resident_mb, 1),
        "end_mb": round(seen[-1].resident_mb, 1),
        "most_mb": round(max(one.resident_mb for one in seen), 1),
        "threads_most": max(one.threads for one in seen),
        "files_most": max(one.files for one in seen),
        "files_end": seen[-1].files,
        "processes": seen[-1].processes,
        "course": [_moment(one, begun_s) for one in (*seen[:: max(1, len(seen) // COURSE)], seen[-1])],
    }


def _moment(one: Usage, begun_s: float) -> dict[str, float]:
    return {
        "minute": round((one.at_s - begun_s) / 60.0, 1),
        "resident_mb": round(one.resident_mb, 1),
        "own_mb": round(one.own_mb, 1),
    }


def _counts(values: list[str]) -> dict[str, int]:
    counts: defaultdict[str, int] = defaultdict(int)
    for value in values:
        counts[value] += 1
    return dict(sorted(counts.items()))
