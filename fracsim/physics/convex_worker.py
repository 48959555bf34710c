"""A process that makes convex parts in the background, and both ends of the pipes to it.

`live_convex` submits tasks; the file is also the program that the process runs.
"""

from __future__ import annotations

import atexit
import os
import struct
import sys
import traceback
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
Task = tuple[Surfaces, IntArray, FloatArray]  # the arguments of decompose_pieces
Answer = list[list[FloatArray]] | None  # what it returns
Arrays = Mapping[str, npt.NDArray[Any]]


def decompose_pieces(surfaces: Surfaces, pairs: IntArray, normals: FloatArray) -> Answer:
    """Decompose pieces by CoACD and cut their convex parts apart.

    Parameters
    ----------
    surfaces : list of tuple of ndarray
        Vertices (n, 3) and faces (m, 3) of each piece, in units of the asset's largest extent.
    pairs : ndarray of int64, shape (I, 2)
        Pieces that meet.
    normals : ndarray of float64, shape (I, 3)
        Mean normal of the border of each pair.

    Returns
    -------
    list of list of ndarray, or None
        Points (n, 3) of each convex part of each piece; None where a small piece is left with nothing between the
        others.

    Raises
    ------
    BakeError
        Where one of the libraries that do it (CoACD, manifold3d, Qhull) gave up; these raise RuntimeError.
    """
    from ..solids.convex import separate

    try:
        return [[points for points, _ in parts] for parts in separate(surfaces, pairs, normals)]
    except BakeError:
        return None
    except RuntimeError as error:
        first_line = str(error).partition("\n")[0]  # Qhull goes on for a page
        raise BakeError(f"its pieces were not decomposed ({first_line})") from error


class ConvexWorker:
    """A process that decomposes pieces, one task after another.

    It is started when first asked, and anew when it has died. It is a process and no thread, which would hold up steps
    while it has the interpreter, and whose crash would be the simulation's; and no pool of multiprocessing, as that
    runs the user's script once more.

    Attributes
    ----------
    process : Popen or None
        The process, once started.
    """

    def __init__(self) -> None:
        self.process: Popen[bytes] | None = None
        self._tasks: SimpleQueue[tuple[Task, Future[Answer]]] = SimpleQueue()
        Thread(target=self._run, name="fracsim-refine", daemon=True).start()
        atexit.register(self._end)

    def submit(self, task: Task) -> Future[Answer]:
        """Begin a decomposition.

        Parameters
        ----------
        task : tuple
            The arguments of `decompose_pieces`.

        Returns
        -------
        Future
            What `decompose_pieces` returns, in time. Its exception is a BakeError where the decomposition failed or
            the process died, and a RuntimeError with the process's traceback where our code is at fault.
        """
        future: Future[Answer] = Future()
        self._tasks.put((task, future))
        return future

    def _run(self) -> None:
        while True:
            task, future = self._tasks.get()
            try:
                future.set_result(self._ask(*task))
            except Exception as error:  # hidden from nobody: the future raises it where it is asked
                future.set_exception(error)

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
            status = process.wait()
            raise BakeError(
                f"its pieces were not decomposed in the background (the worker ended with exit status {status})"
            ) from error
        if "failure" in answer:
            raise BakeError(answer["failure"].tobytes().decode() + " in the background")
        if "bug" in answer:
            raise RuntimeError("the worker that decomposes pieces failed:\n" + answer["bug"].tobytes().decode())
        if not answer:
            return None
        parts: list[list[FloatArray]] = [[] for _ in surfaces]
        for owner, points in zip(answer["owners"], np.split(answer["points"], answer["ends"][:-1]), strict=True):
            parts[owner].append(points)
        return parts

    def _started(self) -> Popen[bytes]:
        if self.process is None or self.process.poll() is not None:
            try:
                self.process = Popen(
                    [sys.executable, "-P", "-m", __name__],
                    stdin=PIPE,
                    stdout=PIPE,
                    env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sys.path))},
                    process_group=0,  # Ctrl-C is for the parent to answer
                )
            except OSError as error:
                raise BakeError(f"the worker that decomposes pieces could not be started ({error})") from error
        return self.process

    def _end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


@cache
def worker(process: int) -> ConvexWorker:
    """Give the worker of a process, as a fork takes neither the thread nor the pipes along.

    Parameters
    ----------
    process : int
        ``os.getpid()``.

    Returns
    -------
    ConvexWorker
        One for each process.
    """
    return ConvexWorker()


# Messages of both ends: safetensors, with their length before them


def _send(stream: IO[bytes], arrays: Arrays) -> None:
    data = save(dict(arrays))
    stream.write(struct.pack("<Q", len(data)) + data)
    stream.flush()


def _receive(stream: IO[bytes]) -> dict[str, npt.NDArray[Any]]:
    """Read one message; EOFError where the other end is gone."""
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
    except BakeError as error:
        return {"failure": _text(str(error))}
    except Exception:  # raised again in the parent, where it belongs
        return {"bug": _text(traceback.format_exc())}
    if parts is None:
        return {}
    points = [part for piece in parts for part in piece]
    return {
        "points": np.concatenate(points),
        "ends": np.cumsum([len(part) for part in points]),
        "owners": np.repeat(np.arange(len(parts)), [len(piece) for piece in parts]),
    }


def _text(message: str) -> npt.NDArray[np.uint8]:
    return np.frombuffer(message.encode(), np.uint8)


if __name__ == "__main__":
    _serve()
