"""Draw docs/sweep.png: a mug swept past the whisker array, and what the whiskers feel.

Above, the simulation at two moments, each whisker in the colour of the force on its base, beside
the 5 x 7 map of the same forces. Below, the forces over the whole sweep. MuJoCo renders without a
display through EGL. Run: python bench/plot_sweep.py [--out FILE]
"""

import argparse
import os
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.patches import Rectangle
from PIL import Image

from tactile_rt.sim_backend.array import OBJECT_BIT, PROFILES, WHISKER_BIT
from tactile_rt.sim_backend.objects import make_object
from tactile_rt.sim_backend.sweep import Sweep, SweepSimulation
from tactile_rt.sim_backend.whiskers import mouse_whiskers

Floats = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

TARGET, PROFILE = ("mug", 1), "dataset"
SWEEP = Sweep(size_mm=28, yaw_deg=120)
MOMENTS_MS = (468, 936)
TITLES = ("First its body comes by", "Half a second later, its handle")
AVERAGE_MS = 9  # the network's samples
STRONGEST_MN = 0.15  # top of the colour scale
FELT_MN = 1e-3  # what counts as touched
NAMED = 7  # of the strongest traces
THICKER = 2.6  # whiskers are 0.02-0.1 mm thick: too thin to be seen
SIZE, FINE = (600, 490), 2  # pixels of a snapshot (width, height), drawn finer by a factor
COLOURS = plt.get_cmap("plasma_r")
INK, MUG = "#222222", "#4a6a80"


def colour(millinewton: float) -> tuple[float, float, float, float]:
    """RGBA of a force; grey for none."""
    if millinewton < FELT_MN:
        return 0.62, 0.62, 0.62, 1.0
    r, g, b, a = COLOURS(0.15 + 0.8 * min(millinewton / STRONGEST_MN, 1.0))
    return r, g, b, a


def links(model: mujoco.MjModel) -> list[list[int]]:
    """Geoms of every whisker, base to tip, in the order of the array."""
    found: dict[int, list[int]] = {}
    for geom in np.flatnonzero(model.geom_contype == WHISKER_BIT):
        body = model.geom_bodyid[geom]
        while not model.body(body).name:
            body = model.body_parentid[body]
        found.setdefault(int(body), []).append(int(geom))
    return list(found.values())


def dress(model: mujoco.MjModel) -> None:
    """Make the model fit to be seen: it is not simulated any more."""
    model.geom_size[model.geom_contype == WHISKER_BIT, 0] *= THICKER
    model.geom_rgba[model.geom_contype == OBJECT_BIT] = (0.62, 0.74, 0.82, 1)
    model.vis.global_.offwidth, model.vis.global_.offheight = (FINE * side for side in SIZE)
    model.vis.headlight.ambient[:] = 0.45
    model.vis.headlight.diffuse[:] = 0.5
    model.vis.headlight.specular[:] = 0.0
    model.stat.extent = 60.0


def snapshot(model: mujoco.MjModel, data: mujoco.MjData, forces: Floats) -> Pixels:
    """(height, width, 3) picture of a state; forces (whisker,) in mN."""
    mujoco.mj_kinematics(model, data)
    bases = []
    for geoms, force in zip(links(model), forces, strict=True):
        model.geom_rgba[geoms] = colour(force)
        axis = data.geom_xmat[geoms[0]].reshape(3, 3)[:, 2]
        ends = [data.geom_xpos[geoms[0]] + k * model.geom_size[geoms[0], 1] * axis for k in (-1, 1)]
        bases.append(min(ends, key=lambda end: float(end[0])))
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (8.0, -15.0, -1.6)
    camera.distance, camera.azimuth, camera.elevation = 43.0, 26.0, -27.0
    with mujoco.Renderer(model, FINE * SIZE[1], FINE * SIZE[0]) as renderer:
        renderer.update_scene(data, camera)
        scene = renderer.scene
        for base, force in zip(bases, forces, strict=True):
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom],
                mujoco.mjtGeom.mjGEOM_SPHERE,
                np.full(3, 0.32),
                base,
                np.eye(3).ravel(),
                np.array(colour(force), dtype=np.float32),
            )
            scene.ngeom += 1
        pixels: Pixels = renderer.render()
    pixels[(pixels == 0).all(axis=2)] = 255  # nothing there: paper
    return np.asarray(Image.fromarray(pixels).resize(SIZE, Image.Resampling.LANCZOS))


def draw_map(axes: Axes, forces: Floats) -> None:
    """The array as the network has it: rows A-E, columns 0-6."""
    cells = {(w.row, w.column): f for w, f in zip(mouse_whiskers(), forces, strict=True)}
    for row, column in product(range(5), range(7)):
        if (row, column) in cells:
            force = cells[row, column]
            face = colour(force) if force >= FELT_MN else "#f2f2f2"
            axes.add_patch(Rectangle((column - 0.47, row - 0.47), 0.94, 0.94, facecolor=face))
            dark = force > 0.5 * STRONGEST_MN
            axes.text(
                column,
                row,
                "ABCDE"[row] + str(column),
                ha="center",
                va="center",
                fontsize=8,
                color="white" if dark else INK if force >= FELT_MN else "0.6",
            )
    axes.text(3, -0.75, "force on each base", ha="center", fontsize=9, color=INK)
    axes.text(3, 4.85, "← towards the nose", ha="center", fontsize=8, color="0.45")
    axes.text(-0.75, 2, "towards the chin →", va="center", ha="center", rotation=-90, fontsize=8,
              color="0.45")  # fmt: skip
    axes.set_xlim(6.6, -1)  # column 0, nearest the ear, on the right as in the snapshots
    axes.set_ylim(5.2, -1.1)
    axes.set_aspect("equal")
    axes.axis("off")


def draw_traces(axes: Axes, forces: Floats) -> None:
    """Force (sample, whisker) in mN of every whisker that is touched."""
    names = [w.name for w in mouse_whiskers()]
    times = (np.arange(len(forces)) + 0.5) * AVERAGE_MS
    peaks = forces.max(axis=0)
    taken: list[tuple[float, float]] = []
    for rank, i in enumerate(np.argsort(-peaks)):
        if peaks[i] < FELT_MN:
            continue
        hue = plt.get_cmap("tab10")(rank) if rank < NAMED else (0.7, 0.7, 0.7, 1.0)
        axes.plot(times, forces[:, i], color=hue, lw=1.6 if rank < NAMED else 0.8, zorder=-rank)
        if rank < NAMED:
            top = int(forces[:, i].argmax())
            at = (float(times[top]), float(peaks[i]) + 0.004)
            while any(abs(at[0] - x) < 40 and abs(at[1] - y) < 0.015 for x, y in taken):
                at = (at[0], at[1] + 0.004)
            taken.append(at)
            axes.text(
                *at,
                names[i],
                color=hue,
                ha="center",
                fontsize=9.5,
                weight="bold",
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
            )
    axes.set_xlim(0, times[-1])
    axes.set_ylim(0, max(y for _, y in taken) + 0.03)
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("force on the base (mN)")
    axes.spines[["top", "right"]].set_visible(False)


def draw(out: Path) -> None:
    """Simulate the sweep and write the picture."""
    whiskers = mouse_whiskers()
    simulation = SweepSimulation(whiskers, make_object(*TARGET), SWEEP, PROFILES[PROFILE])
    states, loads = [], []
    for piece in simulation.loads(samples_at_once=AVERAGE_MS):
        loads.append(piece.mean(axis=0))
        if len(loads) * AVERAGE_MS in MOMENTS_MS:
            states.append((simulation.data.qpos.copy(), simulation.data.mocap_pos.copy()))
    forces = 1e3 * np.linalg.norm(np.array(loads)[..., :3], axis=2)  # (sample, whisker) mN
    dress(simulation.model)

    figure = plt.figure(figsize=(12.6, 8.0), dpi=100)
    scenes = figure.add_gridspec(
        1, 4, width_ratios=(1.62, 1, 1.62, 1), left=0.01, right=0.995, top=0.905, bottom=0.5,
        wspace=0.0,
    )  # fmt: skip
    traces = figure.add_axes((0.06, 0.07, 0.87, 0.38))
    draw_traces(traces, forces)
    for k, (moment, (pose, place)) in enumerate(zip(MOMENTS_MS, states, strict=True)):
        felt = forces[moment // AVERAGE_MS - 1]
        data = mujoco.MjData(simulation.model)
        data.qpos[:], data.mocap_pos[:] = pose, place
        scene = figure.add_subplot(scenes[2 * k])
        scene.imshow(snapshot(simulation.model, data, felt))
        scene.axis("off")
        scene.set_title(f" {'①②'[k]}  {TITLES[k]}", loc="left", fontsize=12, y=1.0)
        arrow = {"arrowstyle": "-|>,head_width=0.4,head_length=0.7", "lw": 2.5, "color": MUG}
        scene.annotate("", (0.99, 0.03), (0.76, 0.03), "axes fraction", arrowprops=arrow)
        words: dict[str, Any] = {
            "transform": scene.transAxes,
            "va": "center",
            "ha": "right",
            "fontsize": 9.5,
        }
        scene.text(0.75, 0.03, "the mug moves", color=MUG, **words)
        scene.text(0.36, 0.16, "bases on the cheek", color="0.4", **words)
        draw_map(figure.add_subplot(scenes[2 * k + 1]), felt)
        traces.axvline(moment, color=INK, lw=1, ls="--", zorder=-50)
        traces.text(moment + 6, traces.get_ylim()[1], "①②"[k], va="top", fontsize=14)
    colours = ListedColormap([colour(f) for f in np.linspace(FELT_MN, STRONGEST_MN, 64)])
    bar = figure.colorbar(
        ScalarMappable(Normalize(0, STRONGEST_MN), colours),
        cax=figure.add_axes((0.95, 0.09, 0.012, 0.3)),
        extend="max",
    )
    bar.set_ticks([0, 0.05, 0.1, 0.15])
    bar.ax.set_title("mN", fontsize=9)
    touched = int((forces.max(axis=0) >= FELT_MN).sum())
    figure.text(
        0.012, 0.962, f"A mug sweeps past 30 simulated mouse whiskers and bends {touched} of them",
        fontsize=15, weight="bold",
    )  # fmt: skip
    figure.savefig(out)
    Image.open(out).convert("RGB").quantize(256).save(out, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/sweep.png"))
    draw(parser.parse_args().out)
