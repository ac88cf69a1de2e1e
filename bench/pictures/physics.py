"""Measure the physics and draw its pictures, for docs/explain/physics.md.

python -m bench.pictures.physics              # everything: some 3 minutes of CPU
python -m bench.pictures.physics --json FILE  # the figures of `tactile-rt bench sim --json FILE`
python -m bench.pictures.physics --only peg   # one of bars, whiskers, peg, creep, cost

All figures are in docs/explain/physics.json; the page has tables of some of them.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from bench.pages.benchmarks import HEADLINES, bar_table
from bench.sim import area as sim
from bench.sim.beams import beams, flat, measure
from bench.sim.catalogue import FINE, difference
from bench.sim.mechanics import HEARD_HZ
from bench.sim.pegs import PEG_RADIUS_MM, Press, press, press_states, presses
from bench.sim.reference_model import reference_cost
from bench.sim.ringing import release_error, rod_ring
from tactile_rt.models.evaluation.records import Record, as_dicts
from tactile_rt.sim_backend.rods.rod import make_rod
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, Profile
from tests.helpers import beams as theory

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "explain" / "physics.md"
DATA = PAGE.with_suffix(".json")
INK, BLUE, ORANGE, GREY = "#20262e", "#1f6fb2", "#d95f0e", "#9aa3ad"
BOTH = ("dataset", "realtime")


def keep(name: str, found: Any) -> None:
    """Write what was measured into the data, and the tables of the page anew."""
    data = {**json.loads(DATA.read_text("utf-8")), name: found}
    DATA.write_text(json.dumps(data, indent=1) + "\n", "utf-8")
    text = PAGE.read_text("utf-8")
    for table, lines in tables(data).items():
        start, end = (
            f"<!-- {table}: written by bench/pictures/physics.py -->",
            f"<!-- end {table} -->",
        )
        if text.count(start) != 1 or text.count(end) != 1:
            raise SystemExit(f"{PAGE}: wants one {start} and one {end}")
        before, _, rest = text.partition(start)
        text = "\n".join([before + start, *lines, end]) + rest.partition(end)[2]
    PAGE.write_text(text, "utf-8")


def tables(data: dict[str, Any]) -> dict[str, list[str]]:
    """The tables of the page: headlines and missed bars, and what accuracy costs."""
    records = [Record(**{k: v for k, v in one.items() if k != "met"}) for one in data["bars"]]
    columns, rows = data["cost"]["columns"], data["cost"]["rows"]
    return {
        "bars": bar_table(records, HEADLINES["sim"]),
        "cost": [
            f"| {' | '.join(columns)} |",
            "|---" + "|---:" * (len(columns) - 1) + "|",
            *(f"| {' | '.join(map(str, row))} |" for row in rows),
        ],
    }


def whiskers() -> None:
    """Both profiles, whisker by whisker."""
    head = ("static %", "resonance %", "rings %", "damping", "let go %", "sag %")
    columns = ["whisker", "mm", "Hz", *(f"{h} {p}" for p in BOTH for h in head)]
    rows = []
    for name, beam in beams().items():
        whisker = flat(name)
        cells = [name, round(whisker.length, 1), round(beam.resonance_hz)]
        for key in BOTH:
            profile = PROFILES[key]
            e = measure(whisker, beam, profile)
            rings: list[float | None] = [None, None, None]
            if beam.resonance_hz < HEARD_HZ:
                hertz, ratio = rod_ring(whisker, profile)
                let_go = round(100 * release_error(whisker, profile), 1)
                rings = [round(100 * (hertz / beam.resonance_hz - 1), 2), 0.0, let_go]
            else:
                rod = make_rod(whisker, profile.links, round(SAMPLE_MS / profile.timestep_ms))
                ratio = rod.damping_ratio
            rings[1] = round(ratio - whisker.damping_ratio, 3)
            cells += [round(100 * e.static, 2), round(100 * e.resonance, 2), *rings]
            cells.append(round(100 * e.sag, 2))
        rows.append(cells)
    keep("whiskers", {"columns": columns, "rows": rows})


def peg() -> None:
    """Draw bent whiskers beside the elastica, and the errors of all presses by their depth."""
    figure = plt.figure(figsize=(12.6, 8.2), dpi=100)
    grid = figure.add_gridspec(
        2, 3, height_ratios=(1, 0.85), left=0.06, right=0.985, top=0.9, bottom=0.09,
        hspace=0.36, wspace=0.16,
    )  # fmt: skip
    for column, name in enumerate(("mouse E5", "mouse C2", "mouse B0")):
        axes = figure.add_subplot(grid[0, column])
        cases = [
            c
            for c in presses()
            if (c.whisker, c.bend, c.place, c.friction) == (name, "convex", 0.6, 0.5)
        ]
        draw_bent(axes, cases[-2:])
        axes.set_title(f"{name}, {flat(name).length:.1f} mm", fontsize=11)
        axes.set_xlabel("mm")
    figure.axes[1].legend(fontsize=8, loc="upper left", frameon=False)
    draw_errors(figure.add_subplot(grid[1, :]))
    figure.suptitle(
        "Whiskers pressed and slid over a peg: the simulation beside the elastica",
        x=0.012, y=0.965, ha="left", fontsize=15, weight="bold", color=INK,
    )  # fmt: skip
    figure.savefig(DOCS / "pictures" / "physics_peg.png")


def draw_bent(axes: Axes, cases: list[Press]) -> None:
    """One whisker at rest and pressed to two depths."""
    whisker = flat(cases[0].whisker)
    s = np.linspace(0, whisker.length, 100)
    x = np.array([theory.abscissa(whisker, at) for at in s])
    axes.plot(x, whisker.curvature * x**2, color=GREY, lw=1, ls=":", label="at rest")
    for i, case in enumerate(cases):
        found = theory.Peg(case.side, case.place * whisker.length, case.depth, case.friction,
                           PEG_RADIUS_MM)  # fmt: skip
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


DEPTHS = (("0.02 mm", 0.0, 0.03), ("0.05 mm", 0.04, 0.06), ("0.1 mm", 0.09, 0.11),
          ("to L / 10", 0.11, np.inf))  # fmt: skip


def draw_errors(axes: Axes) -> None:
    """Moment errors of every seventh press, by depth, for four profiles."""
    rng = np.random.default_rng(0)
    keys = (("accurate", GREY), ("dataset", BLUE), ("realtime", ORANGE), ("mujoco", INK))
    cases = presses()[::7]
    for i, (key, colour) in enumerate(keys):
        found = [(c.depth, 100 * abs(press(c, PROFILES[key]).moment_error)) for c in cases]
        for at, (_, least, most) in enumerate(DEPTHS):
            errors = [e for depth, e in found if least < depth < most]
            where = at + 0.22 * (i - 1.5) + rng.uniform(-0.07, 0.07, len(errors))
            axes.plot(where, np.maximum(errors, 0.01), "o", ms=3, color=colour, alpha=0.55, mew=0,
                      label=None if at else key)  # fmt: skip
    axes.axhspan(0.01, 5, color=GREY, alpha=0.15, lw=0)
    axes.set_yscale("log")
    axes.set_yticks((0.01, 0.1, 1, 5, 10, 100), ("0.01", "0.1", "1", "5", "10", "100"))
    axes.minorticks_off()
    axes.set_xticks(range(len(DEPTHS)), [f"pressed {name}" for name, _, _ in DEPTHS], fontsize=9)
    axes.set_ylabel("error of the base moment (%)")
    axes.set_title("every seventh press of all mouse whiskers and of a robot's; grey: within 5 %",
                   fontsize=10, loc="left")  # fmt: skip
    axes.legend(fontsize=9, frameon=False, loc="upper right", ncols=4)
    axes.spines[["top", "right"]].set_visible(False)


def creep() -> None:
    """Sliding presses at other speeds."""
    rows = []
    cases = [c for c in presses() if c.friction][::40]
    for speed in (30.0, 10.0, 5.0, 2.0, 0.5):
        found = [press(c, PROFILES["dataset"], speed) for c in cases]
        moment = max(abs(p.moment_error) for p in found)
        force = max(p.force_error for p in found)
        rows.append([speed, round(100 * moment, 1), round(100 * force, 1)])
    keep("creep", {"columns": ["slides at (mm/s)", "base moment %", "base force %"], "rows": rows})


SETTINGS = ((7, 0.5), (10, 0.25), (15, 0.25), (20, 0.1))  # links, step (ms)
COST_MS = 500
COST_COLUMNS = ("links, step", "CPU s per s", "over the reference", "moments, median",
                "moments, worst", "forces, median", "forces, worst")  # fmt: skip


def cost() -> None:
    """Draw what errors cost: settings over the four sweeps that costs are measured on."""
    profiles = {f"{n} links, {step:g} ms": Profile(n, step, 0.02) for n, step in SETTINGS}
    profiles["MuJoCo, 10 links, 0.25 ms"] = PROFILES["mujoco"]
    truths = {name: sim.simulate(name, FINE).advance(COST_MS) for name in sim.SWEEPS}
    rows = []
    figure, axes = plt.subplots(figsize=(8.4, 5.2), dpi=100)
    for key, profile in profiles.items():
        costs, errors, shares = [], [], []
        for name, truth in truths.items():
            reference = reference_cost(COST_MS)
            costs.append(sim.cost(sim.simulate(name, profile), COST_MS))
            shares.append(costs[-1] / reference)
            errors.append(difference(sim.simulate(name, profile).advance(COST_MS), truth))
        moments, forces = [e.moment for e in errors], [e.force for e in errors]
        errors_of = [f(v) for v in (moments, forces) for f in (np.median, max)]
        spent = [round(float(np.median(v)), 2) for v in (costs, shares)]
        rows.append([key, *spent, *(round(float(e), 3) for e in errors_of)])
        share, colour = float(np.median(shares)), ORANGE if "MuJoCo" in key else BLUE
        axes.plot([share] * len(moments), moments, "-", color=colour, alpha=0.3)
        axes.plot([share] * len(moments), moments, "o", ms=6, color=colour, alpha=0.8)
        axes.annotate(key, (share, max(moments)), (0, 7), fontsize=8, color=INK,
                      textcoords="offset points", ha="center")  # fmt: skip
    keep("cost", {"columns": list(COST_COLUMNS), "rows": rows})
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(0.15, 2)
    axes.set_xticks((0.25, 0.5, 1, 2), ("0.25", "0.5", "1", "2"))
    axes.set_yticks((0.001, 0.01, 0.1), ("0.1 %", "1 %", "10 %"))
    axes.minorticks_off()
    axes.set_xlabel("cost over the fixed reference model (median of four sweeps)")
    axes.set_ylabel("base moments: RMS error over RMS")
    axes.set_title("What accuracy costs: an icosphere, a mug, a chair and a gear, against 0.05 ms",
                   fontsize=10.5, loc="left")  # fmt: skip
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(DOCS / "pictures" / "physics_cost.png")


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="figures of `tactile-rt bench sim --json`")
    parser.add_argument("--only", choices=("bars", "whiskers", "peg", "creep", "cost"))
    options = parser.parse_args()
    wanted = [options.only] if options.only else ["bars", "whiskers", "peg", "creep", "cost"]
    if "bars" in wanted:
        given = options.json
        keep("bars", json.loads(given.read_text()) if given else as_dicts(sim.run(quick=False)))
    for part in (whiskers, peg, creep, cost):
        if part.__name__ in wanted:
            part()


if __name__ == "__main__":
    main()
