# SPDX-License-Identifier: Apache-2.0
"""matplotlib without a screen, and figures as PNG and as SVG whose elements can have titles."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from warp_lcp.errors import MissingExtra

SVG = "http://www.w3.org/2000/svg"


def pyplot(**style: Any) -> Any:
    """matplotlib.pyplot with settings for text, lines and reproducible SVG; further rcParams with _ for their dots.

    Raises:
        MissingExtra: without matplotlib.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtra("the picture", "bench", error) from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcdefaults()
    plt.rcParams |= {"svg.hashsalt": "warp_lcp"} | {name.replace("_", "."): value for name, value in style.items()}
    return plt


def save(figure: Any, path: Path, dpi: int = 150, titles: dict[str, str] | None = None) -> list[Path]:
    """Write path.png and path.svg, the latter with a title for every element whose id is a key of `titles`.

    The same data give the same files.
    """
    files = [path.with_suffix(".png"), path.with_suffix(".svg")]
    figure.savefig(files[0], dpi=dpi, metadata={"Software": None})
    figure.savefig(files[1], metadata={"Date": None})
    if titles:
        ElementTree.register_namespace("", SVG)
        ElementTree.register_namespace("xlink", "http://www.w3.org/1999/xlink")
        tree = ElementTree.parse(files[1])
        for element in tree.iter():
            if element.get("id") in titles:
                said = ElementTree.Element(f"{{{SVG}}}title")
                said.text = titles[element.get("id", "")]
                element.insert(0, said)
        tree.write(files[1], encoding="unicode", xml_declaration=True)
    return files
