"""`tactile-rt demo`: objects sweep past whiskers and every guess is scored.

The whiskers are simulated; where nothing can be, a recording of theirs is played by an emulated
device on a serial port, and goes through driver, detector and model as a device's samples do.

The view takes 80 columns and 22 lines of the terminal and is understood at a glance. Every coloured
cell sets its own background and text colour, and bars are of middle brightness, so that it reads
alike on dark and on light terminals; no meaning hangs on colour alone.
"""

import sys
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Self

import numpy as np
import typer
from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from tactile_rt.cli.app import Model, Seconds, app, leaving, needs, starting
from tactile_rt.stream import NS_PER_S, ConfigError

if TYPE_CHECKING:
    from tactile_rt.classifier.classifier import Classification
    from tactile_rt.sim_backend.source import Pass
    from tactile_rt.stream import Source

__all__ = ["WIDTH", "Demonstration", "SweepOutcome", "draw", "watch"]

RECORDING = Path(__file__).parents[1] / "assets" / "demo.mcap"  # see bench/write_demo.py
END_NS = 50_000_000  # before the end of what is played: the last samples may be lost
LATENCIES_KEPT = 10_000  # steps that the latency percentiles look back on: a demo may run for days
WIDTH = 80
HEIGHT = 15  # of the upper panels
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
    seed: Annotated[int, typer.Option(min=0, help="Of the drawn objects and sweeps.")] = 0,
    fast: Annotated[
        bool, typer.Option("--fast", help="As fast as it simulates, not in real time.")
    ] = False,
    recorded: Annotated[
        bool, typer.Option("--recorded", help="Play the recording, also if there is MuJoCo.")
    ] = False,
    plain: Annotated[
        bool, typer.Option("--plain", help="One line per object instead of the view.")
    ] = False,
) -> None:
    """Sweep objects that the model never saw past whiskers, and keep the score.

    Without MuJoCo, or with --recorded, a short recording of simulated
    whiskers is played by an emulated device, over a serial port.
    """
    from tactile_rt.classifier.model_file import shipped_model

    console = Console()
    recorded |= not (find_spec("mujoco") and find_spec("trimesh"))
    if recorded and (fast or seed):
        raise ConfigError("--fast and --seed are for a simulation: install tactile-rt[sim]")
    try:
        with starting(), console.status("building the array and the objects"):
            demonstration = Demonstration(model or shipped_model(), sweeps, seed, fast, recorded)
    except ModuleNotFoundError as error:
        raise needs("record" if recorded else "sim", error) from None
    with leaving(seconds), demonstration:
        if plain or not console.is_terminal or console.is_dumb_terminal:
            for settled in demonstration.run():
                for outcome in settled:
                    typer.echo(outcome.line())
        else:
            watch(demonstration, console)
    typer.echo(demonstration.summary())


@dataclass(frozen=True)
class SweepOutcome:
    """One object that has passed, and what the model took it for."""

    name: str
    category: str
    said: str | None  # None: it passed without a decision
    probability: float

    @property
    def right(self) -> bool:
        """Whether the decision is the object's category."""
        return self.said == self.category

    def line(self) -> str:
        """One line that says it all."""
        if self.said is None:
            return f"{self.name:<12} no decision                   WRONG"
        verdict = "right" if self.right else "WRONG"
        sure = f"{100 * self.probability:3.0f} %"
        return f"{self.name:<12} feels like a {self.said:<12}{sure}  {verdict}"


@dataclass(frozen=True)
class RecordedPass:
    """An object that passed when the recording was made, and when, in ns from its first sample."""

    start_ns: int
    name: str
    category: str


class Demonstration:
    """Run a model on the simulated array, or on a recording of it, and keep the score.

    The score counts objects, not touches: only the first episode of each object's pass, by its
    final decision. An episode belongs to the pass in which it began, even if its last steps come
    while the next object is still on its way. An object whose pass brings no decision is wrong.

    Args:
        model: an ``.onnx`` file made for the mouse array.
        sweeps: objects that pass before the end; 0: endless.
        seed: of the drawn objects and sweeps.
        fast: as fast as the simulation goes, instead of in real time.
        recorded: play the recording instead.

    Attributes:
        unseen: Whether the objects are ones that the model has not been trained on.
        recorded: Whether the recording is played.
        classifier: The classifier that is run; holds the contact state and the forces.
        target: The object that `decision` is about; None before the first touch.
        decision: The latest decision of the model; None before the first one.
        outcomes: The outcomes of the objects that have passed, in order.

    Raises:
        ModelError, SpecMismatch: the model cannot be used on the mouse array.
    """

    def __init__(
        self, model: Path, sweeps: int, seed: int, fast: bool, recorded: bool = False
    ) -> None:
        from tactile_rt.classifier.classifier import Classifier
        from tactile_rt.classifier.model_file import load_model
        from tactile_rt.classifier.session import Session

        _, card = load_model(model)
        unseen = card.provenance.get("unseen_objects", [])
        self.recorded = recorded
        self._device = ExitStack()
        self._ends_ns = sys.maxsize  # stream time from the first sample at which it is over
        self.passes: Sequence[Pass | RecordedPass]
        if recorded:
            self._source = self._play(sweeps)
            self.unseen = {p.name for p in self.passes} <= set(unseen)
        else:
            self._source, self.passes = self._simulate(unseen, sweeps, seed, fast)
            self.unseen = bool(unseen)
        self.classifier = Classifier(model, self._source.spec)
        self._session = Session(self._source, self.classifier)
        self.target: Pass | RecordedPass | None = None
        self.decision: Classification | None = None
        self.outcomes: list[SweepOutcome] = []
        self._latencies: deque[float] = deque(maxlen=LATENCIES_KEPT)
        self._first_ns = self._now_ns = 0  # stream time
        self._base_ns = 0  # stream time from which passes count
        self._began = self._now = 0.0  # wall time, s

    def _simulate(
        self, unseen: list[str], sweeps: int, seed: int, fast: bool
    ) -> "tuple[Source, list[Pass]]":
        from tactile_rt.sim_backend.source import SimOptions, SimSource

        options = SimOptions(
            objects=",".join(unseen),  # none listed: the first one of every category
            sweeps=sweeps,
            seed=seed,
            pace="fast" if fast else "realtime",
        )
        source = SimSource("mouse", options)
        return source, source.passes

    def _play(self, sweeps: int) -> "Source":
        """The recording, from an emulated device on a serial port."""
        from tactile_rt.drivers.emulation.device import EmulatedSerial
        from tactile_rt.recording import Recording
        from tactile_rt.sources.opening import open_source

        recording = Recording(RECORDING)
        notes = recording.description.session
        told = [notes[f"pass_{i}"].split() for i in range(len(notes))]
        passes = [RecordedPass(int(start), name, category) for start, name, category in told]
        chunks = list(recording)
        ends = [p.start_ns for p in passes[1:]] + [int(chunks[-1].t_ns[-1] - chunks[0].t_ns[0])]
        count = min(sweeps or len(passes), len(passes))
        self.passes, self._ends_ns = passes[:count], ends[count - 1] - END_NS
        played = self._device.enter_context(open_source(f"replay:{RECORDING}?speed=0"))
        device = self._device.enter_context(EmulatedSerial(played, "native", log=False))
        return open_source(device.url)

    def run(self) -> Iterator[list[SweepOutcome]]:
        """Run to the end; yields after every chunk what it has settled."""
        for chunk, decisions in self._session:
            self._now_ns, self._now = int(chunk.t_ns[-1]), time.monotonic()
            if not self._began:
                self._first_ns, self._began = self._now_ns, self._now
                if self.recorded:
                    before = int(chunk.seq[0]) / self._source.spec.rate_hz * NS_PER_S
                    self._base_ns = int(chunk.t_ns[0]) - round(before)
            settled = len(self.outcomes)
            for decision in decisions:
                self._latencies.append(decision.latency_s)
                self._score(decision)
            yield self.outcomes[settled:]
            if self._now_ns - self._base_ns >= self._ends_ns:
                break
        settled = len(self.outcomes)
        self._miss_before(len(self.passes))
        yield self.outcomes[settled:]

    @property
    def right(self) -> int:
        """Objects recognised."""
        return sum(o.right for o in self.outcomes)

    @property
    def simulated_s(self) -> float:
        """Stream time since the first chunk, s."""
        return (self._now_ns - self._first_ns) / NS_PER_S

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall time; 0 at the first chunk."""
        wall = self._now - self._began
        return self.simulated_s / wall if wall > 0 else 0.0

    @property
    def dropped(self) -> int:
        """Samples for which the classifier was too late."""
        return self._session.dropped + self._source.stats.dropped

    def latency_ms(self, percentile: float) -> float:
        """A percentile of the time that a model step takes, ms; NaN before the first step."""
        if not self._latencies:
            return float("nan")
        return 1e3 * float(np.percentile(self._latencies, percentile))

    def summary(self) -> str:
        """The figures so far, in one line."""
        done = len(self.outcomes)
        score = f"{self.right} of {done} right"
        score += f" ({100 * self.right / done:.0f} %)" if done else ""
        steps = f"step p50 {self.latency_ms(50):.1f}, p99 {self.latency_ms(99):.1f} ms; "
        return (
            f"{score}; {steps if self._latencies else ''}"
            f"{self.real_time_factor:.2f} x real time; {self.dropped} dropped"
        )

    def _score(self, decision: "Classification") -> None:
        passes, onset_ns = self.passes, decision.onset_ns - self._base_ns
        number = bisect_right(passes, onset_ns, key=lambda p: p.start_ns) - 1
        if number < len(self.outcomes):
            return  # touched again after its first episode, which alone counts
        self._miss_before(number)
        self.target, self.decision = passes[number], decision
        if decision.final:
            self.outcomes.append(
                SweepOutcome(
                    self.target.name,
                    self.target.category,
                    decision.label,
                    float(decision.probabilities.max()),
                )
            )

    def _miss_before(self, number: int) -> None:
        for missed in self.passes[len(self.outcomes) : number]:
            self.outcomes.append(SweepOutcome(missed.name, missed.category, None, 0.0))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._device:
            self._session.__exit__(kind, error, trace)


def watch(demo: Demonstration, console: Console) -> None:
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


def draw(demo: Demonstration) -> RenderableType:
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


def _forces(demo: Demonstration) -> Text:
    """The array as a heat map: rows from the top of the face down, columns from rear to nose."""
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


def _guess(demo: Demonstration) -> Text:
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
    text.append("\n" * (6 - len(top)))
    right = decision.label == truth
    if decision.final:
        verdict = "✓ RIGHT" if right else f"✗ WRONG, it is a {truth}"
    else:
        verdict = "✓ right so far" if right else "✗ not right yet"
    return text.append(verdict + "\n", f"bold {GREEN if right else RED}")


def _score(demo: Demonstration) -> Text:
    """The figures since the start."""
    card, done = demo.classifier.card, len(demo.outcomes)
    text = Text(no_wrap=True, overflow="ellipsis")
    text.append("objects  ")
    if done:
        text.append(f"{demo.right} of {done} right, {100 * demo.right / done:.0f} %", "bold")
    else:
        text.append("none has passed yet")
    text.append(f"  (blind guessing: {100 / len(card.labels):.0f} %)\n", GREY)
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


def _latest(outcomes: list[SweepOutcome]) -> Text:
    """The newest outcomes, newest first, as many as fit."""
    text = Text()
    for outcome in reversed(outcomes[-8:]):
        said = "" if outcome.right else f" (said {outcome.said or 'nothing'})"
        text.append("✓ " if outcome.right else "✗ ", GREEN if outcome.right else RED)
        text.append(f"{outcome.category}{said}  ")
    return text
