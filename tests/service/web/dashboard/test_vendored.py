"""What the page brings along of others is as published: version, licence and checksums beside it, in the bill too."""

import hashlib
import json
from pathlib import Path

import pytest

import service
from tests.support.repository import ROOT

VENDOR = Path(service.__file__).parent / "web" / "dashboard" / "vendor"
DESCRIPTIONS = {"VERSION", "PURL", "SPDX", "SHA256SUMS"}
FOLDERS = sorted(path for path in VENDOR.iterdir() if path.is_dir())


def sums(folder: Path) -> dict[str, str]:
    lines = (folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
    return {name: sha256 for sha256, name in (line.split() for line in lines)}


def test_there_is_something_to_check():
    assert [folder.name for folder in FOLDERS] == ["inter", "three", "uplot"]


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_every_file_is_the_one_of_its_checksum_and_none_is_without(folder: Path):
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}
    assert {name: found[name] for name in found.keys() - DESCRIPTIONS} == sums(folder)
    assert "LICENSE" in found
    assert found.keys() >= DESCRIPTIONS


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_version_and_checksums_are_in_the_bill_of_materials(folder: Path):
    version = (folder / "VERSION").read_text(encoding="utf-8").strip()
    bill = json.loads((ROOT / "docker/sbom.cdx.json").read_text(encoding="utf-8"))
    purl, licence = ((folder / name).read_text(encoding="utf-8").strip() for name in ("PURL", "SPDX"))
    assert purl.endswith(f"/{folder.name}@{version}")
    (part,) = [one for one in bill["components"] if one["purl"] == purl]
    assert part["licenses"] == [{"license": {"id": licence}}]
    assert {one["name"]: one["hashes"][0]["content"] for one in part["components"]} == sums(folder)


def test_uplot_states_its_version_and_its_licence_itself():
    folder = VENDOR / "uplot"
    version = (folder / "VERSION").read_text(encoding="utf-8").strip()
    assert "MIT License" in (folder / "LICENSE").read_text(encoding="utf-8")
    assert f"(v{version})" in (folder / "uPlot.esm.js").read_text(encoding="utf-8")[:600]


def test_the_font_is_under_its_licence_and_the_page_s_own():
    assert "SIL OPEN FONT LICENSE" in (VENDOR / "inter" / "LICENSE").read_text(encoding="utf-8")
    styles = (VENDOR.parent / "css" / "page.css").read_text(encoding="utf-8")
    for face in sorted((VENDOR / "inter").glob("*.woff2")):
        assert face.read_bytes()[:4] == b"wOF2"
        assert f"../vendor/inter/{face.name}" in styles


def test_the_page_needs_no_other_origin_and_no_inline_style_or_script():
    page = (VENDOR.parent / "index.html").read_text(encoding="utf-8")
    assert "vendor/uplot/uPlot.min.css" in page
    assert "<style" not in page
    assert " style=" not in page
    assert page.count("<script") == 1
