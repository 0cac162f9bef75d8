"""Builds the optional C extension of the frame path; everything else of the build is in pyproject.toml.

Where it cannot be built (no compiler, no headers of Python) the installation goes on without it, and the numpy forms
run: `tidegate --version` says which.
"""

import hashlib
from pathlib import Path

from setuptools import Extension, setup

FOLDER = Path("engine/core/compiled")
SOURCES = sorted(FOLDER.glob("*.[ch]"))
# The same bits on every processor: no sum is reordered, no product is fused into one.
FLAGS = [
    "-std=c11",
    "-O3",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
]
# engine/core/compiled/__init__.py computes the same of the sources beside it, and refuses a stale build.
DIGEST = hashlib.sha256(b"".join(path.read_bytes() for path in SOURCES)).hexdigest()[:16]

setup(
    ext_modules=[
        Extension(
            "engine.core.compiled._kernels",
            sources=[str(path) for path in SOURCES if path.suffix == ".c"],
            depends=[str(path) for path in SOURCES],
            define_macros=[("SOURCE_DIGEST", f'"{DIGEST}"')],
            extra_compile_args=FLAGS,
            libraries=["m"],
            optional=True,
        )
    ]
)
