"""Finds the packages: every folder of fracsim/ is one, and envs/ and meshes/ are installed as parts of it."""

from setuptools import find_packages, setup

OUTSIDE = ("envs", "meshes")  # of the fracsim folder, but imported as fracsim.envs and fracsim.meshes

setup(
    packages=[
        *find_packages(include=["fracsim", "fracsim.*"]),
        *(f"fracsim.{name}" for folder in OUTSIDE for name in find_packages(include=[folder, f"{folder}.*"])),
    ],
    package_dir={f"fracsim.{folder}": folder for folder in OUTSIDE},
)
