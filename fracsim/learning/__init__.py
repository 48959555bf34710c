"""Models that learn how a body breaks: the registry of their classes. Offline only.

A model is one file in this folder and one line in MODELS. ``register_model`` adds a class of the user's own, which
then goes through ``fracsim train``, ``tune`` and ``evaluate`` by its name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..common.errors import ModelError
from ..common.registry import check_new_name, class_at, missing_members

if TYPE_CHECKING:
    from .model import Model

# A class, or "module:Class" where the module is imported when the model is first used.
MODELS: dict[str, str | type[Model]] = {
    "mlp": "fracsim.learning.mlp:MLP",
    "deltaconv": "fracsim.learning.deltaconv:DeltaConv",
    "field": "fracsim.learning.field:FieldModel",
    "interfaces": "fracsim.learning.interfaces:InterfaceModel",
    "shared": "fracsim.learning.shared:SharedField",
    "nearest": "fracsim.learning.nearest:Nearest",
}
# What is looked up in every class; ``model.Model`` says what each is, and has defaults for most.
REQUIRED = (
    *("kind", "options_type", "search_space", "cost", "slow", "fit_many", "on"),
    *("fit", "predict", "predict_labels", "predict_nodes", "state", "restore"),
)


def register_model(name: str, cls: type[Model] | str) -> None:
    """Add a model, so that commands and plans know it by its name.

    Parameters
    ----------
    name : str
        The name that ``fracsim train --model`` takes; the class's ``kind``.
    cls : type or str
        The class, see ``fracsim.learning.model.Model``; or "module:Class", imported when it is first used.

    Raises
    ------
    ModelError
        Where the name is taken or is not the class's kind, or the class lacks what is looked up in a model.
    """
    check_new_name(name, MODELS, "model", ModelError)
    MODELS[name] = cls if isinstance(cls, str) else _complete(name, cls)


def model_class(name: str) -> type[Model]:
    """Find the class of a model; its module is imported now.

    Parameters
    ----------
    name : str
        A name in MODELS.

    Returns
    -------
    type
        The class, see ``fracsim.learning.model.Model``.

    Raises
    ------
    ModelError
        Where no model has that name, or the place it was registered with does not hold it.
    """
    if name not in MODELS:
        raise ModelError(f"unknown model {name!r}; use one of {', '.join(MODELS)}")
    entry = MODELS[name]
    if isinstance(entry, str):
        entry = _complete(name, class_at(entry, f"model {name!r}", ModelError))
        MODELS[name] = entry
    return entry


def _complete(name: str, cls: Any) -> type[Model]:
    """Return the class, if it carries all that is looked up in a model."""
    if not isinstance(cls, type):
        raise ModelError(f"model {name!r}: must be a class or 'module:Class', got {cls!r}")
    if missing := missing_members(cls, REQUIRED):
        raise ModelError(
            f"{cls.__name__}: lacks {', '.join(missing)}; "
            "inherit from fracsim.learning.model.Model, which has the defaults"
        )
    model: type[Model] = cls
    if model.kind != name:
        raise ModelError(f"{cls.__name__}: its kind is {model.kind!r}, so it cannot be registered as {name!r}")
    return model
