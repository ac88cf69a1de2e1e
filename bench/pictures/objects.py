"""Draw docs/pictures/objects.png: three instances of every category, to see that each is what it
says; and docs/pictures/objects-varied.png: six of each of any plan.

Run: python -m bench.pictures.objects
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from tactile_rt.sim_backend.objects.catalogue import CATEGORIES, VARIED, WITHHELD, make_object
from tactile_rt.sim_backend.views.contact_sheet import draw_object


def sheet(out: Path, kinds: dict[str, str], instances: int, across: int) -> None:
    """Write a contact sheet.

    Args:
        out: the picture.
        kinds: the title of every category.
        instances: of each category.
        across: how many categories stand side by side.
    """
    rows = -(-len(kinds) // across)
    figure = Figure(figsize=(across * instances * 1.3, rows * 1.6), dpi=110)
    panels = figure.subplots(rows, across)
    for panel in panels.flat:
        panel.axis("off")
    for panel, (category, title) in zip(panels.T.flat, kinds.items(), strict=False):
        pictures = [draw_object(make_object(category, i)) for i in range(instances)]
        panel.imshow(np.hstack(pictures), cmap="gray", vmin=0, vmax=1)
        panel.set_title(title, fontsize=13, loc="left")
    figure.tight_layout()
    figure.savefig(out)
    Image.open(out).convert("L").save(out, optimize=True)  # half the size without colour


def main() -> None:
    """Draw both sheets."""
    known = {c: c for c in CATEGORIES}
    sheet(Path("docs/pictures/objects.png"), known | {c: f"{c} (withheld)" for c in WITHHELD}, 3, 4)
    sheet(Path("docs/pictures/objects-varied.png"), {VARIED + c: c for c in CATEGORIES}, 6, 2)


if __name__ == "__main__":
    main()
