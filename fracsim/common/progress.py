"""Long work, stage by stage: a progress bar and a clock for each. Offline only."""

from __future__ import annotations

import time
from collections.abc import Callable

from .errors import MissingExtraError

try:
    from tqdm import tqdm
except ImportError as error:
    raise MissingExtraError("tqdm", "bake") from error


class Stages:
    """Call it with a stage's name and the share done; a new name ends the stage before. A context manager.

    seconds: how long each finished stage took, in order. visible: whether bars appear, on standard error.
    """

    def __init__(self, visible: bool) -> None:
        self.visible = visible
        self.seconds: dict[str, float] = {}
        self._name = ""

    def __call__(self, name: str, share: float = 0.0) -> None:
        if name != self._name:
            self._end(whole=True)
            self._name, self._begin = name, time.perf_counter()
            self._bar = tqdm(
                total=100,
                desc=f"{name:<10}",
                disable=not self.visible,
                bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}",
            )
        self._bar.update(round(100 * share) - self._bar.n)

    def ticker(self, name: str) -> Callable[[float], None]:
        """Begin a stage; the result is called with the share done."""
        self(name)
        return lambda share: self(name, share)

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._end(whole=kind is None)

    def _end(self, whole: bool) -> None:
        if not self._name:
            return
        if whole:
            self._bar.update(100 - self._bar.n)
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + time.perf_counter() - self._begin
        self._bar.close()
        self._name = ""
