"""TODO study.optuna_study."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import MissingExtraError, ModelError
from .search_space import Search

try:
    import optuna
    from optuna.samplers import BaseSampler, NSGAIISampler
    from optuna.storages import BaseStorage, JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
    from optuna.trial import FrozenTrial, TrialState
except ImportError as error:
    raise MissingExtraError(str(error.name), "tune") from error

RETRIES = 1  # of a trial whose process was killed; it may be the trial that kills them
PATIENCE = 10  # seconds after which a lock on the journal is taken to be a dead process's


# Studies


class _ByTrial(BaseSampler):
    """NSGA-II that draws each trial from a seed of the trial's own, so that no two processes, and no two sittings of
    one, try the same."""

    def __init__(self, seed: int, population: int) -> None:
        self.seed, self.population = seed, population

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        seed = int(np.random.SeedSequence([self.seed, trial.number]).generate_state(1)[0])
        self.own = NSGAIISampler(population_size=self.population, seed=seed)
        self.own.before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, Any]:
        return self.own.infer_relative_search_space(study, trial)

    def sample_relative(self, study: optuna.Study, trial: FrozenTrial, search_space: Any) -> dict[str, Any]:
        return self.own.sample_relative(study, trial, search_space)

    def sample_independent(self, study: optuna.Study, trial: FrozenTrial, param_name: str, distribution: Any) -> Any:
        return self.own.sample_independent(study, trial, param_name, distribution)


def open_study(storage: str, name: str, search: Search) -> optuna.Study:
    """A study, new or begun. storage: a journal file, or the URL of a database.

    Raises ModelError where there is a study of that name about something else.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(
            storage=_storage(storage), study_name=name, directions=["minimize", "minimize"], load_if_exists=True
        )
        before = study.user_attrs.get("search")
    except (ValueError, KeyError, TypeError) as error:  # a journal's lines are not what they should be
        raise ModelError(f"{storage}: not a journal of a study ({error}); name another with --storage") from error
    if before is None:
        study.set_user_attr("search", search.identity())
    elif before != search.identity():
        now = search.identity()
        differ = ", ".join(f"{key} was {before.get(key)}" for key in now if before.get(key) != now[key])
        raise ModelError(f"study {name!r} is about something else ({differ}); give another --study or --out")
    return study


def _storage(storage: str) -> BaseStorage:
    if "://" in storage:
        try:
            return RDBStorage(storage)
        except Exception as error:  # of SQLAlchemy's and any driver's own kind; with a password in it, maybe
            raise ModelError(f"the database of the study cannot be opened ({type(error).__name__})") from error
    path = Path(storage).absolute()
    if not path.parent.is_dir() or path.is_dir():
        raise ModelError(f"{storage}: not a file in a folder that is there; create the folder first")
    lock = JournalFileOpenLock(str(path), grace_period=PATIENCE)
    if path.is_file():
        _mend(path, lock)
    return JournalStorage(JournalFileBackend(str(path), lock))


def _mend(path: Path, lock: JournalFileOpenLock) -> None:
    """Take the end off a journal that a machine's death left in the middle of a line, for the next line would be
    joined to it, and none could be read."""
    lock.acquire()
    try:
        with path.open("r+b") as file:
            data = file.read()
            if data and not data.startswith(b"{"):
                raise ModelError(f"{path}: not a journal of a study; name another with --storage")
            file.truncate(data.rfind(b"\n") + 1)
    finally:
        lock.release()


def _counts(trial: FrozenTrial) -> bool:
    """Whether a trial is one of those asked for: it ended of itself, or is under way here."""
    if trial.state == TrialState.FAIL:
        return "fault" in trial.user_attrs
    if trial.state == TrialState.RUNNING:
        return _alive(trial.user_attrs.get("process", "")) is True
    return trial.state == TrialState.COMPLETE


def _bury(study: optuna.Study) -> None:
    """Give up the trials of this machine's dead processes, and ask for them again."""
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if _alive(trial.user_attrs.get("process", "")) is False:
            try:
                study.tell(trial.number, state=TrialState.FAIL)
            except (ValueError, optuna.exceptions.UpdateFinishedTrialError):
                continue  # another process was first
            lost = trial.user_attrs.get("lost", 0)
            if trial.params and lost < RETRIES:
                study.enqueue_trial(trial.params, {"lost": lost + 1})


def _process(pid: str) -> str:
    """A name of a process of this machine that no later one will have; "" where there is none."""
    try:
        number, rest = Path(f"/proc/{pid}/stat").read_text().split(" ", 1)
    except FileNotFoundError:
        return ""
    state, *told = rest.rpartition(") ")[2].split()
    return "" if state in "ZX" else f"{platform.node()}:{number}:{told[18]}"  # the 22nd field: when it began


def _alive(process: str) -> bool | None:
    """None where it is on another machine, or unknown."""
    node, _, rest = process.partition(":")
    return None if node != platform.node() or not rest else _process(rest.split(":")[0]) == process
