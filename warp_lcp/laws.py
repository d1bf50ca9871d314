# SPDX-License-Identifier: Apache-2.0
"""Contact laws (formulations) and what the kernels and methods need to know of them; the equations are in docs/theory.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .errors import WarpLcpError, whole_number

FORMULATIONS = ("phantom_inertia", "anitescu_potra", "box", "hybrid", "coulomb")
SLIDING = ("regularized", "aligned", "facets")


@dataclass(frozen=True)
class Law:
    """One contact law.

    Attributes:
        formulation: one of FORMULATIONS.
        sliding: one of SLIDING, for 'phantom_inertia'; the others have their own way to slide, whatever it says.
        directions: k of a sticking contact, at least 2; 'coulomb' has none, whatever it says.

    Raises:
        WarpLcpError: where there is no such law.
    """

    formulation: str = "phantom_inertia"
    sliding: str = "regularized"
    directions: int = 2

    def __post_init__(self) -> None:
        for name, choices in (("formulation", FORMULATIONS), ("sliding", SLIDING)):
            if getattr(self, name) not in choices:
                raise WarpLcpError(f"{name} is {getattr(self, name)!r}; choose one of {', '.join(choices)}")
        object.__setattr__(self, "directions", whole_number("directions", self.directions, 2))  # 2.0 is none for a kernel

    @property
    def row_arguments(self) -> tuple[int, int, int]:
        """How the kernel of contact rows is told: sliding, admissible set while sticking (kernels/friction.py), frozen limits?"""
        facets, cone = SLIDING.index("facets"), len(SLIDING)
        return {
            "phantom_inertia": (SLIDING.index(self.sliding), self.directions, 0),
            "anitescu_potra": (facets, -self.directions, 0),
            "box": (facets, self.directions, 1),
            "hybrid": (SLIDING.index("regularized"), self.directions, 1),
            "coulomb": (cone, 1, 0),
        }[self.formulation]

    @property
    def is_cone(self) -> bool:
        """Is it Coulomb's cone itself, not an LCP?"""
        return self.formulation == "coulomb"

    @property
    def has_generators(self) -> bool:
        """Are friction impulses sums of generators (facets within the cone)?"""
        return self.formulation == "anitescu_potra"

    @property
    def has_frozen_limits(self) -> bool:
        """Do friction limits come from the last step's normal impulses?"""
        return self.formulation in ("box", "hybrid")

    @property
    def has_axes(self) -> bool:
        """Does each contact have two axes with a limit each, or a disc? (What velocity pivoting can take.)"""
        return self.is_cone or (not self.has_generators and self.directions == 2)

    @property
    def unknowns(self) -> int:
        """Largest number of unknowns of one contact in the LCP."""
        return 1 + 2 * self.directions + int(self.has_generators)

    @property
    def friction(self) -> str:
        """One line: how isotropic friction is.

        Half-way between two of k fixed directions a polygon around the cone has mu / cos(pi / 2k), one within it mu cos(pi / 2k);
        distances of stopping are as its inverse (measured: tests/test_formulations.py).
        """
        k, least = self.directions, math.cos(0.5 * math.pi / self.directions)
        less, more = f"{100 * (1 - least):.2g} %", f"{100 * (1 / least - 1):.2g} %"
        around = f"fixed facets around the cone, from world x, +{more} friction between directions (stops up to {less} too early)"
        within = f"fixed facets within the cone, from world x, -{less} friction between directions (stops up to {more} too far)"
        sticking = f"the limit of a sticking contact is exact along the predicted slip (k = {k}: at most +{more} elsewhere)"
        frozen = "limits follow the normal force of the step before"
        return {
            "phantom_inertia": {
                "regularized": f"phantom_inertia, regularized: isotropic while sliding; {sticking}",
                "aligned": f"phantom_inertia, aligned: isotropic while sliding, no friction across the slip; {sticking}",
                "facets": f"phantom_inertia, facets, k = {k}: {around}",
            }[self.sliding],
            "anitescu_potra": f"anitescu_potra, k = {k}: {within}",
            "box": f"box, k = {k}: {around}; {frozen}",
            "hybrid": f"hybrid: isotropic while sliding; {sticking}; {frozen}",
            "coulomb": "coulomb: exact",
        }[self.formulation]
