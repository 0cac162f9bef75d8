"""The bill of materials in the image is that of the lock file, keeps to its specification and tells no place."""

import json
import re

from verification.supply.parts import LOCK, debian_parts, python_parts
from verification.supply.sbom import SBOM, document, text_of, trouble_with

KEPT = SBOM.read_text(encoding="utf-8")


def test_the_kept_bill_is_what_the_lock_file_and_the_image_s_recipe_say():
    assert text_of(document()) == KEPT, "run `make sbom`"


def test_it_keeps_to_the_specification_and_a_bent_one_does_not():
    assert trouble_with(KEPT) is None
    bent = json.loads(KEPT)
    bent["components"][0]["type"] = "lybrary"
    assert trouble_with(json.dumps(bent)) is not None


def test_every_locked_package_is_in_it_with_all_its_hashes_and_its_licence():
    reported = {part["name"]: part for part in json.loads(KEPT)["components"]}
    locked = LOCK.read_text(encoding="utf-8")
    names = re.findall(r"(?m)^([A-Za-z0-9._-]+)==", locked)
    assert len(names) > 40
    for name in names:
        assert reported[name]["licenses"], name
    hashes = [
        one["content"]
        for part in reported.values()
        for ref in part.get("externalReferences", ())
        for one in ref["hashes"]
    ]
    assert sorted(hashes) == sorted(re.findall(r"sha256:([0-9a-f]{64})", locked))


def test_the_image_s_own_packages_are_in_it():
    assert {"python3", "libopenni2-0", "libusb-1.0-0"} <= set(debian_parts())
    assert all(f'"name": "{name}"' in KEPT for name in debian_parts())


def test_it_contains_no_time_host_or_registry_of_its_making():
    assert "http://" not in KEPT
    assert "https://" not in KEPT
    assert "timestamp" not in KEPT
    assert "serialNumber" not in KEPT


def test_the_time_is_included_where_given(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    assert document()["metadata"]["timestamp"] == "2001-09-09T01:46:40+00:00"


def test_a_line_of_the_lock_file_is_read_whole():
    lock = "a-b==1.2 \\\n    --hash=sha256:" + "0" * 64 + " \\\n    --hash=sha256:" + "1" * 64 + "\n    # via c\nc==3\n"
    first, second = python_parts(lock)
    assert (first.name, first.version, len(first.sha256), first.purl) == ("a-b", "1.2", 2, "pkg:pypi/a-b@1.2")
    assert (second.name, second.sha256) == ("c", ())
