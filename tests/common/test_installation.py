"""Every printed install command installs this fracsim, wherever it came from, and nobody else's."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import fracsim
from fracsim.common import installation

ROOT = Path(__file__).parents[2]


def test_a_checkout_is_installed_from_where_it_lies():
    assert installation.install_command("bake") == f'pip install -c "{ROOT}/constraints.txt" -e "{ROOT}[bake]"'
    assert str(fracsim.MissingExtraError("coacd", "bake")).endswith(
        f'comes with: pip install -c "{ROOT}/constraints.txt" -e "{ROOT}[bake]"'
    )


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (None, 'pip install "fracsim-pybullet[bake]"'),
        ({"url": "file:///nowhere/at/all", "dir_info": {}}, 'pip install "fracsim-pybullet[bake]"'),
        (
            {"url": "https://example.org/a.whl", "archive_info": {}},
            'pip install "fracsim-pybullet[bake] @ https://example.org/a.whl"',
        ),
        (
            {"url": "https://example.org/a.git", "vcs_info": {"vcs": "git", "commit_id": "ab12"}},
            'pip install "fracsim-pybullet[bake] @ git+https://example.org/a.git@ab12"',
        ),
    ],
    ids=["index", "deleted", "wheel on the web", "repository"],
)
def test_an_installed_package_is_installed_from_where_pip_got_it(monkeypatch, source, expected):
    monkeypatch.setattr(installation, "_is_checkout", lambda _: False)
    monkeypatch.setattr(installation, "_recorded_source", lambda: source)
    assert installation.install_command("bake") == expected


def test_a_wheel_on_disk_is_installed_from_its_file(monkeypatch, tmp_path):
    wheel = tmp_path / "a wheel.whl"
    wheel.touch()
    monkeypatch.setattr(installation, "_is_checkout", lambda _: False)
    monkeypatch.setattr(installation, "_recorded_source", lambda: {"url": wheel.as_uri(), "archive_info": {}})
    assert installation.install_command("plot") == f'pip install "{wheel}[plot]"'


def test_the_distribution_is_the_one_that_pyproject_names():
    assert f'name = "{installation.DISTRIBUTION}"' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize("extra", ["bake", "train", "plot", "tune", "ray", "elastic"])
def test_every_extra_that_messages_name_is_declared(extra):
    assert f"\n{extra} = [" in (ROOT / "pyproject.toml").read_text()


def test_pip_accepts_the_printed_command():
    pytest.importorskip("setuptools")  # pip builds without isolation here
    command = shlex.split(installation.install_command("plot"))
    assert command[:2] == ["pip", "install"]
    options = ["--dry-run", "--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--no-index"]
    done = subprocess.run(
        [sys.executable, "-m", *command[:2], *options, *command[2:]], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Would install fracsim-pybullet-" in done.stdout
    assert "does not provide the extra" not in done.stderr
