"""Studies of the whole pipeline: evaluation of models and segmentations, search for hyperparameters, and pictures."""
