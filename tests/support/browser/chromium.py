"""Debian's Chromium under Playwright: found, or the test fails and says how to get it. Never skipped."""

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


def launch_chromium(playwright: Playwright) -> Browser:
    """Start a headless Chromium with a user folder of its own."""
    executable = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert executable is not None, "no Chromium on this machine: apt-get install -y --no-install-recommends chromium"
    return playwright.chromium.launch(executable_path=executable, headless=True, args=list(ARGUMENTS))
