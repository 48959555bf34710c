"""How long impacts last, by the contact law between what a breakable object and what it meets are made of.

The verdicts ask for durations when an impact has been predicted, and only then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..common.contact import HARD, ContactLaw, pulse_duration
from ..common.material import ContactMaterial
from .breakable import Breakable, ElasticBreakable, ElasticMaterial
from .bullet import Engine
from .clock import Clock
from .contact_materials import ContactMaterials
from .impacts import ClosedContact
from .records import BodyRecord
from .states import AT_REST

ONE_CONTACT = 0.1  # of the struck object's largest extent: contacts that begin together within it are one


class ContactDurations:
    """Finds how long impacts last.

    Parameters
    ----------
    engine : Engine
        Engine that the bodies are in.
    clock : Clock
        Its clock.
    records : dict of int to BodyRecord
        The breakable bodies, by id.
    materials : ContactMaterials
        What the others are made of.
    """

    def __init__(
        self, engine: Engine, clock: Clock, records: dict[int, BodyRecord], materials: ContactMaterials
    ) -> None:
        self._engine, self._clock, self._records, self._materials = engine, clock, records, materials

    def of(self, breakable: Breakable) -> Callable[[Sequence[ClosedContact], float], list[float | None]]:
        """Make what finds the durations of impacts on a breakable object.

        Parameters
        ----------
        breakable : Breakable
            The object.

        Returns
        -------
        callable
            Takes contacts, and the speed below which one only leans; gives the duration of each, s. None is that of
            something hard and heavy, to an object that counts impulses or is rigid itself.

        Notes
        -----
        Contacts that begin together within `ONE_CONTACT` share their energy and their pulse, since they bend the same
        part of the body. One that only leans carries on what the strongest of the others gives it, as long as that.
        """

        def durations(contacts: Sequence[ClosedContact], leaning: float) -> list[float | None]:
            result: list[float | None] = [None] * len(contacts)
            order = sorted(range(len(contacts)), key=lambda i: -contacts[i].impulse)
            striking = [i for i in order if contacts[i].speed > leaning]
            groups: list[list[int]] = []
            for i in striking:
                group = next((g for g in groups if _is_one(contacts[g[0]], contacts[i], breakable.size)), None)
                if group is None:
                    groups.append([i])
                else:
                    group.append(i)
            for group in groups:
                duration = self._duration([contacts[i] for i in group], breakable)
                for i in group:
                    result[i] = duration
            for i in set(order).difference(striking):
                others = [k for k in striking if contacts[k].delay == contacts[i].delay]
                result[i] = result[others[0]] if others else None
            return result

        return durations

    def _duration(self, group: Sequence[ClosedContact], breakable: Breakable) -> float | None:
        """Find the duration of contacts that are one, strongest first."""
        first = group[0]
        feels_force = isinstance(breakable, ElasticBreakable) and breakable.severity_kind == "force"
        other, compliance = self._partner(first) if feels_force else (self._materials.of(*first.other), 0.0)
        if first.stiffness > 0.0:
            compliance += 1.0 / first.stiffness
        elif other is None and not feels_force:
            return None
        modulus, ratio = HARD, 0.0
        if isinstance(breakable, ElasticBreakable):
            compliance += float(breakable.compliance_at(first.place[None])[0])
            modulus, ratio = breakable.material.youngs_modulus, breakable.material.poisson_ratio
        partner = (HARD, 0.0, None) if other is None else (other.youngs_modulus, other.poisson_ratio, other.travel)
        law = ContactLaw.of(breakable.size, modulus, ratio, *partner, compliance=compliance)
        force = float(law.peak_force(sum(contact.energy for contact in group)))
        if not 0.0 < force < np.inf:
            return None
        return float(pulse_duration(sum(contact.impulse for contact in group), force))

    def _partner(self, contact: ClosedContact) -> tuple[ContactMaterial | None, float]:
        """Find what an object that feels forces is in contact with, and how far that bends, m/N."""
        body, link = contact.other
        record = self._records.get(body)
        if record is None:
            return self._materials.of(body, link), 0.0
        material = record.breakable.material
        if not (isinstance(record.breakable, ElasticBreakable) and isinstance(material, ElasticMaterial)):
            return None, 0.0
        pose = record.body.pose(self._engine.placement_before(body, self._clock.time_step), AT_REST)
        place = (contact.point - pose.position) @ pose.rotation
        known = ContactMaterial(record.breakable.name, material.youngs_modulus, material.poisson_ratio)
        return known, float(record.breakable.compliance_at(place[None])[0])


def _is_one(first: ClosedContact, second: ClosedContact, size: float) -> bool:
    """Whether two contacts are one. size: m, the struck object's largest extent."""
    return bool(
        first.other == second.other
        and first.delay == second.delay
        and np.linalg.norm(first.place - second.place) < ONE_CONTACT * size
    )
