"""A run's figures as text: what a person reads, and what docs/5-evidence/load.md shows."""

from typing import Any

LOSSES = ("absent", "missed", "over_33_ms", "late_33_ms")


def text_of(found: dict[str, Any]) -> str:
    """Write all tables."""
    parts = (_cut_short(found), _frames(found), _clients(found), _requests(found), _machine(found), _marks(found))
    return "\n\n".join("\n".join(part) for part in parts if part)


def _cut_short(found: dict[str, Any]) -> list[str]:
    if not found["is_cut_short"]:
        return []
    quiet_s, loaded_s = (found["processor"][kind]["seconds"] for kind in ("quiet", "loaded"))
    return [f"Ended early, as asked: what {quiet_s:.0f} s of quiet and {loaded_s:.0f} s of load came to."]


def _frames(found: dict[str, Any]) -> list[str]:
    frames = found["frames"]
    lines = [
        "| [ms] | quiet p50 | p99 | p99.9 | max | loaded p50 | p99 | p99.9 | max | loaded/quiet p99 |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, said in (
        ("decision", "received to decided"),
        ("command", "capture to the command at the line"),
        ("late", "received later than its time"),
    ):
        cells = [f"{frames[kind][f'{name}_{part}_ms']:.1f}" for kind in ("quiet", "loaded") for part in _PARTS]
        ratio = frames["loaded"][f"{name}_p99_ms"] / max(frames["quiet"][f"{name}_p99_ms"], 1e-9)
        lines.append(f"| {said} | {' | '.join(cells)} | {ratio:.2f} |")
    lines += [
        "",
        "| | frames | not in the samples | missed by the engine | decided after more than 33 ms | read that late |",
        "|---|---|---|---|---|---|",
    ]
    for kind in ("quiet", "loaded", "all"):
        one = frames[kind]
        cells = " | ".join(f"{one[name]:.0f}" for name in LOSSES)
        lines.append(f"| {kind} | {one['count']:.0f} | {cells} |")
    return lines


_PARTS = ("p50", "p99", "p999", "max")


def _clients(found: dict[str, Any]) -> list[str]:
    clients = found["clients"]
    if not clients["healthy"] + clients["stalled"]:
        return ["No clients on the stream."]
    lines = [
        f"Stream: {clients['healthy']} clients that read, {clients['stalled']} that never do; "
        f"{clients['samples_per_s_least']} to {clients['samples_per_s_most']} samples/s each; "
        f"other messages {clients['other_messages'] or 'none'}.",
        f"Sequence: {clients['gaps']} gaps ({clients['lost_to_gaps']} numbers, "
        f"{clients['skipped_reported']} reported as skipped), "
        f"{clients['backwards']} backwards; closed {clients['closed_why'] or 'none'}.",
    ]
    if clients["healthy"]:
        lines += [
            f"Age at receipt [ms]: p50 {clients['age_p50_ms']}, p99 {clients['age_p99_ms']}, "
            f"p99.9 {clients['age_p999_ms']}, "
            f"worst {clients['age_max_ms']}; older than 67 ms: {100.0 * clients['older_than_two_frames_share']:.3f} %. "
            f"Behind the newest: at most {clients['worst_lag_frames']} frames, more than two at "
            f"{clients['behind_two']} samples. "
            f"Longest silence {clients['longest_silence_ms']} ms.",
            f"(The watching program's own loop was late by {clients['watchers_late_ms']} ms at p99.9, "
            f"{clients['watchers_latest_ms']} ms at worst: part of these ages.)",
        ]
    return lines


def _requests(found: dict[str, Any]) -> list[str]:
    requests = found["requests"]
    lines = ["| request | answers | p50 [ms] | p99 | longest |", "|---|---|---|---|---|"]
    named = {**requests["by_name"], **({"all": requests["all"]} if requests["all"] else {})}
    for name, one in named.items():
        lines.append(f"| {name} | {one['count']} | {one['p50_ms']} | {one['p99_ms']} | {one['max_ms']} |")
    bad = {name: count for name, count in found["answers"].items() if not name.endswith((" 200", " 204"))}
    lines += [
        f"{requests['per_s']} requests/s; not 200: {bad or 'none'}; not sent for want of connections: "
        f"{requests['unsent']}; "
        f"exports: {requests['exports']}, {requests['export_s']} s each, {requests['export_mb']} MB; "
        f"failures of the program: {requests['failures'] or 'none'}."
    ]
    return lines


def _machine(found: dict[str, Any]) -> list[str]:
    lines = [
        "| cores in use | service | its threads waiting for one | load programs | others |",
        "|---|---|---|---|---|",
    ]
    for kind, one in found["processor"].items():
        lines.append(
            f"| {kind}, {one['seconds']:.0f} s | {one['service_cores']:.2f} | {one['service_waited']:.2f} | "
            f"{one['load_cores']:.2f} | {one['others_cores']:.2f} |"
        )
    memory, session = found["memory"], found["session"]
    lines += [
        "",
        f"The service answered after {found['ready_s']} s. Memory of the service [MB]: {memory['idle_mb']} idle, "
        f"{memory['start_mb']} armed, {memory['warm_mb']} after a minute, "
        f"{memory['end_mb']} after "
        f"{memory['seconds'] / 60.0:.1f} min, at most {memory['most_mb']}; {memory['processes']} processes, at most "
        f"{memory['threads_most']} threads and {memory['files_most']} open files ({memory['files_end']} at the end).",
        "Its course, in minutes: resident (of it no file's, and not shared): "
        + ", ".join(f"{one['minute']}: {one['resident_mb']} ({one['own_mb']})" for one in memory["course"])
        + ".",
        f"Session: {session['status']}, {session['frames']} frames, {session['transitions']} transitions; "
        f"frames by gate {session['gate']}; holds {session['hold_reasons']}; {found['log_lines']} log lines.",
        f"Load average of the machine: {found['load_average'][0]:.1f} before, {found['load_average'][1]:.1f} after.",
    ]
    return lines


def _marks(found: dict[str, Any]) -> list[str]:
    lines = ["| mark | | bound | met |", "|---|---|---|---|"]
    for mark in found["marks"]:
        value = (
            f"{mark['value']:.1f} {mark['unit']}".rstrip()
            if mark["unit"] in {"ms", "%", "s", "times", "MB"}
            else f"{mark['value']:.0f} {mark['unit']}"
        )
        lines.append(f"| {mark['name']} | {value.rstrip()} | {mark['bound']} | {'yes' if mark['is_met'] else 'NO'} |")
    return lines
