"""Print the table of docs/objects.md: pieces, distance and time of meshes cut to 0.1 mm at 40 mm.

Beside each, what CoACD (Wei et al. 2022) makes of the same mesh at its finest threshold, measured
in the same way. Needs the package coacd, which no extra brings (pip install coacd).

Run: python -m bench.sim.measure_meshes
"""

import tempfile
import time
from pathlib import Path

import coacd
import trimesh

from tactile_rt.sim_backend.objects.deviation import TriangleSurface, deviation
from tactile_rt.sim_backend.objects.meshes import MeshDetail, load_mesh
from tactile_rt.sim_backend.objects.solids import normalised
from tests.helpers import mesh_truth

MM = 40.0
FINEST = 0.01  # CoACD's smallest threshold
MANY = 2000  # triangles: beyond, it takes a quarter of an hour
MESHES = {
    "bracket": mesh_truth.bracket,
    "channel": mesh_truth.channel,
    "gear": mesh_truth.gear,
    "bowl": mesh_truth.bowl,
    "torus": lambda: mesh_truth.torus(14, 6),
    "lump with hollows": lambda: mesh_truth.blob(4),
    "chair of open sheets, remeshed": mesh_truth.sheet_chair,
}


def main() -> None:
    """Cut each, cold and from the cache."""
    rows = [
        "| mesh | triangles | pieces | off by (mm) | cut (CPU s) | again (ms) "
        "| CoACD: pieces | off by (mm) | cut (CPU s) |",
        "|---|" + "---:|" * 8,
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
                f"| {MM * thing.surface_error:.3f} | {cut:.1f} | {again:.0f} {_coacd(mesh)}|"
            )
            print("\n".join(rows) if len(rows) == 3 else rows[-1], flush=True)  # noqa: T201


def _coacd(mesh: trimesh.Trimesh) -> str:
    """Pieces, distance in mm and CPU seconds, as cells of the table."""
    if not mesh.is_watertight or len(mesh.faces) > MANY:
        return "| | | "
    coacd.set_log_level("error")
    began = time.process_time()
    cut = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), FINEST, preprocess_mode="off")
    took = time.process_time() - began
    pieces = normalised([trimesh.Trimesh(*part).convex_hull for part in cut])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(1 / mesh.extents.max())
    off = deviation(TriangleSurface(mesh.triangles), pieces).largest
    return f"| {len(pieces)} | {MM * off:.3f} | {took:.1f} "


if __name__ == "__main__":
    main()
