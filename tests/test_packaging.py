"""The wheel: every room of the package, the environments, and the meshes and assets that ship."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {"fracsim": "fracsim", "envs": "fracsim/envs", "meshes": "fracsim/meshes"}  # and where a wheel has them


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    pytest.importorskip("setuptools", "77")
    source = tmp_path_factory.mktemp("source")
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", ".", "."],
        cwd=source,
        check=True,
    )
    [path] = source.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def test_every_module_and_every_mesh_is_in_the_wheel(wheel):
    expected = {
        f"{target}/{path.relative_to(ROOT / folder)}"
        for folder, target in FOLDERS.items()
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".obj", ".frac", ".typed") and "__pycache__" not in path.parts
    }
    assert {"fracsim/physics/world.py", "fracsim/envs/__init__.py", "fracsim/meshes/bunny.frac"} <= expected
    packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert packed == expected


def test_the_wheel_says_what_it_is_called_and_what_it_needs(wheel):
    [metadata] = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
    headers = Parser().parsestr(wheel.read(metadata).decode())
    assert headers["Name"] == "fracsim-pybullet"
    core = [need for need in headers.get_all("Requires-Dist") if "extra ==" not in need]
    assert {need.split(";")[0].split(">")[0].strip() for need in core} == {
        "gymnasium",
        "numpy",
        "pybullet",
        "pybullet-arm64",
        "safetensors",
        "scipy",
    }
    [entries] = [name for name in wheel.namelist() if name.endswith("entry_points.txt")]
    assert "fracsim = fracsim.cli.main:main" in wheel.read(entries).decode()
