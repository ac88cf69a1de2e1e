"""Draw docs/pictures/sweep.png: a mug swept past the whisker array, and what the whiskers feel.

Above, the simulation at two moments, each whisker in the colour of the force on its base, beside
the 5 x 7 map of the same forces. Below, the forces over the whole sweep.
Run: python -m bench.pictures.sweep [--out FILE]
"""

import argparse
from contextlib import closing
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.objects.catalogue import make_object
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.views.film import Stage
from tactile_rt.sim_backend.views.footage import Camera, record
from tactile_rt.sim_backend.views.sheet import (
    INK,
    QUIET,
    ForceMap,
    ForceScale,
    draw_scale,
    draw_traces,
)
from tactile_rt.sim_backend.world import PROFILES, array_spec

TARGET, PROFILE = ("mug", 1), "dataset"
SWEEP = Sweep(size_mm=28, yaw_deg=120)
MOMENTS_MS = (468, 936)
TITLES = ("First its body comes by", "Half a second later, its handle")
AVERAGE_MS = 9  # the network's samples
CAMERA = Camera(26.0, -27.0, (8.0, -15.0, -1.6), 34.0)
SCALE = ForceScale(0.2, 5.0)
SIZE = (600, 490)  # pixels of a snapshot
FELT_MN = 1e-3  # what counts as touched
MUG = "#4a6a80"


def draw(out: Path) -> None:
    """Simulate the sweep and write the picture."""
    array = load_array("mouse")
    simulation = SweepSimulation(array, make_object(*TARGET), SWEEP, PROFILES[PROFILE], whole=True)
    footage = record(simulation, array_spec(array.whiskers, array.name), AVERAGE_MS)
    forces = 1e3 * footage.sizes  # (frame, whisker) mN

    figure = Figure(figsize=(12.6, 8.0), dpi=100)
    FigureCanvasAgg(figure)
    traces = figure.add_axes((0.06, 0.07, 0.92, 0.38))
    draw_traces(traces, footage.times_ms, forces, footage.spec.elements)
    with closing(Stage(footage, CAMERA, SCALE, *SIZE)) as stage:
        for k, moment in enumerate(MOMENTS_MS):
            number, left, frame = "①②"[k], 0.01 + 0.5 * k, footage.at(moment)
            scene = figure.add_axes((left, 0.5, 0.29, 0.37))
            scene.imshow(stage.picture(frame))
            scene.axis("off")
            figure.text(left, 0.89, f" {number}  {TITLES[k]}", fontsize=12, color=INK)
            arrow = {"arrowstyle": "-|>,head_width=0.4,head_length=0.7", "lw": 2.5, "color": MUG}
            scene.annotate("", (0.99, 0.03), (0.76, 0.03), "axes fraction", arrowprops=arrow)
            right = left + 0.29
            figure.text(right - 0.075, 0.511, "the mug moves", color=MUG, va="center", ha="right")
            figure.text(left + 0.105, 0.54, "bases on the cheek", color=QUIET, ha="right")
            place = (right + 0.005, 0.56, 0.195, 0.26)
            force_map = ForceMap(figure, place, footage.spec, SCALE, True)
            force_map.show(footage.loads[frame], footage.sizes[frame])
            figure.text(right + 0.1, 0.835, "force on each base", ha="center", color=INK)
            draw_scale(figure, (right + 0.04, 0.535, 0.12, 0.012), SCALE)
            traces.axvline(moment, color=INK, lw=1, ls="--", zorder=1)
            traces.text(moment + 6, traces.get_ylim()[1], number, va="top", fontsize=14)
    touched = int((forces.max(axis=0) >= FELT_MN).sum())
    title = f"A mug sweeps past {len(array.whiskers)} simulated mouse whiskers and bends {touched}"
    figure.text(0.012, 0.955, f"{title} of them", fontsize=15, weight="bold", color=INK)
    small = (
        f"arrows: force on a base, {SCALE.arrow_mm:g} mm for {SCALE.top:g} mN, and in the map "
        "its direction along the cheek; whiskers are drawn thicker than they are"
    )
    figure.text(0.012, 0.928, small, fontsize=9.5, color=QUIET)
    figure.savefig(out)
    Image.open(out).convert("RGB").quantize(256).save(out, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/sweep.png"))
    draw(parser.parse_args().out)
