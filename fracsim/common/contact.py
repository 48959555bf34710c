"""The contact law: how hard and how long two bodies press on each other in an impact of a given energy.

An impulse alone does not say what breaks: the same one is a tap of rubber or a blow of steel. The fracture room turns
impulses into forces with it, and the physics room finds how long contacts last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .arrays import FloatArray

CONTACT_RADIUS = 0.05  # of the struck surface where it touches, in units of the largest extent of the body
GROSS_RADIUS = 0.5  # of the body as a whole, in the same units: what a layer feels that it sinks into
LOAD_DURATION = 1e-3  # s, by which a lasting force is multiplied where an impulse is asked for: a hard impact's length
HALF_SINE = 0.5 * np.pi  # peak over mean of a half-sine pulse
NEWTON_STEPS = 8  # from where the search begins, five are enough for the last bit
HARD = np.inf  # Pa, Young's modulus of what does not give way

Numbers = float | FloatArray


def pair_modulus(
    youngs_modulus: float, poisson_ratio: float, other_modulus: float = HARD, other_ratio: float = 0.0
) -> float:
    """Compute the modulus of a pair of elastic bodies in contact.

    Parameters
    ----------
    youngs_modulus, poisson_ratio : float
        Of one body; Pa, infinite for a rigid one.
    other_modulus, other_ratio : float
        Of the other.

    Returns
    -------
    float
        E*, Pa; infinite where both are rigid.

    Notes
    -----
    1/E* = (1 - ν₁²)/E₁ + (1 - ν₂²)/E₂; K. L. Johnson, *Contact Mechanics*, Eq. 4.20.
    """
    compliance = (1.0 - poisson_ratio**2) / youngs_modulus + (1.0 - other_ratio**2) / other_modulus
    return np.inf if compliance == 0.0 else 1.0 / compliance


def hertz_stiffness(modulus: float, size: float, radius: float = CONTACT_RADIUS) -> float:
    """Compute the stiffness k of a Hertz contact, F = k δ^(3/2).

    Parameters
    ----------
    modulus : float
        E* of the pair, Pa.
    size : float
        m, the largest extent of the struck body.
    radius : float
        R, in units of that.

    Returns
    -------
    float
        N/m^(3/2).

    Notes
    -----
    k = 4/3 E* √R; Johnson, *Contact Mechanics*, Eq. 4.23.
    """
    return float(4.0 / 3.0 * modulus * np.sqrt(radius * size))


def shared_stiffness(stiffness: float, shares: FloatArray) -> float:
    """Compute the stiffness of several equal contacts that share one force in fixed parts, as if they were one.

    Parameters
    ----------
    stiffness : float
        k of each, N/m^(3/2).
    shares : ndarray of float64, shape (n,)
        Of the force; they sum to 1.

    Returns
    -------
    float
        N/m^(3/2), at least k: each contact takes 2/5 F^(5/3) k^(-2/3) of its own part of the force, together less.
    """
    return stiffness * float((shares ** (5.0 / 3.0)).sum()) ** -1.5


def _hertz_factor(stiffness: float) -> float:
    """Compute a of the Hertz work a F^(5/3), which is ∫ F dδ up to the force F."""
    return 0.4 * stiffness ** (-2.0 / 3.0)


@dataclass(frozen=True, eq=False)
class ContactLaw:
    """How the contact of two bodies gives way.

    Attributes
    ----------
    stiffness : float
        k of the Hertz contact, N/m^(3/2); infinite where nothing gives way locally.
    compliance : float or ndarray of float64, shape (...,)
        m/N, of the springs in series with it: how far the bodies themselves bend under the force.
    bottom_force : float
        N, at which a soft layer between them is pressed together; infinite where there is none.
    bottom_stiffness : float
        k from there on, N/m^(3/2).

    Notes
    -----
    The energy that the contact takes up to the peak force F is that of its springs in series:

        W = 2/5 F^(5/3) k^(-2/3) + C F²/2.

    A layer gives way by more than the surface that presses into it is round where it touches, so that the body as a
    whole is the ball that presses: R is `GROSS_RADIUS`. The layer behaves as a half-space of its material, which leaves
    out how much stiffer a thin one is, until the part of the indentation that it takes reaches its travel. Then it is
    pressed together, and what is behind it, rigid, takes what is left of the energy: the first term becomes
    2/5 (F_b^(5/3) k^(-2/3) + (F^(5/3) - F_b^(5/3)) k_b^(-2/3)), k_b that of the struck body on a rigid one. This is the
    cushion with abrupt bottoming of R. D. Mindlin, "Dynamics of package cushioning", Bell Syst. Tech. J. 24 (1945),
    with the indentation by a ball for the spring before it does.
    """

    stiffness: float
    compliance: Numbers = 0.0
    bottom_force: float = np.inf
    bottom_stiffness: float = np.inf

    @classmethod
    def of(
        cls,
        size: float,
        youngs_modulus: float,
        poisson_ratio: float,
        other_modulus: float = HARD,
        other_ratio: float = 0.0,
        travel: float | None = None,
        compliance: Numbers = 0.0,
    ) -> ContactLaw:
        """Put the law of a pair together.

        Parameters
        ----------
        size : float
            m, the largest extent of the struck body.
        youngs_modulus, poisson_ratio : float
            Of the struck body; Pa.
        other_modulus, other_ratio : float
            Of what strikes it; hard by default.
        travel : float, optional
            m, by which what strikes it can be indented before it bottoms out; None: by any length.
        compliance : float or ndarray of float64, shape (...,)
            m/N, of both bodies.

        Returns
        -------
        ContactLaw
            The law.
        """
        modulus = pair_modulus(youngs_modulus, poisson_ratio, other_modulus, other_ratio)
        if travel is None or not np.isfinite(other_modulus):
            return cls(hertz_stiffness(modulus, size), compliance)
        stiffness = hertz_stiffness(modulus, size, GROSS_RADIUS)
        share = modulus * (1.0 - other_ratio**2) / other_modulus  # of the indentation, that the layer takes
        bottom_stiffness = hertz_stiffness(pair_modulus(youngs_modulus, poisson_ratio), size)
        return cls(stiffness, compliance, stiffness * (travel / share) ** 1.5, bottom_stiffness)

    @property
    def _recovered(self) -> float:
        """J, by which less than on a rigid body is left of the energy once the layer has bottomed out."""
        if not np.isfinite(self.bottom_force):
            return 0.0
        saved = _hertz_factor(self.stiffness) - _hertz_factor(self.bottom_stiffness)
        return float(saved * self.bottom_force ** (5.0 / 3.0))

    def energy(self, force: npt.ArrayLike) -> FloatArray:
        """Compute the energy that the contact takes up to a force.

        Parameters
        ----------
        force : array_like, shape (...,)
            N, at least 0.

        Returns
        -------
        ndarray of float64, shape (...,)
            J.
        """
        peak = np.asarray(force, dtype=np.float64)
        power = peak ** (5.0 / 3.0)
        work = _hertz_factor(self.stiffness) * power
        if np.isfinite(self.bottom_force):
            bottomed = _hertz_factor(self.bottom_stiffness) * power + self._recovered
            work = np.where(peak > self.bottom_force, bottomed, work)
        return np.asarray(work + 0.5 * np.asarray(self.compliance) * peak**2)

    def peak_force(self, energy: npt.ArrayLike) -> FloatArray:
        """Compute the force at which the contact has taken an energy.

        Parameters
        ----------
        energy : array_like, shape (...,)
            J, at least 0.

        Returns
        -------
        ndarray of float64, shape (...,)
            N; 0 where the energy is 0, infinite where there is some and nothing gives way.
        """
        work = np.asarray(energy, dtype=np.float64)
        factor: Numbers = _hertz_factor(self.stiffness)
        if np.isfinite(self.bottom_force):
            bottomed = work > self.energy(self.bottom_force)
            work = np.where(bottomed, work - self._recovered, work)
            factor = np.where(bottomed, _hertz_factor(self.bottom_stiffness), factor)
        return _balanced_force(work, np.asarray(factor), 0.5 * np.asarray(self.compliance))


def _balanced_force(work: FloatArray, hertz: FloatArray, spring: FloatArray) -> FloatArray:
    """Solve W = a F^(5/3) + b F² for F ≥ 0.

    Each term alone would need at least the force that both together do, so that the smaller of the two is a bound. In
    units of it the root lies between 0.66 and 1, where the right side is convex: Newton's steps from 1 come down to it.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = np.minimum((work / hertz) ** 0.6, np.sqrt(work / spring))
        first, second = hertz * bound ** (5.0 / 3.0) / work, spring * bound**2 / work
        ratio = np.ones_like(bound)
        for _ in range(NEWTON_STEPS):
            excess = first * ratio ** (5.0 / 3.0) + second * ratio**2 - 1.0
            ratio = ratio - excess / (5.0 / 3.0 * first * ratio ** (2.0 / 3.0) + 2.0 * second * ratio)
        force = np.where(np.isfinite(bound), bound * ratio, np.inf)
    return np.asarray(np.where(work > 0.0, force, 0.0))


def pulse_force(impulse: npt.ArrayLike, duration: npt.ArrayLike) -> FloatArray:
    """Compute the peak force of a half-sine pulse.

    Parameters
    ----------
    impulse : array_like, shape (...,)
        N·s.
    duration : array_like, shape (...,)
        s, above 0.

    Returns
    -------
    ndarray of float64, shape (...,)
        N: F = π/2 · J / t.
    """
    return np.asarray(HALF_SINE * np.asarray(impulse) / np.asarray(duration))


def pulse_duration(impulse: npt.ArrayLike, force: npt.ArrayLike) -> FloatArray:
    """Compute how long a half-sine pulse of a peak force lasts.

    Parameters
    ----------
    impulse : array_like, shape (...,)
        N·s.
    force : array_like, shape (...,)
        N, above 0.

    Returns
    -------
    ndarray of float64, shape (...,)
        s: t = π/2 · J / F.
    """
    return np.asarray(HALF_SINE * np.asarray(impulse) / np.asarray(force))


def effective_mass(mass: float, inertia: FloatArray, arms: FloatArray, directions: FloatArray) -> FloatArray:
    """Compute the mass that a rigid body sets against impulses at points off its centre of mass.

    Parameters
    ----------
    mass : float
        kg.
    inertia : ndarray of float64, shape (3, 3)
        About the centre of mass, kg·m².
    arms : ndarray of float64, shape (K, 3)
        m, from the centre of mass to the points.
    directions : ndarray of float64, shape (K, 3)
        Unit vectors along the impulses.

    Returns
    -------
    ndarray of float64, shape (K,)
        kg: 1 / (1/m + (r × d)ᵀ I⁻¹ (r × d)).
    """
    turn = np.cross(arms, directions)
    return np.asarray(1.0 / (1.0 / mass + np.einsum("ki,ki->k", turn, np.linalg.solve(inertia, turn.T).T)))


def speed_number(duration: npt.ArrayLike, size: float, wave_speed: float) -> FloatArray:
    """Compute how fast a contact is for the body that it strikes.

    Parameters
    ----------
    duration : array_like, shape (...,)
        s, of the contact.
    size : float
        m, the largest extent.
    wave_speed : float
        m/s, √(E/ρ) of the body.

    Returns
    -------
    ndarray of float64, shape (...,)
        s = π L / (t c₀), without unit. Small: the body answers as to a slow push; large: waves carry the blow.
    """
    return np.asarray(np.pi * size / (np.asarray(duration) * wave_speed))
