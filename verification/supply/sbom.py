"""The bill of materials: CycloneDX 1.6, the same bytes for the same lock file; `make sbom` writes it into docker/.

It holds no time and no serial number, unless SOURCE_DATE_EPOCH gives the time, and no address of any registry: hashes
tell what a package is, wherever it came from.
"""

import argparse
import json
import os
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tests.support.repository import ROOT
from verification.supply.parts import DEBIAN, debian_parts, python_parts

SBOM = ROOT / "docker/sbom.cdx.json"
VENDOR = ROOT / "service/web/dashboard/vendor"


def document() -> dict[str, Any]:
    """Make the bill."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own = f"pkg:generic/{project['name']}@{project['version']}"
    parts = [*_python(), *_debian(), *_vendored()]
    metadata: dict[str, Any] = {
        "component": {
            "type": "application",
            "bom-ref": own,
            "name": project["name"],
            "version": project["version"],
            "description": project["description"],
            "licenses": [{"license": {"id": project["license"]}}],
            "purl": own,
        }
    }
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    if epoch is not None:
        metadata["timestamp"] = datetime.fromtimestamp(int(epoch), UTC).isoformat()
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": metadata,
        "components": parts,
        "dependencies": [{"ref": own, "dependsOn": [part["bom-ref"] for part in parts]}],
    }


def _python() -> list[dict[str, Any]]:
    return [
        {
            "type": "library",
            "bom-ref": part.purl,
            "name": part.name,
            "version": part.version,
            "purl": part.purl,
            **({} if part.licence is None else {"licenses": [{"expression": part.licence}]}),
            "externalReferences": [
                {
                    "type": "distribution",
                    "url": "requirements.lock",
                    "comment": "any of the files that have one of these hashes",
                    "hashes": [{"alg": "SHA-256", "content": sha256} for sha256 in part.sha256],
                }
            ],
        }
        for part in python_parts()
    ]


def _debian() -> list[dict[str, Any]]:
    purls = {name: f"pkg:deb/debian/{name}?distro={DEBIAN}" for name in debian_parts()}
    return [{"type": "library", "bom-ref": purl, "name": name, "purl": purl} for name, purl in purls.items()]


def _vendored() -> list[dict[str, Any]]:
    """What the page brings along, with the checksums of its files."""
    parts = []
    for folder in sorted(path for path in VENDOR.iterdir() if path.is_dir()):
        version, purl, licence = (
            (folder / name).read_text(encoding="utf-8").strip() for name in ("VERSION", "PURL", "SPDX")
        )
        lines = (folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
        files = [
            {"type": "file", "name": name, "hashes": [{"alg": "SHA-256", "content": sha256}]}
            for sha256, name in (line.split() for line in lines)
        ]
        parts.append(
            {"type": "library", "bom-ref": purl, "name": folder.name, "version": version, "purl": purl}
            | {"licenses": [{"license": {"id": licence}}], "components": files}
        )
    return parts


def text_of(bill: dict[str, Any]) -> str:
    """Write it in the one way."""
    return json.dumps(bill, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def trouble_with(text: str) -> str | None:
    """Hold it against the specification's own schema; None where it keeps to it."""
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import (
        JsonStrictValidator,  # takes three seconds, as `tests.support.contract.schemas`
    )

    found = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    return None if found is None else str(found)


def main() -> int:
    """Write, and say what is in it."""
    parser = argparse.ArgumentParser(prog="python -m verification.supply.sbom", description=__doc__)
    parser.add_argument("--out", type=Path, default=SBOM)
    path = parser.parse_args().out
    bill = document()
    text = text_of(bill)
    trouble = trouble_with(text)
    if trouble is not None:
        print(f"not CycloneDX 1.6: {trouble}")  # noqa: T201
        return 1
    path.write_text(text, encoding="utf-8")
    print(f"{path}: {len(bill['components'])} components, CycloneDX 1.6, valid")  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
