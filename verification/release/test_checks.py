"""A release is refused for each thing that is not ready, and for nothing else."""

import json
import subprocess

import pytest

from tests.support.documents.figures import SOURCES, code_of
from tests.support.repository import ROOT
from verification.release.checks import project_version, troubles


def git(folder, *words):
    subprocess.run(
        ["git", "-c", "user.name=T", "-c", "user.email=t@t", *words], cwd=folder, check=True, capture_output=True
    )


def figures(code=None):
    """Return the parts that the figures stand in, of this code or another."""
    return "".join(
        f"<!-- made: {part} -->\nat commit 1234abcd, code `{code or code_of(part)}`\n<!-- end: {part} -->\n"
        for part in SOURCES
    )


@pytest.fixture
def ready(tmp_path):
    """A checkout that is ready to be released as 1.2.3."""
    files = {
        "pyproject.toml": '[project]\nversion = "1.2.3"\n',
        "lab/pyproject.toml": 'version = "1.2.3"\ndependencies = ["tidegate==1.2.3"]\n',
        "engine/__init__.py": '__version__ = "1.2.3"\n',
        "openapi/openapi.json": '{"info": {"version": "1.2.3"}}',
        "openapi/released/1.2.3.json": '{"info": {"version": "1.2.3"}}',
        "docker/sbom.cdx.json": '{"bom-ref": "pkg:generic/tidegate@1.2.3"}',
        "docs/5-evidence/evaluation.md": figures(),
        "CHANGELOG.md": "# Changelog\n\n## [Unreleased]\n\n## [1.2.3] - 2026-11-23\n- Something.\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-qm", "all")
    return tmp_path


def test_what_is_ready_has_nothing_against_it_tagged_or_not(ready):
    assert list(troubles(ready)) == []
    git(ready, "tag", "v1.2.3")
    assert list(troubles(ready)) == []


BROKEN = {
    "pyproject.toml": ('[project]\nversion = "1.2"\n', "MAJOR.MINOR.PATCH"),
    "lab/pyproject.toml": (
        'version = "1.2.3"\ndependencies = ["tidegate==1.2.2"]\n',
        "lab/pyproject.toml: version missing",
    ),
    "engine/__init__.py": ('__version__ = "1.2.2"\n', "engine/__init__.py: version 1.2.2"),
    "openapi/openapi.json": ('{"info": {"version": "1.2.4"}}', "openapi/openapi.json: version 1.2.4"),
    "openapi/released/1.2.3.json": ("{}", "must be a copy"),
    "docs/5-evidence/evaluation.md": (figures("0123456789abcdef"), "run make docs-figures"),
    "docker/sbom.cdx.json": ("{}", "docker/sbom.cdx.json: version missing"),
    "CHANGELOG.md": ("# Changelog\n\n## [Unreleased]\n- More.\n\n## [1.2.3] - 2026-11-23\n", "has entries"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_each_place_with_another_version_stands_against_it(ready, name):
    text, words = BROKEN[name]
    (ready / name).write_text(text)
    git(ready, "commit", "-qam", "broken")
    assert any(words in one for one in troubles(ready))


@pytest.mark.parametrize(
    "text", ["## [Unreleased]\n\n## [1.2.3]\n", "## [Unreleased]\n\n## [1.2.2] - 2026-11-01\n", ""]
)
def test_the_changelog_must_have_the_release_with_its_day(ready, text):
    (ready / "CHANGELOG.md").write_text(text)
    git(ready, "commit", "-qam", "broken")
    assert any(one.startswith("CHANGELOG.md") for one in troubles(ready))


def test_changes_that_are_not_committed_stand_against_it(ready):
    (ready / "new").write_text("")
    assert any("not committed" in one for one in troubles(ready))


def test_a_tag_of_this_version_on_another_commit_or_of_another_version_here_stands_against_it(ready):
    git(ready, "tag", "v1.2.3")
    git(ready, "commit", "-q", "--allow-empty", "-m", "later")
    assert any("on another commit" in one for one in troubles(ready))
    git(ready, "tag", "v9.9.9")
    assert any("tagged v9.9.9" in one for one in troubles(ready))


def test_this_checkout_has_one_version():
    version = project_version(ROOT)
    assert [one for one in troubles(ROOT) if ": version" in one] == []
    assert json.loads((ROOT / "openapi/openapi.json").read_text())["info"]["version"] == version
