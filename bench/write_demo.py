"""Write the recording that `tactile-rt demo` plays where nothing can be simulated.

python -m bench.write_demo [OUTPUT]

Objects that the shipped model never saw, drawn by a seed named here and not chosen, sweep past the
mouse's whiskers; readings are rounded to a sensor's resolution, so that the file is small.
"""

import sys
from pathlib import Path

from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.recording import StreamWriter
from tactile_rt.recording.replay import DEMO
from tactile_rt.sim_backend.source import SimOptions, SimSource

SEED, OBJECTS = 2026, 6
RESOLUTION = {"resolution_force": 1e-6, "resolution_moment": 5e-9}  # N and N m


def main(output: Path) -> None:
    """Sweep, and record."""
    _, card = load_model(shipped_model())
    options = SimOptions(
        objects=",".join(card.provenance["unseen_objects"]),
        sweeps=OBJECTS, seed=SEED, pace="fast", **RESOLUTION,
    )  # fmt: skip
    source = SimSource("mouse", options)
    chunks = list(source)
    passes = {
        f"pass_{i}": f"{p.start_ns} {p.name} {p.category}" for i, p in enumerate(source.passes)
    }
    with StreamWriter(output, source, url="sim:mouse", session=passes, force=True) as writer:
        for chunk in chunks:
            if chunk is not None:
                writer.push(chunk)
    print(f"{output}: {output.stat().st_size / 1e3:.0f} kB, {len(passes)} objects")  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DEMO)
