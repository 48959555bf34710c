"""From contacts to impulses, and from pieces to bodies: breakable objects in a PyBullet simulation, step by step.

`world` is the way in; `scene` is what environments and examples stand on.
"""
