"""A picture of what came in by an import: each channel over time, and what is odd about it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import NS_PER_S, concatenate

if TYPE_CHECKING:
    from tactile_rt.recording.importing.mending import Import

KINDS: Final = (".png", ".svg", ".pdf")
ROWS, NAMED, NOTES = 12, 8, 4  # channels, elements in the legend, notes that are shown
BINS, PAUSE = 2000, 5  # stretches of time, each drawn by its extremes; typical steps


def check_picture(out: Path) -> None:
    """Refuse a picture that cannot be drawn, before anything is read."""
    if out.suffix.lower() not in KINDS:
        raise ConfigError(f"{out} is no picture: give --plot a {', '.join(KINDS)}")
    import matplotlib  # noqa: F401


def draw_import(path: Path, made: "Import", odd: Sequence[str], out: Path) -> None:
    """Draw the samples of a recording that was imported."""
    from matplotlib.figure import Figure

    from tactile_rt.recording import Recording

    stored = Recording(path)
    spec, chunk = stored.spec, concatenate(list(stored))
    t_s = chunk.t_ns / NS_PER_S
    values = np.where(chunk.valid[..., None], chunk.values, np.nan)
    steps = np.diff(t_s)
    usual = float(np.median(steps)) if len(steps) else 1.0
    lost = np.flatnonzero((np.diff(chunk.seq) > 1) | (steps > PAUSE * usual))
    bad = np.concatenate([[False], ~chunk.valid.all(axis=1), [False]])
    turns = np.flatnonzero(np.diff(bad)).reshape(-1, 2)  # where a stretch begins and ends
    marks = {
        "invalid": ("tab:red", [(t_s[a], t_s[b - 1] + usual - t_s[a]) for a, b in turns.tolist()]),
        "missing": ("tab:orange", [(t_s[k], t_s[k + 1] - t_s[k]) for k in lost.tolist()]),
    }
    rows = spec.channels[:ROWS]
    figure = Figure((10, 1.4 + 1.5 * len(rows)), layout="constrained")
    axes: Any = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    edges = np.unique(np.linspace(0, len(t_s) - 1, min(BINS, len(t_s))).astype(int))
    at = np.repeat(t_s[edges], 2)
    for c, axis in enumerate(axes):
        for e, name in enumerate(spec.elements):
            both = [f.reduceat(values[:, e, c], edges) for f in (np.fmin, np.fmax)]
            axis.plot(at, np.stack(both, 1).ravel(), lw=0.8, marker=".", ms=2, label=name)
        for what, (color, spans) in marks.items():
            if spans:
                whole = {"transform": axis.get_xaxis_transform(), "alpha": 0.3, "label": what}
                axis.broken_barh(spans, (0, 1), color=color, **whole)
        axis.set_ylabel(f"{spec.channels[c]} [{spec.units[c]}]")
        axis.grid(alpha=0.3)
    labels = dict(zip(*axes[0].get_legend_handles_labels()[::-1], strict=True))
    shown = [n for n in (*spec.elements[:NAMED], "invalid", "missing") if n in labels]
    axes[0].legend([labels[n] for n in shown], shown, loc="upper right", fontsize="small", ncols=5)
    rest = ((len(odd) - NOTES, "notes"), (len(spec.channels) - ROWS, "channels"))
    notes = [*odd[:NOTES], *(f"and {n} {what} more" for n, what in rest if n > 0)]
    axes[-1].set_xlabel("\n".join(["time [s]", *notes]), parse_math=False)
    figure.suptitle(f"{stored.description.source}: {made.line()}", parse_math=False)
    write_whole(out, lambda file: figure.savefig(file, format=out.suffix[1:].lower(), dpi=120))
