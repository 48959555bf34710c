"""Surfaces and solids: what a mesh is turned into before anything is simulated on it. Offline only.

The simulators, datasets and models above use it; it needs the extra ``bake``.
"""
