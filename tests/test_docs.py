"""What the pages say: their tables are what was measured, their code runs, their commands are understood."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import fracsim
from fracsim.cli.imports import split_imports
from fracsim.cli.main import build_parser

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
BLOCK = re.compile(r"^(?P<note><!--[^\n]*?-->\n)?```(?P<kind>\w*)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
NOT_RUN = "<!-- not run:"  # before a block that takes long or needs what is not there; a reason follows


def blocks(kind):
    """Every block of a kind on the pages: its page, the number of its line, its text, and the comment before it."""
    return [
        (page, text[: match.start()].count("\n") + 1, match["text"], match["note"] or "")
        for page in PAGES
        for text in [page.read_text(encoding="utf-8")]
        for match in BLOCK.finditer(text)
        if match["kind"] == kind
    ]


def name_of(block):
    return f"{block[0].name}:{block[1]}" if isinstance(block, tuple) else ""


def script(name):
    """A script of benchmarks/, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tables():
    return script("tables")


@pytest.mark.parametrize(("name", "count"), [("README", 1), ("simulators", 13), ("results", 13), ("runtime", 6)])
def test_a_page_holds_the_tables_that_the_benchmarks_wrote(name, count, tables):
    page = next(page for page in tables.PAGES if page.stem == name).read_text(encoding="utf-8")
    assert len(tables.BLOCK.findall(page)) == count
    assert tables.filled(page) == page


def test_the_readme_and_the_results_hold_what_the_shipped_assets_say_of_themselves():
    shipped = script("shipped")
    assets = {name: fracsim.load(name).metadata for name in shipped.NAMES}
    assert shipped.table(assets) in (ROOT / "README.md").read_text(encoding="utf-8")
    results = json.loads((ROOT / "benchmarks" / "results" / "shipped.json").read_text(encoding="utf-8"))
    assert results["assets"] == assets


def test_every_picture_and_file_that_the_pages_point_to_is_there():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_heading_that_the_pages_point_to_is_there():
    def anchors(page):
        headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}

    for page in PAGES:
        for target, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", page.read_text(encoding="utf-8")):
            assert anchor in anchors(page.parent / target if target else page), f"{page.name}: {target}#{anchor}"


# Code


def run(code, folder):
    """Run code as a script, where fracsim is the one of this checkout."""
    script = folder / "block.py"
    script.write_text(code, encoding="utf-8")
    return subprocess.run([sys.executable, str(script)], cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize("block", [block for block in blocks("python") if NOT_RUN not in block[3]], ids=name_of)
def test_the_code_on_a_page_runs_as_it_stands(block, tmp_path):
    result = run(block[2], tmp_path)
    assert result.returncode == 0, result.stderr


def test_most_of_the_code_on_the_pages_is_run_and_the_rest_says_why_not():
    skipped = [block for block in blocks("python") if NOT_RUN in block[3]]
    assert len(blocks("python")) >= 4
    assert len(skipped) <= len(blocks("python")) // 3
    for *_, note in skipped:
        assert re.fullmatch(r"<!-- not run: \w.{8,} -->\n", note)


def test_the_simulator_on_the_page_works_from_the_command_line(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    [code] = [text for _, _, text, _ in blocks("python") if "register_simulator" in text]
    (tmp_path / "halves.py").write_text(code, encoding="utf-8")
    trimesh.creation.box((0.3, 0.2, 0.1)).export(tmp_path / "mug.obj")
    command = "--import halves dataset make mug.obj --simulator halves --samples 100 --cells 200 --workers 2 --quiet"
    result = subprocess.run(
        [sys.executable, "-m", "fracsim.cli", *command.split()], cwd=tmp_path, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert re.search(r"samples +100\n", result.stdout)
    assert re.search(r"most +2\n", result.stdout)


def modules_with_examples():
    for path in sorted([*(ROOT / "fracsim").rglob("*.py"), *(ROOT / "envs").rglob("*.py")]):
        if ">>> " in path.read_text(encoding="utf-8"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            parts = parts if parts[0] == "fracsim" else ("fracsim", *parts)
            yield ".".join(part for part in parts if part != "__init__")


@pytest.mark.parametrize("name", list(modules_with_examples()))
def test_the_examples_in_a_modules_docstrings_give_what_they_say(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0


# Commands


def commands():
    """The command lines of fracsim on the pages, in blocks and in the text, without the names of whole commands."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        lines = [line for match in BLOCK.finditer(text) for line in match["text"].splitlines()]
        lines += re.findall(r"`(fracsim (?!dataset \w+`)[^`]+ [^`]+)`", text)
        for line in lines:
            program, *words = shlex.split(line, comments=True) or [""]
            if program in ("fracsim", ".venv/bin/fracsim") and not any(
                word.isupper() for word in words
            ):  # no placeholder
                yield pytest.param(words, id=f"{page.name}: {' '.join(words)}")


@pytest.mark.parametrize("words", list(commands()))
def test_a_command_on_a_page_is_understood(words):
    _, rest = split_imports(words)
    assert callable(build_parser().parse_args(rest).run)


def test_the_pages_show_every_command():
    shown = {words for parameter in commands() for words in parameter.values[0]}
    assert {"bake", "fracture", "view", "info", "dataset", "train", "tune", "evaluate", "bench"} <= shown
