"""Plays cells in a process of its own: a crash or a hang of the engine is then a finding like any other.

``run`` uses it.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from .cells import Cell, Row

Play = Callable[[Cell, Callable[[str], object]], Row]
Judge = Callable[[dict[str, Any], dict[str, Any]], tuple[list[str], list[str]]]

PATIENCE = 60.0  # s, after which a cell counts as hung; the table says how long the slowest takes


class Player:
    """A process that plays cells, so that a crash of the engine fails one cell and does not end the run.

    Parameters
    ----------
    play : callable
        Plays a cell, and reports by its second argument what it begins: "twin", then "breaking". It must be a
        function of a module, since the process imports it.
    judge : callable
        Compares the figures of a scene with its twin's; returns the checks that only the scene violates, and those
        that both violate.
    """

    def __init__(self, play: Play, judge: Judge) -> None:
        self._play, self._judge = play, judge
        handle, self._trace = tempfile.mkstemp(prefix="fracsim-stability-", suffix=".txt")
        os.close(handle)
        self._start()

    def _start(self) -> None:
        context = get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._trace, self._play), daemon=True)
        self._process.start()
        theirs.close()

    def play(self, cell: Cell) -> Row:
        """Play a cell.

        Parameters
        ----------
        cell : Cell
            The cell.

        Returns
        -------
        dict
            Its row. If the process dies or does not answer, the row says so, and a new process is started.
        """
        start, phase = time.perf_counter(), "twin"
        try:
            self._ours.send(cell)
            while self._ours.poll(PATIENCE):
                answer = self._ours.recv()
                if not isinstance(answer, str):
                    row: Row = answer
                    return row
                phase = answer
            kind, what = "hang", f"no answer within {PATIENCE:g} s"
        except (EOFError, OSError):
            self._process.join(5.0)
            code = self._process.exitcode or 0
            kind, what = "crash", f"{signal.Signals(-code).name if code < 0 else f'exit {code}'}{self._place()}"
        self.stop()
        self._start()
        nothing: dict[str, Any] = {"residuals": {}, "broken": {kind: what}, "notes": [], "events": 0, "pieces": 0}
        whole = {**nothing, "broken": {} if phase == "breaking" else {kind: what}}
        failures, engine = self._judge(nothing, whole)
        return {
            "cell": asdict(cell),
            "live": nothing,
            "twin": whole,
            "broke": False,
            "failures": failures,
            "engine": engine,
            "seconds": time.perf_counter() - start,
        }

    def _place(self) -> str:
        """Read where Python was when it crashed."""
        lines = Path(self._trace).read_text().splitlines()
        Path(self._trace).write_text("")
        return "".join(f", {line.strip()}" for line in lines if line.startswith("  File"))[:500]

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._ours.close()

    def close(self) -> None:
        """End the process and remove its file."""
        self.stop()
        os.unlink(self._trace)


def _serve(connection: Connection, trace: str, play: Play) -> None:
    """Answer each cell with its row; runs in the process."""
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)  # the engine prints what it thinks
    with open(trace, "a") as file:
        faulthandler.enable(file)
        while True:
            try:
                cell = connection.recv()
            except EOFError:
                return
            connection.send(play(cell, connection.send))
