"""Write what beam theory says of the mouse's whiskers into bench/sim/data.

The benchmarks compare with these figures; the theory itself is in `tests/helpers/beams.py`.
"""

import gzip
from itertools import product
from pathlib import Path

from bench.sim.beams import ARRAYS, GRAVITY, flat
from bench.sim.pegs import PEG_RADIUS_MM
from tactile_rt.sim_backend.arrays.files import load_array, mouse_whiskers
from tests.helpers import beams as theory

DATA = Path(__file__).parent / "data"
LIGHT_MM, DEPTHS = (0.02, 0.05, 0.1), (0.025, 0.05, 0.1)  # these in shares of the length
BENDS = {"straight": 1, "convex": -1, "concave": 1}  # and the side that the peg comes from


def write_beams() -> None:
    """Compliance, first resonance and sag of every whisker."""
    lines = [
        "# Euler-Bernoulli beams of the mouse's whiskers: see bench/sim/beams.py.",
        "whisker,compliance_mm_per_N,resonance_hz,sag_mm",
    ]
    for w in mouse_whiskers():
        figures = theory.compliance(w, 1), theory.resonance(w), theory.sag(w, GRAVITY * 1e6)
        lines.append(",".join([w.name, *(f"{x:.8g}" for x in figures)]))
    (DATA / "beams.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_elastica() -> None:
    """Every whisker of the mouse and of the example arrays on a peg: half an hour."""
    lines = [
        "# Planar elastica of whiskers pressed by a peg of 1 mm radius: see bench/sim/pegs.py.",
        "whisker,bend,place,depth_mm,friction,centre_x_mm,centre_y_mm,moment_uNm,force_x_mN,"
        "force_y_mN,contact_x_mm,contact_y_mm,arc_mm",
    ]
    names = [f"mouse {w.name}" for w in mouse_whiskers()]
    for array in ("robot", "long"):
        names += [f"{array} {w.name}" for w in load_array(str(ARRAYS / f"{array}.toml")).whiskers]
    for name, bend, place, mu in product(names, BENDS, (0.4, 0.6, 0.8), (0.0, 0.5, -0.5)):
        whisker = flat(name, bend)
        if bend != "straight" and not whisker.curvature:
            continue
        deeper = (share * whisker.length for share in DEPTHS)
        for depth in (*LIGHT_MM, *(d for d in deeper if d > LIGHT_MM[-1])):
            peg = theory.Peg(BENDS[bend], place * whisker.length, depth, mu, PEG_RADIUS_MM)
            bent = theory.press(whisker, peg)
            figures = (*bent.centre, bent.moment * 1e3, *(bent.force * 1e3), *bent.contact, bent.s)
            cells = [name, bend, str(place), f"{depth:.6g}", str(mu)]
            lines.append(",".join([*cells, *(f"{x:.8g}" for x in figures)]))
    text = "\n".join(lines) + "\n"
    (DATA / "elastica.csv.gz").write_bytes(gzip.compress(text.encode(), mtime=0))


if __name__ == "__main__":
    write_beams()
    write_elastica()
