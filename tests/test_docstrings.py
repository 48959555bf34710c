"""The examples in docstrings run, and give what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import fracsim

ROOT = Path(fracsim.__file__).parents[1]
FILES = [
    path.relative_to(ROOT)
    for room in ("fracsim", "envs")
    for path in sorted((ROOT / room).rglob("*.py"))
    if ">>>" in path.read_text(encoding="utf-8")
]


def module_name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_there_are_examples():
    assert len(FILES) > 5


@pytest.mark.parametrize("path", FILES, ids=str)
def test_the_examples_of_a_module_run(path):
    failed, tried = doctest.testmod(importlib.import_module(module_name(path)))
    assert tried
    assert not failed
