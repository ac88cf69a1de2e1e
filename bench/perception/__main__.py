"""Run the benchmark, and write its page.

python -m bench.perception [--folder FOLDER] [--model FILE.onnx ...] [--folds FOLDER]
                           [--objects FOLDER] [--page FILE] [--quick]

FOLDER (data/realtouch) is where the sweeps of generated objects are, and are made if they are not,
and where networks are trained; quick needs none, and leaves out what does. `--folds` has a model
file for each fold of makers, as `bench.shipped --without` makes them; `--objects` the meshes, for
the bounds of what touch can tell.
"""

import argparse
import sys
from pathlib import Path

from rich.console import Console

from bench.perception.area import FOLDER, measure, records_of
from bench.perception.page import PAGE, write_page
from tactile_rt.core.errors import TactileError
from tactile_rt.models.evaluation.records import show


def main() -> int:
    """Measure, show, and write the page if all was measured."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--model", type=Path, action="append", default=[])
    parser.add_argument("--folds", type=Path)
    parser.add_argument("--objects", type=Path)
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    try:
        results = measure(
            given.quick, given.folder, tuple(given.model), given.folds, given.objects, print
        )
    except TactileError as error:
        print(f"bench.perception: {error}", file=sys.stderr)  # noqa: T201
        return 2
    show(records_of(results), Console())
    if not given.quick:
        write_page(results, given.page)
        print(given.page)  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
