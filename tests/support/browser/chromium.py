"""Debian's Chromium under Playwright: found, or the test fails and says how to get it. Never skipped.

Most tests run the same engine without the browser's own windows (``chromium-headless-shell``): a page there takes half
the processor time. What covers the whole way from the page to the engine runs the browser that a clinic has.
"""

import shutil

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


def launch_chromium(playwright: Playwright, *, is_shell: bool = True) -> Browser:
    """Start a headless Chromium with a user folder of its own: the shell, or the whole browser."""
    names = SHELL if is_shell else BROWSER
    executable = next(filter(None, map(shutil.which, names)), None)
    assert executable is not None, f"not on this machine: apt-get install -y --no-install-recommends {names[0]}"
    return playwright.chromium.launch(executable_path=executable, headless=True, args=list(ARGUMENTS))
