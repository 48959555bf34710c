"""Convex parts made when something breaks rather than when it was baked: at once, or in the background.

Slower than any frame, finer where a piece is one that no bake has seen. Needs the extra ``bake``, when asked for.
"""

from __future__ import annotations

import atexit
import os
import struct
import sys
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from queue import SimpleQueue
from subprocess import PIPE, Popen
from threading import Thread
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load, save

from ..errors import BakeError, FracsimError, MissingExtraError
from ..pieces import Parts, Piece

if TYPE_CHECKING:
    from .bodies import Body

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Surfaces = list[tuple[FloatArray, IntArray]]
Task = tuple[Surfaces, IntArray, FloatArray]  # see ``task``
Answer = list[list[FloatArray]] | None  # see ``decomposed``
Arrays = Mapping[str, npt.NDArray[Any]]

WAYS = ("baked", "coacd", "background")


def require() -> None:
    """Raise MissingExtraError unless pieces can be decomposed here."""
    from importlib.util import find_spec

    for module in ("coacd", "manifold3d"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "bake")


def task(asset: Any, pieces: Sequence[Piece]) -> Task:
    """Surfaces in units of the asset's largest extent, and the pairs (I, 2) of pieces with their borders' normals."""
    surfaces = [((piece.vertices - asset.offset) / asset.scale, piece.faces) for piece in pieces]
    arrays = asset.arrays
    owner = np.full(arrays.complex.count, -1)
    for k, piece in enumerate(pieces):
        owner[piece.atoms] = k
    ends = owner[arrays.pairs]
    apart = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
    ends, normals = ends[apart], arrays.normals[apart] * arrays.projected[apart][:, None]
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], normals[swap] = ends[swap][:, ::-1], -normals[swap]
    pairs, place = np.unique(ends, axis=0, return_inverse=True)
    total = np.zeros((len(pairs), 3))
    np.add.at(total, place.reshape(-1), normals)
    total /= np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None]
    return surfaces, pairs, total


def decomposed(surfaces: Surfaces, pairs: IntArray, normals: FloatArray) -> Answer:
    """The points of each surface's convex parts; None when a small one is left with nothing between the others."""
    from ..convex import separate

    try:
        return [[points for points, _ in some] for some in separate(surfaces, pairs, normals)]
    except BakeError:
        return None


def with_parts(
    asset: Any,
    pieces: Sequence[Piece],
    points: Sequence[Sequence[FloatArray]] | None,
    fault: str = "a piece is too small to decompose",
) -> tuple[Piece, ...]:
    """The pieces with other convex parts. Without any, they all keep those that they were baked with, and a warning
    says so and why: the two kinds are not apart from one another."""
    if points is None:
        warnings.warn(f"{asset.name}: {fault}; baked parts are kept", RuntimeWarning, 2)
        return tuple(pieces)
    return tuple(
        replace(piece, parts=Parts.of(some, asset.scale, asset.offset))
        for piece, some in zip(pieces, points, strict=True)
    )


def refined_now(asset: Any, pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    """The pieces with parts made at once; as they were if that goes wrong."""
    try:
        return with_parts(asset, pieces, decomposed(*task(asset, pieces)))
    except Exception as error:  # of another library's
        return with_parts(asset, pieces, None, f"its pieces were not decomposed ({error})")


@dataclass(eq=False)
class Refinement:
    """Pieces whose convex parts are being made in another process.

    due: s, of the world's time, at which they take their place, ready or waited for, so that runs are the same.
    """

    asset: Any
    pieces: tuple[Piece, ...]
    bodies: list[Body]
    due: float
    future: Future[Answer]

    @classmethod
    def begun(cls, asset: Any, pieces: tuple[Piece, ...], bodies: list[Body], due: float) -> Refinement:
        return cls(asset, pieces, bodies, due, _worker(os.getpid()).submit(task(asset, pieces)))

    def refined(self) -> tuple[Piece, ...]:
        """The pieces with their new parts, once these are there; as they were if that went wrong."""
        try:
            return with_parts(self.asset, self.pieces, self.future.result())
        except FracsimError as error:
            return with_parts(self.asset, self.pieces, None, str(error))


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
def _worker(process: int) -> _Worker:
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
        parts = decomposed(surfaces, message["pairs"], message["normals"])
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
