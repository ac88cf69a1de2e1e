"""Measure the physics, draw its pictures and write the tables of docs/physics.md.

python -m bench.pictures.physics              # everything: some 3 minutes of CPU
python -m bench.pictures.physics --json FILE  # the figures of `tactile-rt bench sim --json FILE`
python -m bench.pictures.physics --only peg   # one of bars, whiskers, peg, creep, cost
"""

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from bench.sim import area as sim
from bench.sim.beams import beams, flat, measure
from bench.sim.pegs import PEG_RADIUS_MM, Press, press, press_states, presses
from bench.sim.reference_model import reference_cost
from tactile_rt.sim_backend.world import PROFILES
from tests.helpers import beams as theory

DOCS = Path(__file__).parents[2] / "docs"
INK, BLUE, ORANGE, GREY = "#20262e", "#1f6fb2", "#d95f0e", "#9aa3ad"
BOTH = ("dataset", "realtime")


def write_table(name: str, lines: list[str]) -> None:
    """Replace what stands between the markers of a table in docs/physics.md."""
    path = DOCS / "physics.md"
    text = path.read_text(encoding="utf-8")
    start, end = f"<!-- {name}: written by bench/pictures/physics.py -->", f"<!-- end {name} -->"
    if text.count(start) != 1 or text.count(end) != 1:
        raise SystemExit(f"{path}: wants one {start} and one {end}")
    before, _, rest = text.partition(start)
    after = rest.partition(end)[2]
    path.write_text("\n".join([before + start, *lines, end]) + after, encoding="utf-8")


def bars(records: list[dict[str, Any]]) -> None:
    """All figures that have a bar, and those that say what they are measured against."""
    lines = ["| figure | measured | bar | met | of what |", "|---|---:|---:|:-:|---|"]
    for r in records:
        if ".whisker." in r["name"]:
            continue
        mark = {True: "yes", False: "**no**", None: ""}[r["met"]]
        how = "; ".join(part for part in (r["anchor"], r["how"]) if part).replace("|", "/")
        value = f"{r['value']:.3g} {r['unit']}".strip()
        figure = r["name"].removeprefix("sim.")
        lines.append(f"| {figure} | {value} | {r['bar']} | {mark} | {how} |")
    write_table("bars", lines)


def whiskers() -> None:
    """Both profiles, whisker by whisker."""
    head = ("links", "static %", "resonance %", "rings %", "damping", "sag %")
    lines = [
        "| | mm | Hz | " + " | ".join(f"{h} {p}" for p in BOTH for h in head) + " |",
        "|---" * (3 + 2 * len(head)) + "|",
    ]
    for name, beam in beams().items():
        whisker = flat(name)
        cells = [name, f"{whisker.length:.1f}", f"{beam.resonance_hz:.0f}"]
        for key in BOTH:
            e = measure(whisker, beam, PROFILES[key])
            cells.append(str(PROFILES[key].links(whisker)))
            cells += [f"{100 * x:+.2f}" for x in (e.static, e.resonance, e.ringing)]
            cells += [f"{e.damping:+.3f}", f"{100 * e.sag:+.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    write_table("whiskers", lines)


def peg() -> None:
    """Draw bent whiskers beside the elastica, and the errors of all presses."""
    figure = plt.figure(figsize=(12.6, 8.2), dpi=100)
    grid = figure.add_gridspec(
        2, 3, height_ratios=(1, 0.85), left=0.06, right=0.985, top=0.9, bottom=0.09,
        hspace=0.36, wspace=0.16,
    )  # fmt: skip
    shown = {
        (c.whisker, c.depth): c
        for c in presses()
        if c.bend == "convex" and c.place == 0.45 and c.friction == 0.5
    }
    for column, name in enumerate(("E5", "C2", "B0")):
        axes = figure.add_subplot(grid[0, column])
        draw_bent(axes, [shown[name, depth] for depth in (0.05, 0.15)])
        axes.set_title(f"{name}, {flat(name).length:.1f} mm", fontsize=11)
        axes.set_xlabel("mm")
    figure.axes[1].legend(fontsize=8, loc="upper left", frameon=False)
    draw_errors(figure.add_subplot(grid[1, :]))
    figure.suptitle(
        "Whiskers pressed and slid over a peg: the simulation beside the elastica",
        x=0.012, y=0.965, ha="left", fontsize=15, weight="bold", color=INK,
    )  # fmt: skip
    figure.savefig(DOCS / "physics_peg.png")


def draw_bent(axes: Axes, cases: list[Press]) -> None:
    """One whisker at rest and pressed to two depths."""
    whisker = flat(cases[0].whisker)
    s = np.linspace(0, whisker.length, 100)
    x = np.array([theory.abscissa(whisker, at) for at in s])
    axes.plot(x, whisker.curvature * x**2, color=GREY, lw=1, ls=":", label="at rest")
    for i, case in enumerate(cases):
        found = theory.Peg(case.side, case.place * whisker.length, case.depth * whisker.length,
                           case.friction, PEG_RADIUS_MM)  # fmt: skip
        line = theory.outline(whisker, found, theory.press(whisker, found))
        axes.plot(*line.T, color=BLUE, lw=5, alpha=0.35, label=None if i else "elastica")
        nodes = press_states(case, PROFILES["dataset"])
        axes.plot(*nodes[:, :2].T, color=INK, lw=1, marker="o", ms=2.5,
                  label=None if i else "simulated joints, dataset profile")  # fmt: skip
        above = 0.5 + i / 10
        axes.add_patch(plt.Circle(case.centre, 1.0, fc="#f6d3bd", ec=ORANGE, lw=1, zorder=above))
        force = np.array(case.force) / np.hypot(*case.force) * 0.16 * whisker.length
        axes.annotate("", np.array(case.contact) + force, case.contact,
                      arrowprops={"arrowstyle": "-|>", "color": ORANGE, "lw": 1.5})  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.spines[["top", "right"]].set_visible(False)


def draw_errors(axes: Axes) -> None:
    """Moment errors of every press, by whisker and friction, for both profiles."""
    groups = [(n, mu) for n in ("E5", "C2", "B0") for mu in (0.0, 0.5, -0.5)]
    words = {0.0: "no friction", 0.5: "slides to tip", -0.5: "slides to base"}
    rng = np.random.default_rng(0)
    for shift, key, colour in ((-0.17, "dataset", BLUE), (0.17, "realtime", ORANGE)):
        for at, (name, mu) in enumerate(groups):
            errors = [
                100 * press(c, PROFILES[key]).moment_error
                for c in presses()
                if (c.whisker, c.friction) == (name, mu)
            ]
            where = at + shift + rng.uniform(-0.1, 0.1, len(errors))
            axes.plot(where, errors, "o", ms=4, color=colour, alpha=0.65, mew=0,
                      label=None if at else key)  # fmt: skip
    axes.axhspan(-5, 5, color=GREY, alpha=0.15, lw=0)
    axes.axhline(0, color=INK, lw=0.6)
    axes.set_xticks(range(len(groups)), [f"{n}\n{words[mu]}" for n, mu in groups], fontsize=9)
    axes.set_ylabel("error of the base moment (%)")
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_title("every press; grey: within 5 %, the bar of dataset", fontsize=10, loc="left")
    axes.legend(fontsize=9, frameon=False, loc="upper right", ncols=2)
    axes.spines[["top", "right"]].set_visible(False)


def creep() -> None:
    """Sliding presses at other speeds: friction is Coulomb's only where slip is fast enough."""
    lines = ["| slides at (mm/s) | base moment % | base force % |", "|---:|---:|---:|"]
    cases = [c for c in presses() if c.friction]
    for speed in (30.0, 10.0, 5.0, 2.0, 0.5):
        found = [press(c, PROFILES["dataset"], speed) for c in cases]
        moment = max(abs(p.moment_error) for p in found)
        force = max(p.force_error for p in found)
        lines.append(f"| {speed:g} | {100 * moment:.1f} | {100 * force:.1f} |")
    write_table("creep", lines)


# links per mm, least links, step (ms)
SETTINGS = (
    (0.25, 5, 0.2), (0.5, 8, 0.5), (0.5, 8, 0.2), (0.5, 8, 0.1), (1.0, 8, 0.2),
    (1.0, 8, 0.1),
)  # fmt: skip
COST_MS = 500


def cost() -> None:
    """Draw what errors cost: settings over the prototype's sweep, 0.5 s from before contact."""
    names = ("links_per_mm", "least_links", "timestep_ms")
    others = [replace(PROFILES["dataset"], **dict(zip(names, s, strict=True))) for s in SETTINGS]
    profiles = {key: PROFILES[key] for key in BOTH}
    profiles |= {str(p): p for p in others if p not in profiles.values()}
    settings = {}
    for key, p in profiles.items():
        name = f"{p.links_per_mm:g}/{p.least_links}, {p.timestep_ms:g} ms"
        settings[f"{key}: {name}" if key in BOTH else name] = p
    errors = sim.compare("icosphere", settings, COST_MS)
    rows = []
    for key, profile in settings.items():
        reference = reference_cost(COST_MS)
        simulation = sim.simulate("icosphere", profile)
        share = sim.cost(simulation, COST_MS) / reference
        worst = max(abs(press(c, profile).moment_error) for c in presses() if c.whisker != "E5")
        rows.append((key, share, errors[key], worst))
    lines = [
        "| links per mm / least, step | cost over the reference | moments | forces | spike | "
        "deepest (mm) | peg moment, C2 and B0 (%) |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for key, share, e, worst in rows:
        name = f"**{key}**" if key.startswith(BOTH) else key
        lines.append(
            f"| {name} | {share:.2f} | {e.moment:.3f} | {e.force:.3f} | {e.spike:.1f} | "
            f"{e.deepest:.3f} | {100 * worst:.1f} |"
        )
    write_table("cost", lines)
    figure, axes = plt.subplots(figsize=(8.4, 5.2), dpi=100)
    for label, values, colour in (
        ("base moments", [r[2].moment for r in rows], BLUE),
        ("base forces", [r[2].force for r in rows], ORANGE),
    ):
        named = [r[0].startswith(BOTH) for r in rows]
        axes.scatter([r[1] for r in rows], values, s=[90 if n else 28 for n in named],
                     color=colour, label=label, alpha=0.8, lw=0)  # fmt: skip
    for key, share, e, _ in rows:
        below = key.startswith("dataset")
        axes.annotate(key, (share, e.force), (6, -13) if below else (5, 5), fontsize=8, color=INK,
                      textcoords="offset points",
                      weight="bold" if key.startswith(BOTH) else "normal")  # fmt: skip
    axes.axhline(0.04, color=BLUE, lw=0.8, ls="--")
    axes.axhline(0.05, color=ORANGE, lw=0.8, ls="--")
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = (0.1, 0.2, 0.5, 1, 2, 5)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    heights = (0.01, 0.02, 0.05, 0.1, 0.2)
    axes.set_yticks(heights, [f"{t:g}" for t in heights])
    axes.minorticks_off()
    axes.set_xlabel("cost over the fixed reference model")
    axes.set_ylabel("RMS error over RMS, against 0.05 ms")
    axes.set_title("What accuracy costs (icosphere past 30 whiskers; dashed: bars of `dataset`)",
                   fontsize=10.5, loc="left")  # fmt: skip
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(DOCS / "physics_cost.png")


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="figures of `tactile-rt bench sim --json`")
    parser.add_argument("--only", choices=("bars", "whiskers", "peg", "creep", "cost"))
    options = parser.parse_args()
    wanted = [options.only] if options.only else ["bars", "whiskers", "peg", "creep", "cost"]
    if "bars" in wanted:
        records = (
            json.loads(options.json.read_text(encoding="utf-8"))
            if options.json
            else [{**asdict(r), "met": r.met} for r in sim.run(quick=False)]
        )
        bars(records)
    for part in (whiskers, peg, creep, cost):
        if part.__name__ in wanted:
            part()


if __name__ == "__main__":
    main()
