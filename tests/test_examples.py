"""The examples run, show something break, and say so with their exit code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
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


def film(path):
    """The frames of a GIF, (n, height, width, 3), and how long each is shown, ms."""
    image = pytest.importorskip("PIL.Image")
    frames, durations = [], []
    with image.open(path) as gif:
        for k in range(gif.n_frames):
            gif.seek(k)
            durations.append(gif.info["duration"])
            frames.append(np.array(gif.convert("RGB")).astype(int))
    return np.array(frames), durations


def is_object(frames):
    """The objects are warm in colour, and the floor and the sky are grey."""
    return frames[..., 0] - frames[..., 2] > 12


def test_the_film_of_a_drop_shows_the_object_whole_and_then_in_pieces(tmp_path):
    result = run("drop.py", "--out", "drop.gif", "--slow-motion", "1", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    frames, durations = film(tmp_path / "drop.gif")
    assert frames.shape[1:] == (360, 480, 3)
    assert 15 < len(frames) < 40  # about a second
    assert set(durations[:-1]) == {40}
    assert durations[-1] == 1000
    seen = is_object(frames)
    assert ((seen.mean(axis=(1, 2)) > 0.01) & (seen.mean(axis=(1, 2)) < 0.2)).all()
    # It falls in the middle of the image, as the camera follows it; what has broken spreads.
    places = [np.argwhere(mask) for mask in (seen[0], seen[-1])]
    assert np.abs(places[0].mean(axis=0) - (180, 240)).max() < 40
    assert places[1].std(axis=0).max() > 1.3 * places[0].std(axis=0).max()
    moved = np.abs(np.diff(frames, axis=0)).max(axis=3) > 20
    assert (moved[:15].mean(axis=(1, 2)) > 0.002).all()  # no frame twice while it falls and breaks


def test_the_film_of_a_throw_shows_the_ball_come_and_the_object_break(tmp_path):
    result = run("throw.py", "--out", "throw.gif", "--slow-motion", "1", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    frames, _ = film(tmp_path / "throw.gif")
    assert frames.shape[1:] == (360, 480, 3)
    # The ball is the only thing as dark; it comes from the left and passes through where the object stands.
    dark = frames.max(axis=3) < 110
    columns = [np.argwhere(mask)[:, 1].mean() for mask in dark if mask.sum() > 20]
    assert len(columns) > 5
    assert columns[0] < 200 < max(columns)
    seen = is_object(frames)
    assert seen[-1].any(axis=0).sum() > 1.3 * seen[0].any(axis=0).sum()  # pieces lie over more columns
