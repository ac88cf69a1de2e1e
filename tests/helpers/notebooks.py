"""Notebooks, run without Jupyter: `python -m tests.helpers.notebooks FROM TO [MISSING ...]`.

The code cells of one file run in order, in one namespace and an empty folder, and go into the other
with what they print and the figures that they leave open. Lines that begin with ! are commands of a
shell, as in Jupyter. Packages that are named as missing cannot be imported.
"""

import base64
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

from tests.helpers.source_tree import ROOT

SHELL = re.compile(r"^!((?:.*\\\n)*.*)$", re.M)
Cell = dict[str, Any]


def read_cells(notebook: Path) -> list[Cell]:
    """Return the cells of a notebook, their sources as text."""
    cells: list[Cell] = json.loads(notebook.read_text("utf-8"))["cells"]
    return [{**cell, "source": "".join(cell["source"])} for cell in cells]


def run_cells(cells: list[Cell], folder: Path) -> None:
    """Run the code cells in a folder, and give each its outputs."""
    from matplotlib import pyplot

    program = folder / "tactile-rt"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m tactile_rt "$@"\n')
    program.chmod(0o755)
    path = f"{folder}{os.pathsep}{os.environ['PATH']}"
    os.environ |= {"PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    pyplot.show, tempfile.tempdir = (lambda: None), str(folder)
    names: dict[str, Any] = {"__name__": "__main__", "_shell": _shell}
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    for number, cell in enumerate(code, 1):
        source = SHELL.sub(lambda m: f"_shell({m[1]!r})", "".join(cell["source"]))
        with redirect_stdout(io.StringIO()) as out:
            exec(compile(source, f"cell {cell['id']}", "exec"), names)
        lines, cell["execution_count"] = out.getvalue().splitlines(keepends=True), number
        printed = {"name": "stdout", "output_type": "stream", "text": lines}
        cell["outputs"] = [printed] if lines else []
        for figure in map(pyplot.figure, pyplot.get_fignums()):
            figure.savefig(png := io.BytesIO(), metadata={"Software": None})
            title = (figure.get_suptitle() or figure.axes[0].get_title()).strip()
            data = {"image/png": base64.b64encode(png.getvalue()).decode(), "text/plain": [title]}
            cell["outputs"].append({"data": data, "metadata": {}, "output_type": "display_data"})
        pyplot.close("all")


def _shell(command: str) -> None:
    call = ["bash", "-c", f"set -o pipefail; {command}"]
    done = subprocess.run(call, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    sys.stdout.write(done.stdout)  # progress goes to the other stream
    if done.returncode:
        raise RuntimeError(f"{command}: exit code {done.returncode}\n{done.stderr}")


if __name__ == "__main__":
    begun_from, into, *missing = sys.argv[1:]
    sys.modules.update(dict.fromkeys(missing))  # type: ignore[arg-type]
    os.environ["MPLBACKEND"] = "agg"
    content = json.loads(Path(begun_from).read_text("utf-8"))
    with tempfile.TemporaryDirectory() as empty, chdir(empty):
        run_cells(content["cells"], Path(empty))
    Path(into).write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")
