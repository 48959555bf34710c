"""Fracture samples: impacts that are drawn, a simulator that answers them, and the files that keep both. Offline only.

Learning, studies and users come in by ``samples``, ``dataset`` and ``writing``.
"""
