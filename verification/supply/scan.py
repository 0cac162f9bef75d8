"""`make scan`: bandit, ruff's security rules, pip-audit on both lock files, and what every package is licensed under.

Exits with 1 on any finding. Known vulnerabilities are asked for over the network: where no one answers that is said
aloud, and nothing was audited.
"""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

from tests.support.repository import ROOT
from verification.supply.parts import python_parts

PACKAGES = ("engine", "service", "lab", "migrations")
LOCKS = ("requirements.lock", "requirements-cluster.lock", "requirements-dev.lock")
PATIENCE_S = 300


def main() -> int:
    """Run all; say one line for each, more where something was found."""
    return max(_bandit(), _ruff(), *(_audit(ROOT / lock) for lock in LOCKS), _licences())


def _tool(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).with_name(name)), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - it is what the command is for


def _bandit() -> int:
    done = _tool("bandit", "-q", "-c", "pyproject.toml", "-r", *PACKAGES, "-f", "json")
    reported = json.loads(done.stdout)
    totals = reported["metrics"]["_totals"]
    _say(f"bandit: {len(reported['results'])} findings in {totals['loc']} lines, {totals['skipped_tests']} explained")
    for one in reported["results"]:
        _say(f"  {one['filename']}:{one['line_number']} {one['test_id']} {one['issue_text']}")
    return min(1, len(reported["results"]) + len(reported["errors"]))


def _ruff() -> int:
    done = _tool("ruff", "check", "--select", "S", "--ignore", "S101", *PACKAGES)
    _say(f"ruff S: {done.stdout.strip().splitlines()[-1]}")
    return done.returncode


def _audit(lock: Path) -> int:
    options = ("--require-hashes", "--disable-pip", "--progress-spinner", "off", "--timeout", "10", "-f", "json")
    try:
        done = _tool("pip-audit", "-r", str(lock), *options)
        found = json.loads(done.stdout)["dependencies"]
    except (subprocess.TimeoutExpired, ValueError, KeyError):
        found = []
    return judged(lock.name, found)


def judged(name: str, found: list[dict[str, object]]) -> int:
    """Say what the audit of one lock file is worth."""
    asked = [one for one in found if "skip_reason" not in one]
    if not asked:
        _say(f"pip-audit {name}: NOTHING WAS AUDITED, no service with known vulnerabilities could be asked from here")
        return 0
    bad = [one for one in asked if one.get("vulns")]
    _say(f"pip-audit {name}: {len(bad)} of {len(asked)} packages with known vulnerabilities, {len(found)} in all")
    for one in bad:
        _say(f"  {one['name']} {one['version']}: {one['vulns']}")
    return min(1, len(bad))


def _licences() -> int:
    parts = python_parts()
    unreported = [part.name for part in parts if part.licence is None]
    counted = Counter(part.licence for part in parts if part.licence is not None)
    _say("licences: " + ", ".join(f"{n} {name}" for name, n in sorted(counted.items(), key=lambda one: -one[1])))
    if unreported:
        _say(f"  not declared by what is installed: {', '.join(unreported)}")
    return min(1, len(unreported))


if __name__ == "__main__":
    sys.exit(main())
