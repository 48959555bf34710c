"""What bodies that do not break are made of, as far as somebody has said so.

`World.set_material` writes it; how long impacts last follows from it.
"""

from __future__ import annotations

from ..common.errors import PhysicsError
from ..common.material import ContactMaterial, Material, as_contact_material
from .bullet import Engine
from .states import BodyNotFound


class ContactMaterials:
    """What bodies are made of that do not break, as far as somebody has said so.

    Parameters
    ----------
    engine : Engine
        Engine that the bodies are in.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._named: dict[tuple[int, int | None], tuple[str, ContactMaterial]] = {}  # with the tag of the body

    def set(self, body: int, link: int | None, material: str | Material | ContactMaterial | None) -> None:
        """Name a material.

        Parameters
        ----------
        body : int
            Id of the body.
        link : int, optional
            Its link, -1 the base; None: all of it that is not named apart.
        material : str, Material, ContactMaterial, optional
            As of `as_contact_material`; None: hard again; with a link, what the rest of the body is of.
            Together with no link, this forgets all links.

        Raises
        ------
        PhysicsError
            Where there is no such body.
        MaterialError
            Where there is no such material.
        """
        if material is None:
            for key in [key for key in self._named if key[0] == body and link in (None, key[1])]:
                del self._named[key]
            return
        known = as_contact_material(material)
        try:
            self._engine.placement(body)
        except BodyNotFound:
            raise PhysicsError(f"there is no body {body} to be of {known.name}") from None
        self._named[body, link] = (self._engine.mark(body), known)

    def of(self, body: int, link: int) -> ContactMaterial | None:
        """Look a material up.

        Parameters
        ----------
        body, link : int
            Id of the body, and its link.

        Returns
        -------
        ContactMaterial or None
            None where nobody has named one.
        """
        for key in ((body, link), (body, None)):
            if key in self._named:
                token, material = self._named[key]
                if self._engine.is_marked(body, token):
                    return material
                del self._named[key]  # the body is gone, and its id another's
        return None
