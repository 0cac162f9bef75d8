"""Completes the bill of materials with what is only known in the image: ``bill.py BILL STATUS SITE_PACKAGES OUT``.

Debian's packages with their versions (from a status file of dpkg), and the shared libraries that Python wheels bundle,
each with its hash and, where the file contains it, its version: a scanner of vulnerabilities knows them by no package.
"""

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

BUNDLED = re.compile(r"^(?P<name>lib[\w+]+?)(?:-r0)?(?:-[0-9a-f]{8})*\.(?:so\.)?(?P<version>[\w.]*?)(?:\.?so)?$")
VERSION_INSIDE = {
    "libcrypto": re.compile(rb"OpenSSL (\d+\.\d+\.\d+[a-z]?) "),
    "libssl": re.compile(rb"OpenSSL (\d+\.\d+\.\d+[a-z]?) "),
    "libavcodec": re.compile(rb"FFmpeg version (\S+?)\0"),
}
"""Where a library's bytes contain its version, because its file name has the interface's version only."""


def main() -> None:
    """Read, complete, write."""
    bill, status, site, out = map(Path, sys.argv[1:5])
    document = json.loads(bill.read_text(encoding="utf-8"))
    others = [part for part in document["components"] if not part["purl"].startswith("pkg:deb/")]
    own = document["metadata"]["component"]["bom-ref"]
    document["components"] = [*others, *debian(status.read_text(encoding="utf-8")), *bundled(site)]
    document["dependencies"] = [{"ref": own, "dependsOn": [part["bom-ref"] for part in document["components"]]}]
    out.write_text(json.dumps(document, indent=1, ensure_ascii=False, sort_keys=True) + "\n", encoding="utf-8")
    sys.stdout.write(f"{out}: {len(document['components'])} components\n")


def debian(status: str) -> Iterator[dict[str, Any]]:
    """Yield the packages of a status file of dpkg, by name."""
    parts = {}
    for paragraph in status.split("\n\n"):
        fields = dict(re.findall(r"(?m)^([\w-]+): (.*)$", paragraph))
        if "Package" in fields:
            purl = f"pkg:deb/debian/{fields['Package']}@{fields['Version']}?arch={fields['Architecture']}"
            parts[fields["Package"]] = {
                "type": "library",
                "bom-ref": purl,
                "name": fields["Package"],
                "version": fields["Version"],
                "purl": purl,
            }
    yield from (parts[name] for name in sorted(parts))


def bundled(site: Path) -> Iterator[dict[str, Any]]:
    """Yield the shared libraries that wheels carry in their ``.libs`` folders."""
    for path in sorted(site.glob("*.libs/*")):
        found = BUNDLED.match(path.name)
        if found is None:
            continue
        content = path.read_bytes()
        pattern = VERSION_INSIDE.get(found["name"])
        inside = pattern.search(content) if pattern else None
        version = inside[1].decode() if inside else found["version"]
        purl = f"pkg:generic/{found['name']}@{version}" if version else f"pkg:generic/{found['name']}"
        sha256 = hashlib.sha256(content).hexdigest()
        yield {
            "type": "library",
            "bom-ref": f"{purl}#{path.parent.name}/{path.name}",
            "name": found["name"],
            **({"version": version} if version else {}),
            "purl": purl,
            "description": f"in the wheel of {path.parent.name.removesuffix('.libs')}",
            "hashes": [{"alg": "SHA-256", "content": sha256}],
        }


if __name__ == "__main__":
    main()
