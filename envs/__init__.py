"""Gymnasium environments with breakable objects, imported as ``fracsim.envs`` and registered by ``import fracsim``."""

from .fracture_drop import FractureDropEnv

__all__ = ["FractureDropEnv"]
