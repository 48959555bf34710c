"""TODO physics.convex_worker."""

from __future__ import annotations

import atexit
import os
import struct
import sys
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import suppress
from functools import cache
from queue import SimpleQueue
from subprocess import PIPE, Popen
from threading import Thread
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load, save

from ..common.arrays import FloatArray, IntArray
from ..common.errors import BakeError

Surfaces = list[tuple[FloatArray, IntArray]]
Task = tuple[Surfaces, IntArray, FloatArray]  # see ``task``
Answer = list[list[FloatArray]] | None  # see ``decomposed``
Arrays = Mapping[str, npt.NDArray[Any]]


def decompose_pieces(surfaces: Surfaces, pairs: IntArray, normals: FloatArray) -> Answer:
    """The points of each surface's convex parts; None when a small one is left with nothing between the others."""
    from ..solids.convex import separate

    try:
        return [[points for points, _ in some] for some in separate(surfaces, pairs, normals)]
    except BakeError:
        return None


class _Worker:
    """A process that decomposes, one task after another, started when first asked and anew when it has died.

    A process and no thread, which would hold up steps while it has the interpreter, and whose crash would be the
    simulation's; no pool of multiprocessing, as that runs the user's script once more.
    """

    def __init__(self) -> None:
        self._tasks: SimpleQueue[tuple[Task, Future[Answer]]] = SimpleQueue()
        self._process: Popen[bytes] | None = None
        Thread(target=self._run, name="fracsim-refine", daemon=True).start()
        atexit.register(self._end)

    def submit(self, task: Task) -> Future[Answer]:
        """The task ``decomposed``, in time; whatever goes wrong is a BakeError."""
        future: Future[Answer] = Future()
        self._tasks.put((task, future))
        return future

    def _run(self) -> None:
        while True:
            task, future = self._tasks.get()
            try:
                future.set_result(self._ask(*task))
            except Exception as error:
                future.set_exception(BakeError(f"its pieces were not decomposed in the background ({error})"))

    def _ask(self, surfaces: Surfaces, pairs: IntArray, normals: FloatArray) -> Answer:
        process = self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        message = {"pairs": pairs, "normals": normals}
        for k, (vertices, faces) in enumerate(surfaces):
            message |= {f"vertices {k}": vertices, f"faces {k}": faces}
        try:
            _send(process.stdin, message)
            answer = _receive(process.stdout)
        except (OSError, EOFError) as error:
            process.kill()
            raise RuntimeError(f"the worker ended with exit status {process.wait()}") from error
        if "fault" in answer:
            raise RuntimeError(answer["fault"].tobytes().decode())
        if not answer:
            return None
        parts: list[list[FloatArray]] = [[] for _ in surfaces]
        for owner, points in zip(answer["owners"], np.split(answer["points"], answer["ends"][:-1]), strict=True):
            parts[owner].append(points)
        return parts

    def _started(self) -> Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            self._process = Popen(
                [sys.executable, "-P", "-m", __name__],
                stdin=PIPE,
                stdout=PIPE,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sys.path))},
                process_group=0,  # Ctrl-C is for the parent to answer
            )
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@cache
def worker(process: int) -> _Worker:
    """One a process, as a fork takes neither the thread nor the pipes along."""
    return _Worker()


# What both ends of the pipes speak: safetensors, with its length before it


def _send(stream: IO[bytes], arrays: Arrays) -> None:
    data = save(dict(arrays))
    stream.write(struct.pack("<Q", len(data)) + data)
    stream.flush()


def _receive(stream: IO[bytes]) -> dict[str, npt.NDArray[Any]]:
    """Raises EOFError where the other end is gone."""
    head = stream.read(8)
    if len(head) < 8:
        raise EOFError
    [size] = struct.unpack("<Q", head)
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    return load(data)


# The worker's end


def _serve() -> None:
    """Answer until the tasks end, as they do when the parent is gone, however it went."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries may print
    tasks: SimpleQueue[dict[str, npt.NDArray[Any]]] = SimpleQueue()
    Thread(target=_listen, args=(tasks,), daemon=True).start()
    while True:
        answer = _answer(tasks.get())
        with suppress(BrokenPipeError):
            _send(answers, answer)


def _listen(tasks: SimpleQueue[dict[str, npt.NDArray[Any]]]) -> None:
    try:
        while True:
            tasks.put(_receive(sys.stdin.buffer))
    finally:
        os._exit(0)  # in the middle of a decomposition, which takes seconds


def _answer(message: Arrays) -> Arrays:
    try:
        surfaces = [(message[f"vertices {k}"], message[f"faces {k}"]) for k in range((len(message) - 2) // 2)]
        parts = decompose_pieces(surfaces, message["pairs"], message["normals"])
    except Exception as error:
        return {"fault": np.frombuffer(f"{type(error).__name__}: {error}".encode(), np.uint8)}
    if parts is None:
        return {}
    points = [some for one in parts for some in one]
    return {
        "points": np.concatenate(points),
        "ends": np.cumsum([len(some) for some in points]),
        "owners": np.repeat(np.arange(len(parts)), [len(one) for one in parts]),
    }


if __name__ == "__main__":
    _serve()
