"""The examples run, show something break, and say so with their exit code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(script, *arguments, cwd):
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


@pytest.mark.parametrize("script", ["drop.py", "throw.py"])
def test_an_example_breaks_its_object_and_prints_the_pieces(script, tmp_path):
    result = run(script, "--no-gif", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "pieces" in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_drop_too_low_to_break_anything_exits_with_an_error_code(tmp_path):
    result = run("drop.py", "--no-gif", "--height", "0.001", "--size", "0.01", cwd=tmp_path)
    assert result.returncode == 1
    assert "did not break" in result.stdout


def test_the_gif_has_many_frames_and_is_small(tmp_path):
    image = pytest.importorskip("PIL.Image")
    result = run("drop.py", "--out", "small.gif", "--slow-motion", "1", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    with image.open(tmp_path / "small.gif") as gif:
        assert gif.n_frames > 15
        assert gif.size == (480, 360)
    assert (tmp_path / "small.gif").stat().st_size < 2e6
