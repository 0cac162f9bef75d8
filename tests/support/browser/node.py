"""Runs what the page computes without a page: its modules in the Node.js that Playwright brings along."""

import json
import subprocess
from pathlib import Path
from typing import Any

from playwright._impl._driver import compute_driver_executable

from tests.support.repository import ROOT

DASHBOARD = ROOT / "service" / "web" / "dashboard"
# The page's words are fetched when they are imported; here they are read from the files that the service sends.
PRELUDE = """
import { readFile } from "node:fs/promises";
import { basename } from "node:path";
globalThis.localStorage = { getItem: () => null, setItem: () => {} };
globalThis.fetch = async (url) => {
  const isIndex = basename(url.pathname) === "index.json";
  const text = isIndex ? '{"languages": ["en"]}' : await readFile(url, "utf8");
  return { ok: true, json: async () => JSON.parse(text) };
};
"""


def in_node(function: str, argument: Any) -> Any:
    """Return what an asynchronous JavaScript function makes of an argument; ``/js/`` is the page's own folder."""
    node = Path(compute_driver_executable()[0])
    function = function.replace("'/js/", f"'{DASHBOARD.as_uri()}/js/")
    script = f"{PRELUDE}console.log(JSON.stringify(await ({function})({json.dumps(argument)})));"
    command = [node, "--input-type=module", "-"]
    done = subprocess.run(command, input=script, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
