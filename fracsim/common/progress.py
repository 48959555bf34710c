"""Long work, stage by stage: a progress bar and a clock for each. Only offline rooms use it."""

from __future__ import annotations

import time
from collections.abc import Callable

from .errors import MissingExtraError

try:
    from tqdm import tqdm
except ImportError as error:
    raise MissingExtraError("tqdm", "bake") from error


class Stages:
    """The stages of a long piece of work: a bar on standard error for each, and how long it took.

    A context manager. Call it with a stage's name and the share of it that is done; a new name ends the stage before.

    Parameters
    ----------
    visible : bool
        Whether bars appear.

    Attributes
    ----------
    visible : bool
        Whether bars appear.
    seconds : dict of str to float
        s, how long each finished stage took, in order.
    """

    def __init__(self, visible: bool) -> None:
        self.visible = visible
        self.seconds: dict[str, float] = {}
        self._name = ""

    def __call__(self, name: str, share: float = 0.0) -> None:
        """Move the bar of a stage.

        Parameters
        ----------
        name : str
            The stage; another one than before begins.
        share : float
            How much of it is done, from 0 to 1.
        """
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
        """Begin a stage that reports its own progress.

        Parameters
        ----------
        name : str
            The stage.

        Returns
        -------
        callable
            To be called with the share done, from 0 to 1.
        """
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
