"""The notebooks run from an empty folder, and show what they do: see tests/helpers/notebooks.py."""

import base64
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.notebooks import Cell, read_cells
from tests.helpers.source_tree import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
# What the reader need not have; matplotlib is installed beside the package.
MISSING = ["torch", "mujoco", "scipy", "sklearn", "onnx"]
TIMING = re.compile(r"\b\d+\.\d s\b")  # how long something took
PICTURE, FILE = 150_000, 600_000  # bytes, at most


def outputs(cell: Cell) -> tuple[str, list[bytes]]:
    """Return what a cell printed, and its pictures."""
    texts = ["".join(out["text"]) for out in cell["outputs"] if "text" in out]
    data = [out["data"]["image/png"] for out in cell["outputs"] if "data" in out]
    return TIMING.sub("... s", "".join(texts)), [base64.b64decode(png) for png in data]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_the_notebook_shows_what_it_does(notebook: Path, tmp_path: Path) -> None:
    for module in ("matplotlib", "h5py"):
        pytest.importorskip(module)
    result = tmp_path / notebook.name
    call = [sys.executable, "-m", "tests.helpers.notebooks", str(notebook), str(result), *MISSING]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLCONFIGDIR": str(tmp_path)}
    done = subprocess.run(call, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for stored, ran in zip(read_cells(notebook), read_cells(result), strict=True):
        if stored["cell_type"] == "code":
            (said, shown), (says, shows) = outputs(stored), outputs(ran)
            again = f"python -m tests.helpers.notebooks {notebook} {notebook}"
            assert (said, len(shown)) == (says, len(shows)), f"{stored['id']}: {again}"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_the_notebook_is_short_and_uses_public_names_alone(notebook: Path) -> None:
    reference = "".join(p.read_text("utf-8") for p in ROOT.glob("docs/reference/api/*.md"))
    cells = read_cells(notebook)
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    words = "\n".join(c["source"] for c in cells if c["cell_type"] == "markdown").split()
    assert len(code) <= 15 and len(words) <= 600 and notebook.stat().st_size <= FILE
    for cell in code:
        assert len(cell["source"].splitlines()) <= 12, cell["id"]
        assert all(len(png) <= PICTURE for png in outputs(cell)[1]), cell["id"]
        for module in re.findall(r"^(?:from|import) tactile_rt(\.[\w.]+)", cell["source"], re.M):
            assert f"::: tactile_rt{module}\n" in reference, module
