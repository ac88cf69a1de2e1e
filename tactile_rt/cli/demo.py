"""`tactile-rt demo`: objects sweep past whiskers and every guess is scored.

The whiskers are simulated; without a simulator, an emulated device on a serial port plays a
recording of them. The view takes 80 columns and 22 lines of a terminal. Every coloured cell sets
its own background and text colour, so that it reads alike on dark and on light terminals.
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
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer
from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from tactile_rt.cli.app import app, leaving, needing
from tactile_rt.cli.options import STDOUT, Fast, Json, Model, Seconds, Seed, option
from tactile_rt.cli.tables import progress_bar, told_as_json
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import install_extra

if TYPE_CHECKING:
    from tactile_rt.classifier.classifier import Classification
    from tactile_rt.core.stream import Source

WIDTH = 80
HEIGHT = 15  # of the upper panels
DROPPED = 0.02  # share of lost samples above which the score says little about the model
REFRESH_S = 1 / 15  # seldom enough that drawing costs the stream nothing
END_NS = 50_000_000  # the demo ends so long before the recording: the last samples may be lost
LATENCIES_KEPT = 10_000  # newest steps in the latency percentiles: a demo may run for days

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
LARGEST_UN = 9999.0  # that a cell has room for
BAR = 18  # columns
MOST_NAMES = 2  # kinds of a class that are shown
GREEN, RED, GREY = "#2f9e62", "#d64545", "#8a8fa3"


@dataclass(frozen=True)
class SweepOutcome:
    """Outcome of an object's pass: its true category and the model's final decision."""

    name: str
    category: str
    said: str | None = None  # decided class; None: the object passed without a decision
    probability: float = 0.0
    names: tuple[str, ...] = ()  # possible kinds within that class

    @property
    def right(self) -> bool:
        """True if the decision is the object's category."""
        return self.said == self.category

    def line(self) -> str:
        """Return one line with the object, the decision and the verdict."""
        what = f"taken for {describe(self.said, self.names)}" if self.said else "no decision"
        verdict = "right" if self.right else "WRONG"
        return f"{self.name:<12} {what:<42} {100 * self.probability:3.0f} %  {verdict}"


def describe(label: str, names: Sequence[str]) -> str:
    """Return a class with its possible kinds, such as: other (birdcage, ladder)."""
    more = ", ..." if len(names) > MOST_NAMES else ""
    return f"{label} ({', '.join(names[:MOST_NAMES])}{more})" if names else label


@dataclass(frozen=True)
class RecordedPass:
    """Pass of an object in the recording; `start_ns` counts from the first sample."""

    start_ns: int
    name: str
    category: str


@app.command(epilog="tactile-rt demo --sweeps 5")
def demo(
    sweeps: Annotated[int, option("Stop after this many objects; 0: at Ctrl-C.", min=0)] = 0,
    seconds: Seconds = None,
    model: Model = None,
    seed: Seed = 0,
    fast: Fast = False,
    recorded: Annotated[
        bool, option("Play the recording even if MuJoCo is installed.", "--recorded")
    ] = False,
    json: Json = None,
) -> None:
    """Recognise simulated or recorded objects; needs no sensor.

    Without MuJoCo, or with --recorded, a short recording of simulated
    whiskers is played by an emulated device, over a serial port.
    """
    from tactile_rt.classifier.model_file import shipped_model

    console = Console(stderr=json == STDOUT)
    simulated = find_spec("mujoco") and find_spec("trimesh")
    if (recorded or not simulated) and (fast or seed):
        do = "leave out --recorded" if simulated else install_extra("sim")
        raise ConfigError(f"--fast and --seed are for a simulation: {do}")
    recorded |= not simulated
    with needing("sim"), progress_bar("building the array and the objects"):
        demonstration = Demonstration(model or shipped_model(), sweeps, seed, fast, recorded)
    with leaving(seconds), demonstration:
        if console.width < WIDTH or not console.is_terminal or console.is_dumb_terminal:
            for settled in demonstration.run():
                for outcome in settled:
                    typer.echo(outcome.line(), err=json == STDOUT)
        else:
            watch(demonstration, console)
    results = {
        "outcomes": demonstration.outcomes, "right": demonstration.right,
        "latency_p50_ms": demonstration.latency_ms(50),
        "latency_p99_ms": demonstration.latency_ms(99), "dropped": demonstration.dropped,
    }  # fmt: skip
    if not told_as_json(results, json):
        typer.echo(demonstration.summary())
    late = demonstration.dropped / max(1.0, demonstration.samples)
    if late > DROPPED:
        wait = "" if recorded else "; --fast waits for it"
        typer.echo(
            f"the machine is busy: {100 * late:.0f} % of the samples came too late for the model "
            f"to be right{wait}",
            err=True,
        )


class Demonstration:
    """Run of a model on the simulated or recorded array, with the model's score.

    The score counts objects, not touches: only the first episode of each object's pass, by its
    final decision. An episode belongs to the pass in which it began, even if its last steps come
    while the next object approaches. An object whose pass brings no decision is wrong.

    Args:
        model: an ``.onnx`` file made for the mouse array.
        sweeps: objects that pass before the end; 0 for an endless run.
        fast: as fast as the simulation goes, instead of in real time.
        recorded: play the recording instead.

    Raises:
        ModelError, SpecMismatch: the model cannot be used on the mouse array.
    """

    def __init__(
        self, model: Path, sweeps: int, seed: int, fast: bool, recorded: bool = False
    ) -> None:
        from tactile_rt.classifier.classifier import Classifier
        from tactile_rt.classifier.model_file import load_model
        from tactile_rt.classifier.session import Session

        self.recorded = recorded
        self.passes: Sequence[Any]  # each with start_ns, name and category
        self._device = ExitStack()
        self._ends_ns = sys.maxsize  # end of the demo: stream time from the first sample
        if recorded:
            self._source = self._open_recording(sweeps)
        else:
            from tactile_rt.sim_backend.source import SimOptions, SimSource

            unseen = load_model(model)[1].provenance.get("unseen_objects", [])
            options = SimOptions(
                objects=",".join(unseen),  # empty: the first object of every category
                sweeps=sweeps,
                seed=seed,
                pace="fast" if fast else "realtime",
            )
            self._source = source = SimSource("mouse", options)
            self.passes = source.passes
        self.classifier = Classifier(model, self._source.spec)
        self._class_of = self.classifier.card.class_of
        self._session = Session(self._source, self.classifier)
        self.target: Any = None  # the pass that `decision` is about
        self.decision: Classification | None = None  # the latest
        self.outcomes: list[SweepOutcome] = []  # of the objects that have passed, in order
        self._latencies: deque[float] = deque(maxlen=LATENCIES_KEPT)
        self._first_ns = self._now_ns = 0  # stream time
        self._base_ns = 0  # stream time from which passes count
        self._began = self._now = 0.0  # wall time, s

    def _open_recording(self, sweeps: int) -> "Source":
        """Play the recording on an emulated serial device; return the device's source."""
        from tactile_rt.drivers.emulation.device import EmulatedSerial
        from tactile_rt.recording import Recording
        from tactile_rt.recording.replay import DEMO
        from tactile_rt.sources.opening import open_source

        recording = Recording(DEMO)
        notes = recording.description.session
        fields = [note.split() for name, note in notes.items() if name.startswith("pass_")]
        passes = [RecordedPass(int(start), name, category) for start, name, category in fields]
        chunks = list(recording)
        last = int(chunks[-1].t_ns[-1] - chunks[0].t_ns[0])
        ends = [p.start_ns for p in passes[1:]] + [last - END_NS]
        count = min(sweeps or len(passes), len(passes))
        self.passes, self._ends_ns = passes[:count], ends[count - 1]
        played = self._device.enter_context(open_source(f"replay:{DEMO}?speed=0"))
        device = self._device.enter_context(EmulatedSerial(played, "native", log=False))
        return open_source(device.url)

    def run(self) -> Iterator[list[SweepOutcome]]:
        """Run the model to the end; after each chunk, yield the new outcomes."""
        from tactile_rt.core.stream import NS_PER_S

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
        self._add_missed(len(self.passes))
        yield self.outcomes[settled:]

    @property
    def right(self) -> int:
        """Number of objects recognised correctly."""
        return sum(o.right for o in self.outcomes)

    @property
    def stream_s(self) -> float:
        """Stream time since the first chunk, s."""
        return (self._now_ns - self._first_ns) / 1e9

    @property
    def samples(self) -> float:
        """Number of samples in `stream_s` at the nominal rate."""
        return self.stream_s * self._source.spec.rate_hz

    @property
    def dropped(self) -> int:
        """Number of samples dropped because they were not read in time."""
        return self._session.dropped + self._source.stats.dropped

    def latency_ms(self, percentile: float) -> float:
        """Return a percentile of the time per model step, ms; NaN before the first step."""
        import numpy as np

        return 1e3 * float(np.percentile(self._latencies or [np.nan], percentile))

    def summary(self) -> str:
        """Return score, step times, speed and losses so far, in one line."""
        done, wall = len(self.outcomes), self._now - self._began
        share = f" ({100 * self.right / done:.0f} %)" if done else ""
        return (
            f"{self.right} of {done} right{share}; step p50 {self.latency_ms(50):.1f}, "
            f"p99 {self.latency_ms(99):.1f} ms; {self.stream_s / (wall or 1):.2f} x real time; "
            f"{self.dropped} dropped"
        )

    def _score(self, decision: "Classification") -> None:
        onset_ns = decision.onset_ns - self._base_ns
        number = bisect_right(self.passes, onset_ns, key=lambda p: p.start_ns) - 1
        if number < len(self.outcomes):
            return  # touched again: only the first episode counts
        self._add_missed(number)
        self.target, self.decision = self.passes[number], decision
        if decision.final:
            self._add_outcome(self.target, decision.label, decision.probability, decision.names)

    def _add_missed(self, number: int) -> None:
        for missed in self.passes[len(self.outcomes) : number]:
            self._add_outcome(missed)

    def _add_outcome(self, passed: Any, *decision: Any) -> None:
        self.outcomes.append(SweepOutcome(passed.name, self.true_class(passed), *decision))

    def true_class(self, passed: Any) -> str:
        """Return the true class of a pass's object, among the model's classes."""
        return str(self._class_of.get(passed.category, passed.category))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        with self._device:
            self._session.__exit__(*error)


def watch(demo: Demonstration, console: Console) -> None:
    """Run the demonstration, and redraw its view in the terminal while it runs."""
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
    """Draw the present view of the demonstration: forces, guess and score."""
    whiskers = "30 recorded whiskers" if demo.recorded else "30 simulated whiskers"
    head = Text.assemble((" tactile_rt", "bold"), f"  {whiskers}, and what the model makes of it")
    half = WIDTH // 2
    title = "force at each whisker's base"
    forces = Panel(_draw_forces(demo), title=title, padding=0, width=half, height=HEIGHT)
    guess = Panel(_draw_guess(demo), title="what is it?", width=half, height=HEIGHT)
    score = Panel(_draw_score(demo), title="score", subtitle="Ctrl-C leaves", width=WIDTH)
    return Group(head, Columns([forces, guess], padding=0), score)


def _draw_forces(demo: Demonstration) -> Text:
    """Draw the forces on the array as a heat map, columns from rear to nose."""
    import numpy as np

    spec = demo.classifier.card.array
    newtons = [i for i, unit in enumerate(spec.units) if unit == "N"]
    force_un = 1e6 * np.linalg.norm(demo.classifier.deviation[:, newtons], axis=1)  # (element,)
    at = dict(zip(spec.grid, zip(spec.elements, force_un.tolist(), strict=True), strict=True))
    rows, columns = spec.grid_shape
    text = Text(no_wrap=True)
    for row in range(rows):
        text.append(f"{at[row, 0][0][0]} ")
        for column in range(columns):
            if (row, column) not in at:
                text.append(" " * 5)
                continue
            force = min(at[row, column][1], LARGEST_UN)
            _, background, colour = [level for level in LEVELS if force >= level[0]][-1]
            text.append(f"{force:4.0f}", f"{colour} on {background}").append(" ")
        text.append("\n\n")
    text.append("rear      A top, E bottom       nose\nµN", GREY)
    for lowest, background, colour in LEVELS:
        text.append(f" {lowest:g}", f"{colour} on {background}")
    return text


def _draw_guess(demo: Demonstration) -> Text:
    """Draw the passing object, the five likeliest classes and the verdict."""
    detector = demo.classifier.detector
    state = "touching" if detector.contact else "nothing touched"
    text = Text(f"whiskers  {state if detector.ready else 'measuring at rest'}\n", no_wrap=True)
    if demo.decision is None:
        return text.append("\nwaiting for the first object", GREY)
    truth, decision = demo.true_class(demo.target), demo.decision
    text.append("object    ").append(truth, f"bold {GREEN}").append(f"  ({demo.target.name})\n")
    text.append(f"step      {decision.step:>2}/{demo.classifier.card.steps}\n\n")
    for label, probability in decision.top(5):
        style = GREEN if label == truth else GREY
        text.append(f"{label[:9]:<10}", f"bold {style}" if label == truth else "")
        text.append(f"{'█' * round(BAR * probability):<{BAR}}", style)
        text.append(f" {100 * probability:3.0f} %\n")
    if decision.prediction_set:
        left, of = len(decision.prediction_set), len(demo.classifier.card.classes)
        possible = describe(decision.label, decision.names) if decision.names else ""
        text.append(possible or f"prediction set: {left} of {of}", GREY)
    right = decision.label == truth
    verdict = ("✓ " if right else "✗ ") + ("RIGHT" if right else f"WRONG, it is a {truth}")
    return text.append(f"\n{verdict if decision.final else ''}", f"bold {GREEN if right else RED}")


def _draw_score(demo: Demonstration) -> Text:
    """Draw the score since the start, and the newest outcomes."""
    text = Text(f"{demo.summary()}\n", no_wrap=True, overflow="ellipsis")
    blind = 100 / len(demo.classifier.card.classes)
    how = "of a recording" if demo.recorded else "simulated"
    text.append(f"{demo.stream_s:.0f} s {how}; blind guessing: {blind:.0f} %\nlatest ", GREY)
    for outcome in reversed(demo.outcomes[-8:]):
        mistake = "" if outcome.right else f" (said {outcome.said or 'nothing'})"
        text.append("✓ " if outcome.right else "✗ ", GREEN if outcome.right else RED)
        text.append(f"{outcome.category}{mistake}  ")
    return text
