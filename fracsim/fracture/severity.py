"""Severities: how hard impulses are for one object, as its simulator counts it, and what it surely bears.

`FractureQuery` and `BreakableAsset` ask it. A severity is either an impulse over what the object's mass and strength
make of it, or the peak force of the contact over strength times size squared (`SimulatorRecord.severity_kind`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.contact import HALF_SINE, LOAD_DURATION, ContactLaw, effective_mass, pulse_force
from ..common.errors import ImpulseError
from ..common.impulse import Impulse
from ..common.material import Material

FASTEST = 100.0  # m/s, closing speed up to which bounds hold that know no more of a contact than its impulse
MOST_CONTACTS = 96  # that impulses acting together are spread over, for the same bounds; a world hands over no more


class MassProperties(NamedTuple):
    """How a rigid body resists impulses.

    Attributes
    ----------
    mass : float
        kg.
    center : ndarray of float64, shape (3,)
        Centre of mass, m.
    inertia : ndarray of float64, shape (3, 3)
        About the centre of mass, kg·m².
    """

    mass: float
    center: FloatArray
    inertia: FloatArray


@dataclass(frozen=True, eq=False)
class SeverityScale:
    """What turns impulses on an asset of one size and material into severities.

    Attributes
    ----------
    is_force : bool
        Whether severities count forces, not impulses.
    unit : float
        N·s or N, of severity 1.
    contact : ContactLaw
        Of the asset with something hard; its compliance (V,) is that at each vertex, m/N.
    """

    is_force: bool
    unit: float
    contact: ContactLaw

    @classmethod
    def of(
        cls, kind: str, gauge: float, compliance: FloatArray, material: Material, scale: float, mass: float
    ) -> SeverityScale:
        """Work out the scale of a body.

        Parameters
        ----------
        kind, gauge
            As ``severity_kind`` and ``gauge`` of a ``SimulatorRecord``.
        compliance : ndarray of float64, shape (V,)
            Of its vertices, in 1 / (E L); 0 where its simulator does not know it: the body then does not bend.
        material : Material
            Its material.
        scale : float
            m, its largest extent.
        mass : float
            kg.

        Returns
        -------
        SeverityScale
            The scale.
        """
        elastic = material.youngs_modulus, material.poisson_ratio
        law = ContactLaw.of(scale, *elastic, compliance=compliance / (material.youngs_modulus * scale))
        if kind == "force":
            return cls(True, material.tensile_strength * scale**2, law)
        return cls(False, mass * (gauge * material.critical_velocity), law)

    def compliance_at(self, corners: IntArray, barycentric: FloatArray) -> FloatArray:
        """Interpolate the compliance of the surface.

        Parameters
        ----------
        corners : ndarray of int64, shape (K, 3)
            Vertices of faces.
        barycentric : ndarray of float64, shape (K, 3)
            Where on these.

        Returns
        -------
        ndarray of float64, shape (K,)
            m/N.
        """
        return np.asarray((np.asarray(self.contact.compliance)[corners] * barycentric).sum(axis=1))

    def severities(
        self,
        impulses: Sequence[Impulse],
        corners: IntArray,
        barycentric: FloatArray,
        points: FloatArray,
        body: MassProperties,
    ) -> FloatArray:
        """Say how severe impulses are.

        Parameters
        ----------
        impulses : sequence of Impulse
            K of them.
        corners : ndarray of int64, shape (K, 3)
            Vertices of the faces that they act on.
        barycentric : ndarray of float64, shape (K, 3)
            Where on these.
        points : ndarray of float64, shape (K, 3)
            The same places, m.
        body : MassProperties
            Of the asset, or of the piece that is struck.

        Returns
        -------
        ndarray of float64, shape (K,)
            Severities.

        Raises
        ------
        ImpulseError
            If a force is not finite.

        Notes
        -----
        Where severities count impulses, one that lasts long counts as what its peak force gives in `LOAD_DURATION`, and
        never as more than it is. Where they count forces, an impulse J of unknown duration is one of something hard and
        heavy: its contact takes the energy J²/2m, m being the body's effective mass there.
        """
        sizes = np.array([impulse.magnitude for impulse in impulses])
        lasting = np.array([impulse.duration or 0.0 for impulse in impulses])
        known = lasting > 0.0
        if not self.is_force:
            shares = np.divide(HALF_SINE * LOAD_DURATION, lasting, out=np.ones(len(sizes)), where=known)
            return np.asarray(sizes * np.minimum(shares, 1.0) / self.unit)
        forces = pulse_force(sizes, np.where(known, lasting, 1.0))
        if not known.all():
            directions = np.array([impulse.direction for impulse in impulses])
            mass = effective_mass(body.mass, body.inertia, points - body.center, directions)
            law = replace(self.contact, compliance=self.compliance_at(corners, barycentric))
            forces = np.where(known, forces, law.peak_force(sizes**2 / (2.0 * mass)))
        severities = np.asarray(forces / self.unit)
        if not np.isfinite(severities).all():
            raise ImpulseError("impulses are too large for their forces to be finite; check their magnitudes, in N·s")
        return severities

    def magnitudes(
        self,
        severities: FloatArray,
        corners: IntArray,
        barycentric: FloatArray,
        points: FloatArray,
        directions: FloatArray,
        body: MassProperties,
    ) -> FloatArray:
        """Find the impulses of unknown duration that have given severities.

        Parameters
        ----------
        severities : ndarray of float64, shape (K,)
            What they should have.
        corners, barycentric, points : ndarray
            As of `severities`.
        directions : ndarray of float64, shape (K, 3)
            Unit vectors along them.
        body : MassProperties
            As of `severities`.

        Returns
        -------
        ndarray of float64, shape (K,)
            N·s.
        """
        if not self.is_force:
            return np.asarray(severities * self.unit)
        law = replace(self.contact, compliance=self.compliance_at(corners, barycentric))
        mass = effective_mass(body.mass, body.inertia, points - body.center, directions)
        return np.asarray(np.sqrt(2.0 * law.energy(severities * self.unit) * mass))

    def breaking_impulses(
        self, bounds: FloatArray, vertices: FloatArray, faces: IntArray, body: MassProperties
    ) -> FloatArray:
        """Turn severities that break nothing around each vertex into impulses that break nothing there.

        Parameters
        ----------
        bounds : ndarray of float64, shape (V,)
            Severities.
        vertices : ndarray of float64, shape (V, 3)
            m.
        faces : ndarray of int64, shape (F, 3)
            Of the surface.
        body : MassProperties
            Of the asset.

        Returns
        -------
        ndarray of float64, shape (V,)
            N·s, of impulses of unknown duration in any direction.
        """
        if not self.is_force:
            return np.asarray(bounds * self.unit)
        arm = vertices - body.center
        turn = np.cross(arm[:, None, :], np.eye(3)[None])  # (V, 3, 3), row k: r × e_k
        spin = np.einsum("vki,ij,vlj->vkl", turn, np.linalg.inv(body.inertia), turn)
        lightness = 1.0 / body.mass + np.linalg.eigvalsh(spin)[:, -1]  # 1/kg, in the direction that is easiest to push
        stiffest, lightest = np.array(self.contact.compliance), lightness.copy()
        for corner in range(3):  # what holds at all corners of a face holds within it
            np.minimum.at(stiffest, faces[:, corner], np.asarray(self.contact.compliance)[faces].min(axis=1))
            np.maximum.at(lightest, faces[:, corner], lightness[faces].max(axis=1))
        law = replace(self.contact, compliance=stiffest)
        return np.asarray(np.sqrt(2.0 * law.energy(bounds * self.unit) / lightest))

    def bearable_impulse(self, bound: float, vertices: FloatArray, body: MassProperties) -> float:
        """Turn a total severity that breaks nothing anywhere into an impulse that breaks nothing anywhere.

        Parameters
        ----------
        bound : float
            Severity.
        vertices : ndarray of float64, shape (V, 3)
            m.
        body : MassProperties
            Of the asset.

        Returns
        -------
        float
            N·s.

        Notes
        -----
        Where severities count forces: J makes the most force of it as the contact of something hard on a body that does
        not bend, at `FASTEST`, where it takes the energy J v/2; and, for an impulse of unknown duration, J²/2m with the
        smallest m that the body sets against any impulse. Spread over n contacts it makes n^(2/5) times the force.
        """
        if not self.is_force:
            return bound * self.unit
        stiff = replace(self.contact, compliance=0.0)
        work = float(stiff.energy(bound * self.unit))
        reach = float(np.linalg.norm(vertices - body.center, axis=1).max())
        lightness = 1.0 / body.mass + reach**2 / float(np.linalg.eigvalsh(body.inertia)[0])
        return min(2.0 * work / FASTEST / MOST_CONTACTS ** (2.0 / 3.0), float(np.sqrt(2.0 * work / lightness)))
