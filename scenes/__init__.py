# SPDX-License-Identifier: Apache-2.0
"""USD scenes that come with warp_lcp; the ``doc`` metadata of each says what it shows and what should come out."""

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent


def names() -> list[str]:
    """Names of the shipped scenes, as :func:`warp_lcp.load_usd` takes them."""
    return sorted(p.stem for p in _FOLDER.glob("*.usda"))


def path(name: str) -> Path:
    """File of a shipped scene."""
    return _FOLDER / f"{name}.usda"
