"""From an impulse to pieces: what a running simulation asks of a baked asset.

An atom is the smallest region of an asset that can come off; pieces are unions of atoms. (Game engines call it a
support chunk.) An interface is where two atoms meet (a bond); it breaks or holds. ``asset`` is the entrance; ``query``
follows an impulse to scores, to a field and to labels, ``assemble`` makes pieces of the labels. Nothing here needs
more than NumPy, SciPy and safetensors.
"""
