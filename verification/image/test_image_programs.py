"""The programs that make the image: what is removed and compiled, and what its bill of materials names."""

import importlib.util
import subprocess
import sys

from tests.support.repository import ROOT

FOLDER = ROOT / "docker/image"
STATUS = """Package: libc6
Status: install ok installed
Architecture: amd64
Version: 2.36-9+deb12u14
Description: GNU C Library
 Version: of something else

Package: tzdata
Architecture: all
Version: 2026b-0+deb12u1
"""


def loaded(name):
    spec = importlib.util.spec_from_file_location(f"image_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_never_runs_is_removed_and_what_is_imported_is_compiled(tmp_path):
    site, commands, sources = tmp_path / "site", tmp_path / "bin", tmp_path / "src" / "mine"
    for file in (
        "mine/__init__.py",
        "mine/kernel.h",
        "mine/tests/__init__.py",
        "used/__init__.py",
        "used/late.py",
        "used/tests/test_it.py",
        "used/api.pyi",
        "used/header.h",
        "unused/__init__.py",
        "pyarrow/libarrow_flight.so.1",
        "pyarrow/libarrow.so.1",
    ):
        (site / file).parent.mkdir(parents=True, exist_ok=True)
        (site / file).write_text("")
    commands.mkdir()
    for name in ("python", "tidegate", "uvicorn", "pymodbus.simulator"):
        (commands / name).write_text("")
    sources.mkdir(parents=True)
    (sources / "__init__.py").write_text(
        "import used\n\n\ndef later():\n    from used import late\n    import missing\n"
    )
    (site / "mine/__init__.py").write_text((sources / "__init__.py").read_text())
    subprocess.run(
        [sys.executable, str(FOLDER / "slim.py"), str(site), str(commands), str(sources)],
        env={"PYTHONPATH": str(site)},
        check=True,
    )
    left = {str(path.relative_to(site)) for path in site.rglob("*") if path.is_file()}
    compiled = {name.split("/__pycache__/")[0] for name in left if "__pycache__" in name}
    assert left >= {"mine/kernel.h", "unused/__init__.py", "pyarrow/libarrow.so.1", "used/late.py"}
    assert not left & {"used/tests/test_it.py", "used/api.pyi", "used/header.h", "pyarrow/libarrow_flight.so.1"}
    assert compiled == {"mine", "mine/tests", "used"}
    assert any(name.startswith("used/__pycache__/late.") for name in left), "imported inside a function"
    assert {path.name for path in commands.iterdir()} == {"python", "tidegate"}


def test_debian_packages_have_their_versions():
    parts = {part["name"]: part for part in loaded("bill").debian(STATUS)}
    assert parts["libc6"]["version"] == "2.36-9+deb12u14"
    assert parts["libc6"]["purl"] == "pkg:deb/debian/libc6@2.36-9+deb12u14?arch=amd64"
    assert set(parts) == {"libc6", "tzdata"}


def test_libraries_inside_wheels_are_named_with_the_version_that_they_tell(tmp_path):
    libraries = tmp_path / "opencv_python_headless.libs"
    libraries.mkdir()
    content = {
        "libcrypto-5409cd36.so.1.1.1k": b"..\0OpenSSL 1.1.1k  25 Mar 2021\0",
        "libopenblasp-r0-59ffcd50.3.15.so": b"",
        "libscipy_openblas64_-32a4b2a6.so": b"",
        "libgfortran-040039e1-0352e75f.so.5.0.0": b"",
    }
    for name, said in content.items():
        (libraries / name).write_bytes(said)
    found = {part["name"]: part.get("version") for part in loaded("bill").bundled(tmp_path)}
    assert found == {
        "libcrypto": "1.1.1k",
        "libopenblasp": "3.15",
        "libscipy_openblas64_": None,
        "libgfortran": "5.0.0",
    }


def test_no_video_is_opened_with_opencv():
    """Why FFmpeg and its OpenSSL, which OpenCV's wheel brings, are never called (docs/3-operate/image.md)."""
    sources = [path for package in ("engine", "service") for path in (ROOT / package).rglob("*.py")]
    assert len(sources) > 100
    for path in sources:
        for name in ("VideoCapture", "VideoWriter", "videoio", "cv2.dnn", "imread("):
            assert name not in path.read_text(encoding="utf-8"), f"{path}: {name}"
