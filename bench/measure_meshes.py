"""Print the table of docs/objects.md: pieces, distance and time of meshes cut to 0.1 mm at 40 mm.

Run: python bench/measure_meshes.py
"""

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the meshes live in the tests

import mesh_truth

from tactile_rt.sim_backend.objects.meshes import MeshDetail, load_mesh

MM = 40.0
MESHES = {
    "bracket": mesh_truth.bracket,
    "channel": mesh_truth.channel,
    "gear": mesh_truth.gear,
    "bowl": mesh_truth.bowl,
    "torus": lambda: mesh_truth.torus(14, 6),
    "lump with hollows (5,120 triangles)": lambda: mesh_truth.blob(4),
    "chair of open sheets, remeshed": mesh_truth.sheet_chair,
}


def main() -> None:
    """Cut each, cold and from the cache."""
    rows = [
        "| mesh | triangles | pieces | off by (mm) | cut (CPU s) | again (ms) |",
        "|---|" + "---:|" * 5,
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name, make in MESHES.items():
            path = Path(folder) / "mesh.ply"
            mesh = make()
            mesh.export(path)
            detail = MeshDetail(broken="remesh")
            began = time.process_time()
            thing = load_mesh(path, detail)
            cut = time.process_time() - began
            began = time.process_time()
            load_mesh(path, detail)
            again = 1e3 * (time.process_time() - began)
            rows.append(
                f"| {name} | {len(mesh.faces)} | {len(thing.pieces)} "
                f"| {MM * thing.surface_error:.3f} | {cut:.1f} | {again:.0f} |"
            )
            print("\n".join(rows) if len(rows) == 3 else rows[-1], flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
