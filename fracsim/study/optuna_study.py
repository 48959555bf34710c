"""Studies of optuna that several processes work on at once, any of which may be killed and started again.

``tune`` and ``summary`` use it. It is the only module that reads or writes a study's storage.
"""

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
    from optuna.trial import FrozenTrial, Trial, TrialState
    from sqlalchemy.exc import SQLAlchemyError
except ImportError as error:
    raise MissingExtraError(str(error.name), "tune") from error

RETRIES = 1  # of a trial whose process was killed; more would repeat a trial that itself kills processes
PATIENCE = 10  # s, after which a lock on the journal is taken for a dead process's; writing takes far less
START_TIME = 19  # of the fields in /proc/PID/stat after the process's state: when it began


class SeededSampler(BaseSampler):
    """NSGA-II (Deb et al. 2002) that draws each trial from a seed of that trial.

    So no two processes, and no two runs of one process, try the same values.

    Parameters
    ----------
    seed : int
        The seed of the study.
    population : int
        Trials in a generation.
    """

    def __init__(self, seed: int, population: int) -> None:
        self._seed, self._population = seed, population

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Seed the sampler for a trial; called by optuna.

        Parameters
        ----------
        study : optuna.Study
            The study.
        trial : optuna.trial.FrozenTrial
            The trial that begins.
        """
        seed = int(np.random.SeedSequence([self._seed, trial.number]).generate_state(1)[0])
        self._sampler = NSGAIISampler(population_size=self._population, seed=seed)
        self._sampler.before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, Any]:
        """Find the parameters that are drawn together; called by optuna.

        Parameters
        ----------
        study : optuna.Study
            The study.
        trial : optuna.trial.FrozenTrial
            The trial.

        Returns
        -------
        dict
            Distributions by the names of the parameters.
        """
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(self, study: optuna.Study, trial: FrozenTrial, search_space: Any) -> dict[str, Any]:
        """Draw parameters together; called by optuna.

        Parameters
        ----------
        study : optuna.Study
            The study.
        trial : optuna.trial.FrozenTrial
            The trial.
        search_space : dict
            What ``infer_relative_search_space`` returned.

        Returns
        -------
        dict
            Values by the names of the parameters.
        """
        return self._sampler.sample_relative(study, trial, search_space)

    def sample_independent(self, study: optuna.Study, trial: FrozenTrial, param_name: str, distribution: Any) -> Any:
        """Draw one parameter; called by optuna.

        Parameters
        ----------
        study : optuna.Study
            The study.
        trial : optuna.trial.FrozenTrial
            The trial.
        param_name : str
            The parameter.
        distribution : optuna.distributions.BaseDistribution
            Where it is drawn from.

        Returns
        -------
        object
            The value.
        """
        return self._sampler.sample_independent(study, trial, param_name, distribution)


def open_study(storage: str, name: str, search: Search) -> optuna.Study:
    """Open a study, and create it if it is not there.

    Parameters
    ----------
    storage : str
        The path of a journal file, or the URL of a database.
    name : str
        The name of the study in its storage.
    search : Search
        What is searched.

    Returns
    -------
    optuna.Study
        The study, which minimises AMAE and seconds.

    Raises
    ------
    ModelError
        If the storage cannot be opened, or holds a study of that name about something else.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(
            storage=_storage(storage), study_name=name, directions=["minimize", "minimize"], load_if_exists=True
        )
        before = study.user_attrs.get("search")
    except (ValueError, KeyError, TypeError) as error:  # lines of the journal are not optuna's
        raise ModelError(f"{storage}: not a journal of a study ({error}); name another with --storage") from error
    if before is None:
        study.set_user_attr("search", search.identity())
    elif before != search.identity():
        now = search.identity()
        differ = ", ".join(f"{key} was {before.get(key)}" for key in now if before.get(key) != now[key])
        raise ModelError(f"study {name!r} is about something else ({differ}); give another --study or --out")
    return study


def segmentation_of(study: optuna.Study) -> str:
    """Read which segmentation the fields of a study's trials are measured with.

    Parameters
    ----------
    study : optuna.Study
        The study.

    Returns
    -------
    str
        A name in ``segmentation.METHODS``; the watershed if the study does not say.
    """
    return str(study.user_attrs.get("segmentation", "watershed"))


def set_segmentation(study: optuna.Study, name: str) -> None:
    """Fix which segmentation the fields of a study's trials are measured with, before its first trial.

    Parameters
    ----------
    study : optuna.Study
        The study.
    name : str
        A name in ``segmentation.METHODS``.

    Raises
    ------
    ModelError
        If the study has trials with another segmentation.
    """
    if segmentation_of(study) == name:
        return
    if study.get_trials(deepcopy=False):
        raise ModelError(
            f"study {study.study_name!r} has trials with segmentation {segmentation_of(study)!r}, not {name!r}; "
            "give another --study or --out"
        )
    study.set_user_attr("segmentation", name)


def begin_trial(study: optuna.Study) -> Trial:
    """Begin a trial in the name of this process.

    Parameters
    ----------
    study : optuna.Study
        The study.

    Returns
    -------
    optuna.trial.Trial
        The trial.
    """
    trial = study.ask()
    trial.set_user_attr("process", process_name("self"))
    return trial


def finish_trial(study: optuna.Study, trial: Trial, figures: dict[str, Any]) -> None:
    """Finish a trial that succeeded.

    Parameters
    ----------
    study : optuna.Study
        The study.
    trial : optuna.trial.Trial
        The trial.
    figures : dict
        What ``tune.measure`` returned.
    """
    trial.set_user_attr("found", figures)
    study.tell(trial, [figures["amae"], figures["seconds"]])


def fail_trial(study: optuna.Study, trial: Trial, error: BaseException) -> None:
    """Finish a trial that failed; it counts, and is not tried again.

    Parameters
    ----------
    study : optuna.Study
        The study.
    trial : optuna.trial.Trial
        The trial.
    error : BaseException
        Why it failed.
    """
    trial.set_user_attr("fault", f"{type(error).__name__}: {error}")
    study.tell(trial, state=TrialState.FAIL)


def repeat_trial(study: optuna.Study, trial: Trial) -> None:
    """Give up a trial that was interrupted, and queue its values again; it does not count.

    Parameters
    ----------
    study : optuna.Study
        The study.
    trial : optuna.trial.Trial
        The trial.
    """
    if study.tell(trial, state=TrialState.FAIL, skip_if_finished=True).state == TrialState.FAIL:
        study.enqueue_trial(trial.params, {"lost": trial.user_attrs.get("lost", 0)})


def count_trials(study: optuna.Study) -> int:
    """Count the trials that were asked for: those that ended by themselves, and those running on this machine.

    Parameters
    ----------
    study : optuna.Study
        The study.

    Returns
    -------
    int
        Their number.
    """
    return sum(map(_counts, study.get_trials(deepcopy=False)))


def give_up_lost_trials(study: optuna.Study) -> None:
    """Give up the trials of dead processes of this machine, and queue their values again.

    A trial that was lost more than ``RETRIES`` times is not queued again.

    Parameters
    ----------
    study : optuna.Study
        The study.
    """
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if _is_alive(trial.user_attrs.get("process", "")) is False:
            try:
                study.tell(trial.number, state=TrialState.FAIL)
            except (ValueError, optuna.exceptions.UpdateFinishedTrialError):
                continue  # another process gave it up first
            lost = trial.user_attrs.get("lost", 0)
            if trial.params and lost < RETRIES:
                study.enqueue_trial(trial.params, {"lost": lost + 1})


def process_name(pid: str) -> str:
    """Name a process of this machine.

    Parameters
    ----------
    pid : str
        Its number, or ``"self"``.

    Returns
    -------
    str
        Machine, number and start time, which no later process has; ``""`` if there is no such process.
    """
    try:
        number, rest = Path(f"/proc/{pid}/stat").read_text().split(" ", 1)
    except FileNotFoundError:
        return ""
    state, *fields = rest.rpartition(") ")[2].split()
    dead = state in "ZX"  # a zombie, or dead
    return "" if dead else f"{platform.node()}:{number}:{fields[START_TIME - 1]}"


def _is_alive(process: str) -> bool | None:
    """Tell whether a process lives; None if it is on another machine, or unknown."""
    node, _, rest = process.partition(":")
    return None if node != platform.node() or not rest else process_name(rest.split(":")[0]) == process


def _counts(trial: FrozenTrial) -> bool:
    """Tell whether a trial counts: it ended by itself, or is running on this machine."""
    if trial.state == TrialState.FAIL:
        return "fault" in trial.user_attrs
    if trial.state == TrialState.RUNNING:
        return _is_alive(trial.user_attrs.get("process", "")) is True
    return trial.state == TrialState.COMPLETE


def _storage(storage: str) -> BaseStorage:
    """Open a journal file or a database."""
    if "://" in storage:
        try:
            return RDBStorage(storage)
        except (SQLAlchemyError, ImportError, RuntimeError, ValueError) as error:
            # Its message may hold the password of the database, so only the kind of the error is told.
            raise ModelError(f"the database of the study cannot be opened ({type(error).__name__})") from error
    path = Path(storage).absolute()
    if not path.parent.is_dir() or path.is_dir():
        raise ModelError(f"{storage}: not a file in an existing folder; create the folder first")
    lock = JournalFileOpenLock(str(path), grace_period=PATIENCE)
    if path.is_file():
        _mend_journal(path, lock)
    return JournalStorage(JournalFileBackend(str(path), lock))


def _mend_journal(path: Path, lock: JournalFileOpenLock) -> None:
    """Cut off an unfinished last line, which a machine that lost power leaves.

    The next line would be joined to it, and the journal could no longer be read.
    """
    lock.acquire()
    try:
        with path.open("r+b") as file:
            data = file.read()
            if data and not data.startswith(b"{"):
                raise ModelError(f"{path}: not a journal of a study; name another with --storage")
            file.truncate(data.rfind(b"\n") + 1)
    finally:
        lock.release()
