"""The command line: what it knows by name, what it refuses before the work, and how it ends in odd surroundings."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import trimesh

import fracsim
from fracsim.cli.imports import split_imports
from fracsim.cli.main import build_parser, main
from fracsim.learning import MODELS
from fracsim.simulators import SIMULATORS

ROOT = Path(__file__).parents[2]
CHEAP = ("--cells", "200", "--modes", "2", "--samples", "120", "--quiet")
TOY = """
    from fracsim.simulators import register_simulator
    from fracsim.simulators.radial import RadialSimulator

    class Toy(RadialSimulator):
        pass

    register_simulator("toy", Toy)
"""


def program(*arguments, cwd, **keywords):
    """Run the command line in a process of its own, which finds fracsim where this one did."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)} | keywords.pop("env", {})
    command = [sys.executable, "-m", "fracsim.cli", *arguments]
    keywords = {"capture_output": True, "text": True} | keywords
    return subprocess.run(command, cwd=cwd, env=environment, **keywords)


@pytest.fixture
def mesh(tmp_path):
    path = tmp_path / "box.obj"
    trimesh.creation.box((0.3, 0.2, 0.1)).export(path)
    return path


@pytest.fixture
def module(tmp_path):
    """Write a module into the working directory of a program."""

    def write(text, name="mine"):
        (tmp_path / f"{name}.py").write_text(textwrap.dedent(text))

    return write


def only_line(text):
    [line] = text.strip().splitlines()
    return line


# What it knows


def test_version_is_printed(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out.strip() == f"fracsim {fracsim.__version__}"


@pytest.mark.parametrize(
    ("command", "registry"),
    [(("train",), MODELS), (("tune",), MODELS), (("bake",), SIMULATORS), (("dataset", "make"), SIMULATORS)],
)
def test_help_lists_what_is_registered_now(command, registry, monkeypatch, capsys):
    monkeypatch.setitem(registry, "brand_new", "nowhere:Nothing")
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    text = capsys.readouterr().out
    assert all(name in text for name in registry)


def test_every_argument_of_every_command_has_a_help_text():
    parsers = [build_parser()]
    for parser in parsers:
        for action in parser._actions:
            parsers += (action.choices or {}).values() if action.dest in ("command", "action") else []
            if action.dest not in ("command", "action"):
                assert action.help, f"{parser.prog}: {action.dest}"
    assert len(parsers) == 12


def test_the_old_name_of_the_simulator_argument_is_understood_and_mentioned_once(mesh, tmp_path, capsys):
    out = tmp_path / "d.h5"
    make = ["dataset", "make", str(mesh), "--out", str(out), *CHEAP, "--truth", "radial", "--truth", "radial"]
    assert main([*make, "--json", str(tmp_path / "d.json")]) == 0
    assert "--truth is now called --simulator" in only_line(capsys.readouterr().err)
    figures = json.loads((tmp_path / "d.json").read_text())
    assert figures["header"]["simulator"]["name"] == "radial"
    assert {"cells", "interfaces"} <= set(figures["counts"])
    assert main(["dataset", "make", str(mesh), "--out", str(out), *CHEAP, "--simulator", "radial"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("asked", "answered"), [("field", "field"), ("interfaces", "interfaces")])
def test_the_predictor_is_chosen_by_name(asked, answered, tmp_path):
    out = tmp_path / "f.json"
    assert main(["fracture", "vase", "--predictor", asked, "--json", str(out)]) == 0
    assert json.loads(out.read_text())["predictor"] == answered


def test_the_simulator_that_an_asset_was_baked_from_is_a_predictor_under_both_its_names(tmp_path):
    figures = []
    for number, name in enumerate(("simulator", "modes")):
        out = tmp_path / f"{number}.json"
        assert main(["fracture", "vase", "--predictor", name, "--json", str(out)]) == 0
        figures.append(json.loads(out.read_text()))
    assert figures[0]["pieces"] == figures[1]["pieces"]


def test_an_unknown_predictor_is_refused_by_name(capsys):
    assert main(["fracture", "vase", "--predictor", "oracle"]) == 2
    assert "oracle" in only_line(capsys.readouterr().err)


# --import


def test_an_imported_module_makes_a_simulator_known_to_the_command_and_to_its_workers(mesh, module, tmp_path):
    module(TOY)
    make = ("dataset", "make", mesh.name, *CHEAP, "--simulator", "toy", "--workers", "2", "--json", "d.json")
    result = program("--import", "mine", *make, "--out", "toy.h5", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    figures = json.loads((tmp_path / "d.json").read_text())
    assert figures["header"]["simulator"]["name"] == "toy"
    assert figures["counts"]["samples"] == 120


def test_an_imported_module_is_named_in_the_help_texts(module, tmp_path):
    module(TOY)
    result = program("dataset", "make", "--import", "mine", "--help", cwd=tmp_path)
    assert result.returncode == 0
    assert "toy" in result.stdout
    assert "unknown simulator 'toy'" in program("bake", "box.obj", "--simulator", "toy", cwd=tmp_path).stderr


def test_an_imported_module_makes_a_model_known_to_training(torus_dataset, module, tmp_path):
    module(
        """
        import fracsim
        from fracsim.learning.nearest import Nearest

        class Closest(Nearest):
            kind = "closest"

        fracsim.register_model("closest", Closest)
        """
    )
    train = ("train", str(torus_dataset), "--model", "closest", "--set", "severity=1.0", "--out", "m.safetensors")
    result = program("--import", "mine", *train, "--quiet", "--json", "m.json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    figures = json.loads((tmp_path / "m.json").read_text())
    assert figures["model"] == "closest"
    assert figures["options"]["severity"] == 1.0
    assert (tmp_path / "m.safetensors").exists()
    assert "unknown model 'closest'" in only_line(program(*train, cwd=tmp_path).stderr)


def test_imports_are_found_wherever_they_stand():
    assert split_imports(["--import", "a", "info", "--import=b", "bunny"]) == (["a", "b"], ["info", "bunny"])


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("nowhere", "", "there is no module nowhere, neither installed nor in "),
        ("mine.py", "", "not the name of a module; give it as in an import statement, such as mine"),
        ("mine", "import nowhere_else", "ModuleNotFoundError: No module named 'nowhere_else'"),
        ("mine", "x = 1\nx / 0", "ZeroDivisionError: division by zero"),
        ("mine", TOY.replace('"toy"', '"radial"'), "taken"),
    ],
)
def test_a_module_that_cannot_be_imported_is_refused_in_one_line(name, text, fault, module, tmp_path):
    module(text)
    result = program("--import", name, "info", "bunny", cwd=tmp_path)
    assert result.returncode == 2
    assert fault in only_line(result.stderr)
    assert f"--import {name}: " in result.stderr
    assert result.stdout == ""


def test_the_line_of_a_module_that_raised_is_named(module, tmp_path):
    module("x = 1\n\nx / 0\n")
    result = program("--import", "mine", "info", "bunny", cwd=tmp_path)
    assert f"({tmp_path / 'mine.py'}, line 3)" in only_line(result.stderr)


# What cannot be written is said before the work


@pytest.mark.parametrize(
    "command",
    [
        ("bake", "box.obj"),
        ("dataset", "make", "box.obj"),
        ("dataset", "info", "d.h5"),
        ("fracture", "bunny"),
        ("view", "bunny"),
        ("train", "d.h5"),
        ("tune", "d.h5"),
        ("evaluate", "plan.toml"),
        ("bench", "idle"),
    ],
)
def test_output_that_cannot_be_written_is_refused_before_the_work(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    for out in ("nowhere/out", "file/out", "/proc/out"):
        for argument in ("--out", "--json"):
            assert main([*command, argument, out]) == 2
            line = only_line(capsys.readouterr().err)
            assert out in line
            assert "does not exist" in line or "cannot be written" in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    "command", [("fracture", "bunny"), ("tune", "d.h5"), ("evaluate", "p.toml"), ("bench", "idle")]
)
def test_a_file_in_the_place_of_the_output_folder_is_refused(command, tmp_path, capsys):
    (tmp_path / "file").write_text("kept")
    assert main([*command, "--out", str(tmp_path / "file")]) == 2
    assert "file: is a file; name a folder" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "kept"


def test_a_seed_that_is_none_is_refused_by_every_command(capsys):
    for command in (
        ["bake", "m"],
        ["fracture", "m"],
        ["train", "m"],
        ["tune", "m"],
        ["dataset", "make"],
        ["bench", "x"],
    ):
        for seed in ("-1", "1e3"):
            assert main([*command, f"--seed={seed}"]) == 2
            assert f"--seed must be a whole number of at least 0, got {seed}" in only_line(capsys.readouterr().err)


# Odd surroundings


def test_a_terminal_that_shows_ascii_only_is_no_fault(tmp_path):
    result = program("fracture", "bunny", cwd=tmp_path, env={"PYTHONIOENCODING": "ascii"})
    assert result.returncode == 0, result.stderr
    assert "N?s" in result.stdout


def test_without_home_and_with_no_cache_to_write_a_picture_is_drawn(tmp_path):
    surroundings = {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/proc", "MPLCONFIGDIR": "/proc/none"}
    result = program("view", "chair", "--count", "1", "--out", "v.png", cwd=tmp_path, env=surroundings)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "v.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_output_that_fails_half_way_is_said_in_one_line(tmp_path):
    with open("/dev/full", "w") as full:
        result = program("info", "bunny", cwd=tmp_path, capture_output=False, stdout=full, stderr=subprocess.PIPE)
    assert result.returncode == 2
    assert only_line(result.stderr) == "fracsim: the output cannot be written (No space left on device)"


def test_a_reader_that_leaves_early_is_no_traceback(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    result = program("info", "bunny", cwd=tmp_path, capture_output=False, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert result.returncode == 2
    assert only_line(result.stderr) == "fracsim: the output cannot be written (Broken pipe)"
