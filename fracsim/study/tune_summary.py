"""The results of a study of hyperparameters as plain data: trials, Pareto front, choice and importances. Offline only.

``write_figures`` draws them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from ..common.errors import MissingExtraError
from ..learning import model_class
from .optuna_study import segmentation_of
from .search_space import Search

try:
    import optuna
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances
    from optuna.trial import FrozenTrial, TrialState
except ImportError as error:
    raise MissingExtraError(str(error.name), "tune") from error

MIN_TRIALS = 10  # finished trials from which importances are computed; with fewer they mean nothing
MEASURES = {  # figures of a trial -> their names in charts
    "amae": "AMAE",
    "seconds": "time of a query",
    "mse": "MSE",
    "bc": "boundary Chamfer",
    "rc": "region Chamfer",
    "ari": "ARI",
    "ami": "AMI",
}


def summary(study: optuna.Study, search: Search) -> dict[str, Any]:
    """Collect the results of a study.

    Parameters
    ----------
    study : optuna.Study
        The study.
    search : Search
        What was searched.

    Returns
    -------
    dict
        Plain data, as in trials.json: ``counts`` of the trials by how they ended, the ``chosen`` trial's number (None
        if none finished) and the ``rule`` of that choice, ``importances``, and all ``trials``, of which ``front`` tells
        whether they are on the Pareto front.
    """
    trials = study.get_trials(deepcopy=False)
    finished = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    failed = [trial for trial in trials if trial.state == TrialState.FAIL]
    front = {trial.number: trial for trial in study.best_trials}
    cost = model_class(search.kind).cost
    chosen = min(front, key=lambda number: (cost(*front[number].values), number), default=None)
    return {
        "study": study.study_name,
        "search": search.identity(),
        "counts": {
            "finished": len(finished),
            "failed": sum("fault" in trial.user_attrs for trial in failed),
            "interrupted": sum("fault" not in trial.user_attrs for trial in failed),
            "under way": sum(trial.state == TrialState.RUNNING for trial in trials),
        },
        "segmentation": segmentation_of(study),
        "rule": cost.rule,
        "chosen": chosen,
        "importances": importances(study, search.seed),
        "trials": [
            {
                "number": trial.number,
                "state": trial.state.name.lower(),
                "front": trial.number in front,
                "parameters": trial.params,
                **trial.user_attrs.get("found", {}),
                **({"fault": trial.user_attrs["fault"]} if "fault" in trial.user_attrs else {}),
            }
            for trial in trials
        ],
    }


def importances(study: optuna.Study, seed: int) -> dict[str, dict[str, float]]:
    """Compute how much each hyperparameter matters, by fANOVA (Hutter et al. 2014; thesis, figures 5.4 and 5.8).

    Parameters
    ----------
    study : optuna.Study
        The study.
    seed : int
        Seed of the random forests.

    Returns
    -------
    dict of str to dict
        For each measure, the share of its variance that each hyperparameter explains by itself. Empty if fewer than
        ``MIN_TRIALS`` trials finished.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    result = {}
    for name in MEASURES if len(finished) >= MIN_TRIALS else ():
        values = [trial.user_attrs["found"].get(name) for trial in finished]
        if None not in values and max(values) > min(values):
            evaluator = FanovaImportanceEvaluator(seed=seed % 2**32)
            result[name] = get_param_importances(study, evaluator=evaluator, target=partial(_figure, name))
    return result


def _figure(name: str, trial: FrozenTrial) -> float:
    """Read a figure of a finished trial."""
    return float(trial.user_attrs["found"][name])
