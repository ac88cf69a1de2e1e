"""Write what beam theory says of the mouse's whiskers into bench/sim/data.

The benchmarks compare with these figures; the theory itself is in `tests/helpers/beams.py`.
"""

from itertools import product
from pathlib import Path

from bench.sim.beams import GRAVITY, flat
from bench.sim.pegs import PEG_RADIUS_MM
from tactile_rt.sim_backend.arrays.species import mouse_whiskers
from tests.helpers import beams as theory

DATA = Path(__file__).parent / "data"
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
    """A short, a middle and a long whisker on a peg."""
    lines = [
        "# Planar elastica of mouse whiskers pressed by a peg of 1 mm radius: "
        "see bench/sim/pegs.py.",
        "whisker,bend,place,depth,friction,centre_x_mm,centre_y_mm,moment_uNm,force_x_mN,"
        "force_y_mN,contact_x_mm,contact_y_mm",
    ]
    for name, bend, mu, place, depth in product(
        ("E5", "C2", "B0"), BENDS, (0.0, 0.5, -0.5), (0.45, 0.7), (0.05, 0.15)
    ):
        whisker = flat(name, bend)
        where, deep = place * whisker.length, depth * whisker.length
        bent = theory.press(whisker, theory.Peg(BENDS[bend], where, deep, mu, PEG_RADIUS_MM))
        figures = (*bent.centre, bent.moment * 1e3, *(bent.force * 1e3), *bent.contact)
        cells = [name, bend, str(place), str(depth), str(mu), *(f"{x:.8g}" for x in figures)]
        lines.append(",".join(cells))
    (DATA / "elastica.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_beams()
    write_elastica()
