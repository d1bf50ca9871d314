# SPDX-License-Identifier: Apache-2.0
"""Contact simulation that is exact and massively batched: frictional contact solved as an LCP, in Warp kernels.

Public names are imported when first used, so that ``import warp_lcp`` stays quick and loads neither USD nor Rerun.
"""

from importlib import import_module, metadata
from pathlib import Path
from typing import Any

_HERE = Path(__file__).resolve().parent
if not (_HERE / "kernels").is_dir():
    # A clone: kernels/ and scenes/ stand beside this package and are installed inside it (pyproject.toml).
    __path__.append(str(_HERE.parent))

_PUBLIC = {
    "ContactSolution": "friction_problem",
    "Control": "simulator",
    "Drive": "model",
    "JointType": "model",
    "Combine": "model",
    "Material": "model",
    "MissingExtra": "errors",
    "Model": "model",
    "ModelBuilder": "builder",
    "ModelError": "errors",
    "Report": "model",
    "RerunLogger": "logger",
    "Rollout": "rollout",
    "SceneError": "errors",
    "ShapeType": "model",
    "SimulationError": "errors",
    "Simulator": "simulator",
    "Status": "simulator",
    "WarpLcpError": "errors",
    "LCPSolution": "solve",
    "load_usd": "usd",
    "solve_contact": "friction_problem",
    "solve_lcp": "solve",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("warp_lcp")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'warp_lcp' has no attribute {name!r}")
    value = getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
