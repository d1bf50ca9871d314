# SPDX-License-Identifier: Apache-2.0
"""The package imports from a wheel, from an editable install and from a bare clone; the core loads no extra."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROBE = """
import sys, warp_lcp, warp_lcp.kernels.lemke, warp_lcp.scenes
assert warp_lcp.ModelBuilder and warp_lcp.Simulator
assert not {"pxr", "rerun"} & set(sys.modules), "an extra was loaded"
assert "kernels" not in sys.modules
from importlib.resources import files
assert (files("warp_lcp.scenes") / "box_on_ground.usda").is_file()
print(warp_lcp.__file__, warp_lcp.kernels.__file__)
"""


def copy_sources(to: Path) -> Path:
    """What a build needs, in a folder that builds may write to."""
    for name in ("warp_lcp", "kernels", "scenes"):
        shutil.copytree(ROOT / name, to / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, to / name)
    return to


def probe(where: Path, *paths: Path) -> list[Path]:
    """Run PROBE with the working directory `where` and `paths` in front of sys.path; the files it imported."""
    code = f"import sys; sys.path[:0] = {[str(p) for p in paths]!r}\n" + PROBE
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run([sys.executable, "-c", code], cwd=where, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [Path(p) for p in done.stdout.split()[-2:]]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """A wheel built from a copy of the sources, unpacked: what a plain install leaves in site-packages."""
    copy = copy_sources(tmp_path_factory.mktemp("clone"))
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(copy / "dist"), str(copy)]
    subprocess.run(command, check=True, capture_output=True)
    site = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(next((copy / "dist").glob("*.whl"))).extractall(site)
    return site


def test_bare_clone(tmp_path):
    """Python started in the clone's root, nothing installed there."""
    package, kernels = probe(ROOT, ROOT)
    assert package == ROOT / "warp_lcp" / "__init__.py"
    assert kernels == ROOT / "kernels" / "__init__.py"


def test_wheel(wheel, tmp_path):
    package, kernels = probe(tmp_path, wheel)
    assert package == wheel / "warp_lcp" / "__init__.py"
    assert kernels == wheel / "warp_lcp" / "kernels" / "__init__.py"


def test_clone_in_front_of_a_wheel(wheel):
    """In the clone's root the clone's package is found first, with the clone's own kernels."""
    package, kernels = probe(ROOT, ROOT, wheel)
    assert package.parent == ROOT / "warp_lcp"
    assert kernels.parent == ROOT / "kernels"


def test_editable_install(tmp_path):
    """pip install -e into a folder of its own: the clone's files, from any working directory."""
    copy = copy_sources(tmp_path / "clone")
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    python = venv / ("Scripts" if os.name == "nt" else "bin") / "python"
    # The parent environment's packages (Warp, numpy, setuptools) are seen through a path file, so nothing is fetched.
    site = next(venv.glob("lib/python*/site-packages"))
    (site / "parent.pth").write_text("\n".join(p for p in sys.path if p.endswith("site-packages")))
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-deps", "--no-build-isolation", "-e", str(copy)]
    subprocess.run(install, check=True, capture_output=True)
    done = subprocess.run([str(python), "-c", PROBE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    package, kernels = (Path(p) for p in done.stdout.split()[-2:])
    assert package.parent == copy / "warp_lcp"
    assert kernels.parent == copy / "kernels"


def test_import_is_quick():
    """Under 1.5 s by the design; 5 s leaves room for a loaded machine and still fails if an extra slips in."""
    code = "import time; start = time.perf_counter(); import warp_lcp; warp_lcp.Simulator; print(time.perf_counter() - start)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert float(done.stdout.split()[-1]) < 5.0


def test_ci_calls_the_readmes_test_command():
    """.ci/run holds the second command of the README, word for word."""
    readme = (ROOT / "README.md").read_text()
    commands = [line.strip() for line in readme.splitlines() if line.strip().startswith("python3 -m venv")]
    assert len(commands) == 2
    assert commands[1] in (ROOT / ".ci" / "run").read_text().splitlines()
