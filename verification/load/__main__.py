"""Load on a real service: ``python -m verification.load [--dashboards 200] [--requests-per-s 50] [--seconds 120]``.

Quiet and loaded blocks alternate within one session, so that a run compares itself with itself. Exit code 0 when every
mark is met or ``--strict`` was not given, 1 when one is not, 2 for a usage that is none. Ctrl-C or SIGTERM ends it
early: it tells what it has measured, and the exit code is 130; once more, and it leaves everything at once.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from verification.load.figures import figures_of
from verification.load.interruption import Ending
from verification.load.run import Load, run
from verification.load.service import LoadError
from verification.load.table import text_of

LOADED_SHARE = 2.0 / 3.0
LONGEST_ROUND_S = 300.0
INTERRUPTED = 130
"""A shell's exit code after Ctrl-C."""


def main(arguments: list[str] | None = None) -> int:
    """Run, and print."""
    asked = _parser().parse_args(arguments)
    ending = Ending()
    try:
        with ending.installed():
            found = figures_of(run(_load(asked), _tell, ending))
    except KeyboardInterrupt:
        sys.stderr.write(f"verification.load: ended {'without' if ending.is_asked else 'before there were'} figures\n")
        return INTERRUPTED
    except LoadError as error:
        sys.stderr.write(f"verification.load: {error}\n")
        return 2
    found["command"] = "python -m verification.load " + " ".join(sys.argv[1:] if arguments is None else arguments)
    sys.stdout.write(text_of(found) + "\n")
    if asked.out:
        asked.out.parent.mkdir(parents=True, exist_ok=True)
        asked.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if ending.is_asked:
        return INTERRUPTED
    return int(asked.strict and not all(mark["is_met"] for mark in found["marks"]))


def _tell(step: str) -> None:
    sys.stderr.write(f"{step}\n")
    sys.stderr.flush()


def _load(asked: argparse.Namespace) -> Load:
    seconds = 60.0 * asked.minutes if asked.minutes else asked.seconds
    rounds = asked.rounds or max(1, round(seconds / LONGEST_ROUND_S), min(4, round(seconds / 30.0)))
    load = Load(
        dashboards=asked.dashboards,
        events=asked.events,
        stalled=asked.stalled,
        stream_query=asked.stream,
        requests_per_s=asked.requests_per_s,
        export=None if asked.no_export else asked.export,
        is_holding=not asked.no_holds,
        is_flooded=asked.flood,
        rounds=rounds,
        checkout=asked.checkout,
        database_url=asked.database_url,
        has_tls=asked.tls,
    )
    a_round_s = seconds / rounds
    quiet_s = min(a_round_s * (1.0 - LOADED_SHARE), 20.0)
    return replace(load, quiet_s=quiet_s, loaded_s=a_round_s - quiet_s)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m verification.load", description=__doc__)
    parser.add_argument("--dashboards", type=int, default=200, help="clients on the stream")
    parser.add_argument("--events", type=int, default=0, help="so many of them get server-sent events")
    parser.add_argument("--stalled", type=int, default=0, help="so many of them never read")
    parser.add_argument("--stream", default="", help="query of the stream, as in form=thin")
    parser.add_argument("--requests-per-s", type=float, default=50.0)
    parser.add_argument("--export", choices=("csv", "arrow"), default="csv")
    parser.add_argument("--no-export", action="store_true")
    parser.add_argument("--no-holds", action="store_true", help="nobody holds the beam by hand now and then")
    parser.add_argument("--flood", action="store_true", help="eight clients try to log in beside")
    parser.add_argument("--seconds", type=float, default=120.0, help="of all blocks together")
    parser.add_argument("--minutes", type=float, help="the same, for a long run")
    parser.add_argument("--rounds", type=int, help="of a quiet and a loaded block")
    parser.add_argument("--checkout", type=Path, help="run the service of another checkout, with this environment")
    parser.add_argument("--database-url", help="of a PostgreSQL database that the service uses")
    parser.add_argument("--tls", action="store_true", help="all of it over the service's own TLS")
    parser.add_argument("--out", type=Path, help="file for all figures, in JSON")
    parser.add_argument("--strict", action="store_true", help="exit code 1 when a mark is not met")
    return parser


if __name__ == "__main__":
    sys.exit(main())
