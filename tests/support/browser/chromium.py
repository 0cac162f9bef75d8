"""Debian's Chromium under Playwright: found, or the test fails and says how to get it. Never skipped.

Most tests run the same engine without the browser's own windows (``chromium-headless-shell``): a page there takes half
the processor time. What covers the whole way from the page to the engine runs the browser that a clinic has.
"""

import os
import shutil
import subprocess
from pathlib import Path

from playwright.sync_api import Browser, Playwright

ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


BROWSER = ("chromium", "chromium-browser", "google-chrome")
SHELL = ("chromium-headless-shell", *BROWSER)


def launch_chromium(playwright: Playwright, *, is_shell: bool = True, home: Path | None = None) -> Browser:
    """Start a headless Chromium with a user folder of its own: the shell, or the whole browser.

    ``home`` is a folder that :func:`trust` has prepared: its certificates are trusted, as those of a site.
    """
    names = SHELL if is_shell else BROWSER
    executable = next(filter(None, map(shutil.which, names)), None)
    assert executable is not None, f"not on this machine: apt-get install -y --no-install-recommends {names[0]}"
    environment = None if home is None else {**os.environ, "HOME": str(home)}
    return playwright.chromium.launch(
        executable_path=executable,
        headless=True,
        args=list(ARGUMENTS),
        ignore_default_args=["--hide-scrollbars"],
        env=environment,
    )


def trust(home: Path, certificate: Path) -> None:
    """Put a certificate among the authorities that a browser started with this home folder trusts."""
    executable = shutil.which("certutil")
    assert executable is not None, "not on this machine: apt-get install -y --no-install-recommends libnss3-tools"
    database = home / ".pki" / "nssdb"
    database.mkdir(parents=True, exist_ok=True)
    place = ("-d", f"sql:{database}")
    if not (database / "cert9.db").exists():
        subprocess.run([executable, "-N", *place, "--empty-password"], check=True)
    subprocess.run(
        [executable, "-A", *place, "-n", certificate.parent.name, "-t", "C,,", "-i", str(certificate)], check=True
    )
