"""`tactile-rt demo`: objects sweep past whiskers and every guess is scored.

The view takes 80 columns and 22 lines of the terminal and is understood at a glance. Every coloured
cell sets its own background and text colour, and bars are of middle brightness, so that it reads
alike on dark and on light terminals; no meaning hangs on colour alone.
"""

import time
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated

import typer
from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from tactile_rt.cli.app import (
    LARGEST_SEED,
    Model,
    Pace,
    Seconds,
    app,
    check_output,
    leaving,
    needs,
    starting,
)
from tactile_rt.cli.progress import working
from tactile_rt.cli.tables import STDOUT, Json, told_as_json
from tactile_rt.errors import ConfigError
from tactile_rt.extras import install_extra

if TYPE_CHECKING:
    from tactile_rt.cli.demonstration import Demonstration, SweepOutcome

__all__ = ["WIDTH", "draw", "watch"]

WIDTH = 80
HEIGHT = 15  # of the upper panels
DROPPED = 0.02  # share of the samples from which on the score says little of the model
REFRESH_S = 1 / 15  # seldom enough that drawing costs the stream nothing

# Lower limit of |F| (uN) and (background, text): matplotlib's inferno, whose lightness rises
# evenly, from a grey for "untouched".
LEVELS: tuple[tuple[float, str, str], ...] = (
    (0, "#3b3f4c", "#a4a9b8"),
    (1, "#420a68", "#ffffff"),
    (3, "#6a176e", "#ffffff"),
    (10, "#932667", "#ffffff"),
    (30, "#bc3754", "#ffffff"),
    (100, "#dd513a", "#ffffff"),
    (300, "#f37819", "#000000"),
    (1000, "#fca50a", "#000000"),
)
CELL = 4  # columns of the terminal, and one between cells
BAR = 18
GREEN, RED, GREY = "#2f9e62", "#d64545", "#8a8fa3"


@app.command()
def demo(
    sweeps: Annotated[
        int, typer.Option(min=0, help="Leave after so many objects; 0: go on until Ctrl-C.")
    ] = 0,
    seconds: Seconds = None,
    model: Model = None,
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Of the drawn objects and sweeps.")
    ] = 0,
    fast: Pace = False,
    recorded: Annotated[
        bool, typer.Option("--recorded", help="Play the recording, also if there is MuJoCo.")
    ] = False,
    plain: Annotated[
        bool, typer.Option("--plain", help="One line per object instead of the view.")
    ] = False,
    json: Json = None,
) -> None:
    """Sweep objects that the model never saw past whiskers, and keep the score.

    Without MuJoCo, or with --recorded, a short recording of simulated
    whiskers is played by an emulated device, over a serial port.
    """
    from tactile_rt.classifier.model_file import shipped_model
    from tactile_rt.cli.demonstration import Demonstration

    check_output(json)
    console = Console(stderr=json == STDOUT)
    simulated = find_spec("mujoco") and find_spec("trimesh")
    if (recorded or not simulated) and (fast or seed):
        do = "leave out --recorded" if simulated else install_extra("sim")
        raise ConfigError(f"--fast and --seed are for a simulation: {do}")
    recorded |= not simulated
    try:
        with starting(), working(Console(stderr=True), "building the array and the objects"):
            demonstration = Demonstration(model or shipped_model(), sweeps, seed, fast, recorded)
    except ModuleNotFoundError as error:
        raise needs("sim", error) from None
    with leaving(seconds), demonstration:
        narrow = console.width < WIDTH
        if plain or narrow or not console.is_terminal or console.is_dumb_terminal:
            for settled in demonstration.run():
                for outcome in settled:
                    typer.echo(outcome.line(), err=json == STDOUT)
        else:
            watch(demonstration, console)
    told = {
        "outcomes": demonstration.outcomes, "right": demonstration.right,
        "latency_p50_ms": demonstration.latency_ms(50),
        "latency_p99_ms": demonstration.latency_ms(99), "dropped": demonstration.dropped,
    }  # fmt: skip
    if not told_as_json(told, json):
        typer.echo(demonstration.summary())
    if demonstration.share_dropped > DROPPED:
        wait = "" if recorded else "; --fast waits for it"
        late = f"{100 * demonstration.share_dropped:.0f} % of the samples came too late"
        typer.echo(f"the machine is busy: {late} for the model to be right{wait}", err=True)


def watch(demo: "Demonstration", console: Console) -> None:
    """Run the demonstration and redraw as it goes."""
    with Live(console=console, auto_refresh=False) as live:
        due = 0.0
        try:
            for _ in demo.run():
                if time.monotonic() >= due:
                    live.update(draw(demo), refresh=True)
                    due = time.monotonic() + REFRESH_S
        finally:
            live.update(draw(demo), refresh=True)


def draw(demo: "Demonstration") -> RenderableType:
    """The view at this moment."""
    what = "objects that the model has never met" if demo.unseen else "objects"
    whiskers = "30 recorded whiskers felt" if demo.recorded else "30 simulated whiskers feel"
    title = Text.assemble((" tactile_rt", "bold"), f"  {whiskers} {what}")
    half = WIDTH // 2
    forces = Panel(
        _forces(demo), title="force at each whisker's base", padding=0, width=half, height=HEIGHT
    )
    guess = Panel(_guess(demo), title="what is it?", width=half, height=HEIGHT)
    score = Panel(_score(demo), title="score", subtitle="Ctrl-C leaves", width=WIDTH)
    return Group(title, Columns([forces, guess], padding=0), score)


def _level(force_un: float) -> tuple[str, str]:
    """(background, text) of a force in uN."""
    _, background, text = [level for level in LEVELS if force_un >= level[0]][-1]
    return background, text


def _forces(demo: "Demonstration") -> Text:
    """The array as a heat map: rows from the top of the face down, columns from rear to nose."""
    import numpy as np

    spec = demo.classifier.card.array
    newtons = [i for i, unit in enumerate(spec.units) if unit == "N"]
    force_un = 1e6 * np.linalg.norm(demo.classifier.tared[:, newtons], axis=1)  # (element,)
    at = {cell: float(force_un[i]) for i, cell in enumerate(spec.grid)}
    names = dict(zip(spec.grid, spec.elements, strict=True))
    rows, columns = spec.grid_shape
    header = "".join(f"{c:>3}".ljust(CELL + 1) for c in range(columns))
    text = Text(f"   {header}\n", no_wrap=True)
    for row in range(rows):
        numbers, lower = Text(f" {names[row, 0][0]} "), Text("   ")
        for column in range(columns):
            force = at.get((row, column))
            if force is None:
                numbers.append(" " * (CELL + 1))
                lower.append(" " * (CELL + 1))
                continue
            background, colour = _level(force)
            shown = f"{force:.0f}" if force < 9999.5 else f"{force / 1000:.0f}k"
            numbers.append(f"{shown:>3}".ljust(CELL), f"{colour} on {background}").append(" ")
            lower.append("▀" * CELL, background).append(" ")  # half a line, the rest is a gap
        text.append_text(numbers).append("\n").append_text(lower).append("\n")
    text.append("   rear     A top, E bottom      nose\n", GREY)
    text.append(" µN", GREY)
    for lowest, background, colour in LEVELS:
        text.append(f" {f'≥{lowest:g}' if lowest else '<1'}", f"{colour} on {background}")
    return text


def _guess(demo: "Demonstration") -> Text:
    """What is passing, what the model makes of it, and whether that is right."""
    detector = demo.classifier.detector
    if not detector.ready:
        contact = Text("○ measuring at rest")
    elif detector.contact:
        contact = Text("● touching", "bold")
    else:
        contact = Text("○ nothing touched")
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append("whiskers  ").append_text(contact).append("\n")
    if demo.decision is None or demo.target is None:
        return text.append("\nwaiting for the first object", GREY)
    truth, decision, steps = demo.target.category, demo.decision, demo.classifier.card.steps
    text.append("object    ").append(truth, f"bold {GREEN}").append(f"  ({demo.target.name})\n")
    text.append(f"step      {decision.step:>2}/{steps} ")
    text.append("━" * round(BAR * decision.step / steps) + "\n", GREY)
    text.append("\nthe model's five best guesses\n", GREY)
    top = decision.top(5)
    for label, probability in top:
        style = GREEN if label == truth else GREY
        text.append(f"{label[:9]:<10}", f"bold {style}" if label == truth else "")
        text.append(f"{'█' * round(BAR * probability):<{BAR}}", style)
        text.append(f" {100 * probability:3.0f} %\n")
    if decision.candidates:
        kinds = len(demo.classifier.card.classes)
        text.append(f"still possible: {len(decision.candidates)} of {kinds} kinds", GREY)
    text.append("\n" * (6 - len(top)))
    right = decision.label == truth
    if decision.final:
        verdict = "✓ RIGHT" if right else f"✗ WRONG, it is a {truth}"
    else:
        verdict = "✓ right so far" if right else "✗ not right yet"
    return text.append(verdict + "\n", f"bold {GREEN if right else RED}")


def _score(demo: "Demonstration") -> Text:
    """The figures since the start."""
    card, done = demo.classifier.card, len(demo.outcomes)
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append("objects  ")
    if done:
        text.append(f"{demo.right} of {done} right, {100 * demo.right / done:.0f} %", "bold")
    else:
        text.append("none has passed yet")
    text.append(f"  (blind guessing: {100 / len(card.classes):.0f} %)\n", GREY)
    text.append("latest   ").append_text(_latest(demo.outcomes)).append("\n")
    text.append("latency  ")
    if done:
        text.append(f"p50 {demo.latency_ms(50):.2f} ms, p99 {demo.latency_ms(99):.2f} ms a step")
        budget = card.substeps * card.period_ns / 1e6
        text.append(f"  (a step is {budget:.0f} ms of touch)", GREY)
    text.append(f"\nspeed    {demo.real_time_factor:.2f} x real time")
    how = "of a recording" if demo.recorded else "simulated"
    text.append(f"  ({demo.simulated_s:.0f} s {how}, {demo.dropped} samples dropped)", GREY)
    return text


def _latest(outcomes: "list[SweepOutcome]") -> Text:
    """The newest outcomes, newest first, as many as fit."""
    text = Text()
    for outcome in reversed(outcomes[-8:]):
        said = "" if outcome.right else f" (said {outcome.said or 'nothing'})"
        text.append("✓ " if outcome.right else "✗ ", GREEN if outcome.right else RED)
        text.append(f"{outcome.category}{said}  ")
    return text
