"""Mesh files that are made to exhaust who reads them are refused at once, in one line."""

import json
import subprocess
import sys

import pytest

from tests.helpers.hostile_files import MESHES
from tests.helpers.measured import Measured

pytest.importorskip("trimesh")

# The simulator is imported once: every command runs in a child that has it already.
FORKS = """
import json, os, sys
import tactile_rt.sim_backend.objects.catalogue
import tactile_rt.sim_backend.stimulus_simulation
from tactile_rt.cli import main

found, (out, *paths) = [], sys.argv[1:]
for path in paths:
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.dup2(writing, 2)
        sys.argv[1:] = ["whisk", out, "--object", path]
        try:
            main()
        except SystemExit as left:
            sys.stderr.flush()
            os._exit(left.code)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as told:
        err = told.read()
    _, status, used = os.wait4(child, 0)
    cpu_s = used.ru_utime + used.ru_stime
    found.append([os.waitstatus_to_exitcode(status), "", err, cpu_s, used.ru_maxrss / 1024])
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def refused(tmp_path_factory) -> dict[str, Measured]:
    """What became of each mesh."""
    folder = tmp_path_factory.mktemp("hostile")
    paths = []
    for number, make in enumerate(MESHES.values()):
        suffix, content = make()
        paths.append(folder / f"hostile{number}{suffix}")
        paths[-1].write_bytes(content)
    out = folder / "out.npz"
    run = subprocess.run(
        [sys.executable, "-c", FORKS, str(out), *map(str, paths)],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    return {
        name: Measured(*told, ("whisk", out, "--object", path))
        for name, path, told in zip(MESHES, paths, json.loads(run.stdout), strict=True)
    }


@pytest.mark.parametrize("name", MESHES)
def test_a_hostile_mesh_is_refused(name, refused):
    refused[name].assert_refused("hostile", cpu_s=1.0)
