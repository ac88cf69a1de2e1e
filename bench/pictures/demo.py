"""Draw docs/pictures/demo.svg: the demonstration's view in the middle of a real, seeded run.

Run: python -m bench.pictures.demo [--model FILE] [--out FILE]
"""

import argparse
import io
from pathlib import Path

import numpy as np
from rich.console import Console

from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.cli.demo import WIDTH, Demonstration, draw

# The moment: so many objects have passed, and the next is so many steps under way and well felt.
OBJECTS, STEP, WHISKERS, FELT_N = 12, 8, 6, 1e-5


def felt(demo: Demonstration) -> int:
    """Whiskers that feel a force worth showing."""
    forces = demo.classifier.deviation[:, :3]  # (element, xyz) N
    return int((np.linalg.norm(forces, axis=1) > FELT_N).sum())


def main(model: Path, out: Path) -> None:
    """Run to the moment, draw it."""
    console = Console(
        record=True,
        width=WIDTH,
        file=io.StringIO(),
        force_terminal=True,
        color_system="truecolor",
        legacy_windows=False,
    )
    with Demonstration(model, sweeps=0, seed=0, fast=True) as demo:
        for _ in demo.run():
            step = demo.decision.step if demo.decision else 0
            if len(demo.outcomes) >= OBJECTS and step >= STEP and felt(demo) >= WHISKERS:
                break
        console.print(draw(demo))
    console.save_svg(str(out), title="tactile-rt demo")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, default=shipped_model())
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/demo.svg"))
    chosen = parser.parse_args()
    main(chosen.model, chosen.out)
