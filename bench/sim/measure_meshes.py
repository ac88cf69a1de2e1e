"""How meshes load that others made: how many, how fast, how near.

Of each folder so many mesh files are drawn by a seed. A mesh counts as loaded if its surface lies
within 0.2 mm of the pieces' at the median and within 1 mm at worst, at 40 mm, measured here from
random points of the mesh to random points of the pieces and the triangles that these lie on, and
not by what the package says of itself. Nothing is read from the cache.

Run: python -m bench.sim.measure_meshes FOLDER... [--count 40] [--seed 0] [--each]
"""

import argparse
import os
import random
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.objects.mesh_detail import SIZE_MM
from tactile_rt.sim_backend.objects.mesh_files import MESH_SUFFIXES, read_triangles
from tactile_rt.sim_backend.objects.meshes import load_mesh
from tactile_rt.sim_backend.objects.solids import TactileObject

POINTS, SAMPLES, LEAST, NEAREST = 3000, 60_000, 30, 12
MEDIAN_MM, WORST_MM = 0.2, 1.0


@dataclass(frozen=True)
class LoadedMesh:
    """What became of a file: CPU seconds, pieces, median and largest distance in mm; or why not."""

    path: Path
    cpu_s: float
    pieces: int = 0
    median_mm: float = np.inf
    worst_mm: float = np.inf
    reason: str = ""

    @property
    def well(self) -> bool:
        """Whether it counts as loaded."""
        return self.median_mm <= MEDIAN_MM and self.worst_mm <= WORST_MM


def main() -> None:
    """Load a sample of each folder's meshes and print a line for each folder."""
    parser = argparse.ArgumentParser(prog="python -m bench.sim.measure_meshes")
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--each", action="store_true", help="print a line for every file")
    asked = parser.parse_args()
    print("| folder | meshes | loaded | CPU s: median | worst | pieces: median |")  # noqa: T201
    print("|---|---:|---:|---:|---:|---:|")  # noqa: T201
    with tempfile.TemporaryDirectory() as cache:
        os.environ["TACTILE_RT_CACHE"] = cache
        for folder in asked.folders:
            found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in MESH_SUFFIXES)
            drawn = random.Random(asked.seed).sample(found, min(asked.count, len(found)))
            every = [_load(path, asked.each) for path in drawn]
            times = [one.cpu_s for one in every]
            well = sum(one.well for one in every)
            print(  # noqa: T201
                f"| {folder.name} | {len(every)} of {len(found)} | {well} "
                f"({100 * well / max(len(every), 1):.0f} %) "
                f"| {np.median(times):.2f} | {max(times):.1f} "
                f"| {np.median([one.pieces for one in every]):.0f} |",
                flush=True,
            )


def _load(path: Path, told: bool) -> LoadedMesh:
    began = time.process_time()
    try:
        thing = load_mesh(path)
        one = LoadedMesh(
            path, time.process_time() - began, len(thing.pieces), *_distances(path, thing)
        )
    except ConfigError as error:
        one = LoadedMesh(path, time.process_time() - began, reason=str(error))
    if told or not one.well:
        what = one.reason or f"{one.pieces} pieces, {one.median_mm:.3f}, {one.worst_mm:.3f} mm"
        print(f"  {path.parent.name}/{path.name}: {one.cpu_s:.1f} s, {what}", flush=True)  # noqa: T201
    return one


def _distances(path: Path, thing: TactileObject) -> tuple[float, float]:
    """Median and largest distance from the mesh to the pieces, mm."""
    points, _ = trimesh.sample.sample_surface(read_triangles(path), POINTS, seed=1)
    area = sum(piece.area for piece in thing.pieces)
    samples, triangles = [], []
    for k, piece in enumerate(thing.pieces):
        number = max(LEAST, int(SAMPLES * piece.area / area))
        some, faces = trimesh.sample.sample_surface(piece, number, seed=k)
        samples.append(some)
        triangles.append(piece.triangles[faces])
    on = np.concatenate(triangles)
    best = np.full(len(points), np.inf)
    for near in cKDTree(np.concatenate(samples)).query(points, k=NEAREST)[1].T:
        nearest = trimesh.triangles.closest_point(on[near], points)
        best = np.minimum(best, np.linalg.norm(nearest - points, axis=1))
    return SIZE_MM * float(np.median(best)), SIZE_MM * float(best.max())


if __name__ == "__main__":
    main()
