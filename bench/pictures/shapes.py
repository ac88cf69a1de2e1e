"""Draw docs/pictures/shapes.png: twelve objects of every shape of the list `real2`.

Run: tactile-rt objects get real2 FOLDER; python -m bench.pictures.shapes FOLDER
"""

import argparse
import zlib
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image, ImageDraw

from bench.sim.list_shapes import SEED, SHAPES, draw
from tactile_rt.sim_backend.objects.mesh_files import read_triangles
from tactile_rt.sim_backend.objects.object_lists import read_list

OUT = Path("docs/pictures/shapes.png")
EACH, PIXELS, FINE, POINTS = 12, 100, 2, 600_000
TITLE = 80  # pixels for the name of a shape


def main() -> None:
    """Draw objects that are drawn at random of every shape, of all makers in turn."""
    parser = argparse.ArgumentParser(prog="python -m bench.pictures.shapes")
    parser.add_argument("folder", type=Path, help="that `objects get real2` wrote")
    folder = parser.parse_args().folder
    sheet = Image.new("L", (TITLE + EACH * PIXELS, len(SHAPES) * PIXELS), 255)
    pen = ImageDraw.Draw(sheet)
    listed = [thing.files[0] for thing in read_list("real2")]
    for row, shape in enumerate(SHAPES):
        generator = np.random.default_rng([SEED, zlib.crc32(shape.encode())])
        turns: dict[str, int] = {}
        order: list[tuple[int, int, str]] = []
        for k in generator.permutation([i for i, f in enumerate(listed) if f.category == shape]):
            turns[listed[k].maker] = turns.get(listed[k].maker, 0) + 1
            order.append((turns[listed[k].maker], len(order), listed[k].name))
        pen.text((4, row * PIXELS + PIXELS // 2 - 8), shape, fill=0, font_size=16)
        for column, (_, _, name) in enumerate(sorted(order)[:EACH]):
            mesh = read_triangles(folder / shape / f"{name}.ply")
            points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=SEED)
            picture = draw(points, mesh.face_normals[faces], -60, 25, PIXELS * FINE)
            small = Image.fromarray(picture).resize((PIXELS, PIXELS), Image.Resampling.BOX)
            sheet.paste(small, (TITLE + column * PIXELS, row * PIXELS))
    sheet.save(OUT, optimize=True)


if __name__ == "__main__":
    main()
