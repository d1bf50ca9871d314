# SPDX-License-Identifier: Apache-2.0
"""Contact laws (formulations) and what the kernels and methods need to know of them; the equations are in docs/theory.md."""

from __future__ import annotations

from dataclasses import dataclass

FORMULATIONS = ("phantom_inertia", "anitescu_potra", "box", "hybrid", "coulomb")
SLIDING = ("regularized", "aligned", "facets")


@dataclass(frozen=True)
class Law:
    """One contact law.

    Attributes:
        formulation: one of FORMULATIONS.
        sliding: one of SLIDING, for 'phantom_inertia'; the others have their own way to slide.
        directions: k of a sticking contact; 'coulomb' has none.
    """

    formulation: str = "phantom_inertia"
    sliding: str = "regularized"
    directions: int = 2

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
