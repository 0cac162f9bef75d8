"""Names the packages of this folder, which is itself the package `lab`; everything else is in pyproject.toml."""

from setuptools import find_packages, setup

setup(
    packages=["lab", *(f"lab.{name}" for name in find_packages(exclude=["build*"]))],
    package_dir={"lab": "."},
)
