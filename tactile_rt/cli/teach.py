"""`tactile-rt teach`: label touches of any sensor, and learn a model from them."""

import queue
import shlex
import sys
import threading
import time
from collections import Counter
from collections.abc import Generator
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactile_rt.cli.app import app, check_folder, check_text, leaving, open_url
from tactile_rt.cli.options import Json, Seconds, Url, argument, option
from tactile_rt.cli.tables import told_as_json
from tactile_rt.core.errors import ConfigError, SourceError, SpecMismatch
from tactile_rt.core.settings import split_url

if TYPE_CHECKING:
    from tactile_rt.core.stream import Chunk, Source
    from tactile_rt.teaching.lesson import Lesson
    from tactile_rt.teaching.page import TeachingPage
    from tactile_rt.teaching.teacher import Teacher

POLL_S = 0.1
REST_S = 2.0  # at rest, to measure the noise
HINT_S = 20.0  # without a touch, before a hint on the readings' strength; then twice as long
SILENT_S = 3.0  # without a sample during a lesson, before a warning
RESTS = 3  # attempts to measure at rest
PAGE_S = 1.5  # for a page, which polls twice a second, to get the last state
DEAF_S = 10.0  # without a first sample, before the device counts as silent
RESTING = f"touch nothing for {REST_S:g} s"
HELP = (
    "type and press Enter: a name or its number, n the next, u takes a touch back, q learns; "
    "list, forget NAME, rename OLD NEW"
)
ORDERS = {"n": "next", "u": "undo", "q": "done"}
HASTY = "that came too soon after the last touch to be one: wait a second"


@app.command(epilog="tactile-rt teach 'serial:///dev/ttyUSB0?codec=bota' lesson --classes tap,rub")
def teach(
    source: Url,
    folder: Annotated[Path, argument("Folder of the lesson; an existing one continues.")],
    classes: Annotated[
        str, option("Classes or objects to touch, comma-separated; more can come later.")
    ] = "",
    touches: Annotated[
        int | None, option("Touches of each; default 10, of objects 5.", min=2, max=1000)
    ] = None,
    page: Annotated[str, option("Serve buttons for a browser, e.g. at 127.0.0.1:8791.")] = "",
    model: Annotated[str, option("Network to enrol objects on: an .onnx file, or `shipped`.")] = "",
    seconds: Seconds = None,
    json: Json = None,
) -> None:
    """Teach classes by ten touches of each, or enrol objects by five.

    This is few-shot learning. Keep the sensor untouched for two seconds, then touch as prompted.
    Type a class's name or number, n (next), u (undo the last touch) or q (learn FOLDER/model.onnx,
    and stop); list, forget NAME and rename OLD NEW change what is there. After the classes touch
    anything else for twenty seconds: what is to be refused, and how well it is.

    With --model, a network that was trained to tell objects apart enrols objects instead: which of
    them is it, or none? Another network than before feels the recordings of FOLDER again.
    """
    from tactile_rt.classifier.model_file import shipped_model
    from tactile_rt.core.locks import alone_in
    from tactile_rt.recording.labels import LABELS
    from tactile_rt.teaching.lesson import FEATURES, MODEL, Lesson
    from tactile_rt.teaching.teacher import Teacher

    names = [name.strip() for name in classes.split(",") if name.strip()]
    at = _parse_address(page) if page else None
    _check_labels(names)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder")
    check_folder(folder)
    check_text(folder.absolute())
    base = shipped_model() if model == "shipped" else Path(model) if model else None
    own = (FEATURES, MODEL, LABELS)
    files = [*folder.glob("session-*"), *(folder / name for name in own), *filter(None, [base])]
    if json is not None and json.resolve() in {one.resolve() for one in files}:
        raise ConfigError(f"--json {json} is a file of the lesson, or its model: name another")
    lesson = _load_lesson(folder, base)
    opened = open_url(source)
    with opened, alone_in(folder), Orders(at) as orders:
        with leaving(seconds):
            lesson = lesson or (_begin(folder, opened) if base is None else Lesson.on(folder, base))
            orders.teacher = Teacher(lesson, names, touches or lesson.taught.each)
            _teach(orders.teacher, opened, source, orders)
        teacher = orders.teacher
        if lesson is None or teacher is None or not lesson.taught_enough:
            few = f"touches kept: {len(lesson.touches) if lesson else 0}, too few to learn from"
            orders.end(few)
            raise ConfigError(
                f"{folder}: {few}: a class needs two touches; run the same command to go on"
            )
        began = time.process_time()
        card = lesson.learn()
        orders.end(f"{folder / MODEL} knows {', '.join(lesson.taught_enough)}")
    for line in teacher.summary():
        typer.echo(line)
    stats = opened.stats
    if stats.corrupt or stats.missing:
        lost = f"{stats.corrupt} damaged, {stats.missing} missing samples"
        typer.echo(f"lost on the wire: {lost}")
    learnt = lesson.taught_enough
    results = {
        "model": folder / MODEL,
        "classes": card.classes,
        "objects": [one.name for one in card.enrolled],
        "touches": {name: lesson.count(name) for name in learnt},
        "leave_one_out_right": {
            name: {"right": good, "of": count} for name, count, good in teacher.progress.classes
        },
        "anything_else": dict(zip(("refused", "of"), teacher.progress.others, strict=True)),
        "corrupt": stats.corrupt,
        "missing": stats.missing,
    }
    told_as_json(results, json)
    others = len(card.classes) - (0 if card.enrolled else len(learnt))
    beside = f" beside {others} {'classes' if card.enrolled else 'others'}" if others else ""
    strange = "is none of these" if card.enrolled else "it does not know"
    typer.echo(
        f"{folder / MODEL}: knows {', '.join(learnt)}{beside}, and what {strange}; "
        f"{sum(map(lesson.count, learnt))} touches, learnt in {time.process_time() - began:.1f} s"
    )
    typer.echo(
        f"now: tactile-rt run --source '{source}' --model {shlex.quote(str(folder / MODEL))}"
    )


class Orders:
    """Queue of the user's commands, such as ``undo``, from stdin and a page's buttons.

    Args:
        at: host and port of the page; None for no page.
    """

    def __init__(self, at: tuple[str, int] | None) -> None:
        self.teacher: Teacher | None = None  # whose state the page shows
        self._orders: queue.Queue[str] = queue.Queue()
        self._at = at
        self._page: TeachingPage | None = None

    def __enter__(self) -> "Orders":
        if self._at is not None:
            from tactile_rt.teaching.page import TeachingPage

            self._page = TeachingPage(*self._at, self._get_state, self._orders.put)
            typer.echo(f"buttons: {self._page.url}")
        return self

    def __exit__(self, *why: object) -> None:
        if self._page is not None:
            self._page.close()

    def end(self, message: str) -> None:
        """Show on the page how the lesson ended; wait while the page fetches the message."""
        if self.teacher is not None:
            self.teacher.ended = message
            time.sleep(PAGE_S if self._page else 0)

    def listen(self) -> None:
        """Start a thread that reads commands from stdin into the queue."""
        threading.Thread(target=self._read_lines, daemon=True).start()

    def next(self) -> str:
        """Remove and return the oldest command; return empty text if none waits."""
        return "" if self._orders.empty() else self._orders.get()

    def _read_lines(self) -> None:
        try:
            for line in sys.stdin or ():
                if order := line.strip():
                    self._orders.put(ORDERS.get(order, order))
        except (OSError, ValueError):
            return  # closed

    def _get_state(self) -> dict[str, Any]:
        return self.teacher.state() if self.teacher else {"prompt": RESTING}


def _teach(teacher: "Teacher", source: "Source", url: str, orders: Orders) -> None:
    """Collect touches until the lesson is complete, the stream ends, or the user stops."""
    from tactile_rt.core.stream import EndOfStream
    from tactile_rt.recording import StreamWriter
    from tactile_rt.teaching.lesson import BEFORE_NS

    lesson = teacher.lesson
    try:
        listener = lesson.listener(source.spec)
    except SpecMismatch as error:
        raise SpecMismatch(f"{error}, or teach in another folder") from None
    typer.echo(_describe_lesson(lesson, source))
    _say(lesson.taught.note)
    if not source.live and teacher.wanted:
        order = f"{teacher.each} touches of each, in this order: {', '.join(teacher.wanted)}"
        _say(f"a recording is taken to hold {order}; --touches sets another number")
    held = not source.live and _is_held(lesson.folder, url)
    if held:
        _say(
            f"{lesson.folder} holds the touches of this recording, so it only learns again, as its "
            "labels.csv says; to take them anew, teach in another folder"
        )
    earlier = len(lesson.touches)
    path = lesson.next_recording()
    orders.listen()
    with (
        nullcontext() if held else StreamWriter(path, source, url=url) as writer,
        closing(_receive(source, orders)) as coming,
    ):
        if sys.stdin is not None and sys.stdin.isatty() and not teacher.done:
            typer.echo(HELP)
        typer.echo(teacher.prompt())
        label = teacher.label  # of the touch under way, or of the next
        quiet_since, patience_s = time.monotonic(), HINT_S
        sampled_at, silent = time.monotonic(), False
        while not teacher.done:
            if time.monotonic() - quiet_since > patience_s:
                _say(teacher.note(listener.hint()))
                quiet_since, patience_s = time.monotonic(), 2 * patience_s
            try:
                chunk, order = next(coming)
            except EndOfStream:
                break
            _say(teacher.obey(order) if order else "")
            if writer is None:
                continue
            if chunk is None:
                if time.monotonic() - sampled_at > SILENT_S and not silent:
                    silent = True
                    _say(teacher.note(f"no sample for {SILENT_S:g} s: is the device plugged in?"))
                    teacher.watch(None)
                continue
            if silent:
                _say(teacher.note("samples come again"))
            sampled_at, silent = time.monotonic(), False
            writer.push(chunk)
            if not listener.classifier.deciding:
                label = teacher.label
            hasty = listener.hasty
            for onset, end, felt in listener.push(chunk):
                quiet_since, patience_s = time.monotonic(), HINT_S
                writer.flush()  # the label refers to samples that must be in the file
                span = listener.seconds(onset - BEFORE_NS), listener.seconds(end)
                _say(teacher.take(label, felt, path.name, span))
                label = teacher.label
            if listener.hasty > hasty:
                _say(teacher.note(HASTY))
            teacher.watch(listener.seconds(int(chunk.t_ns[-1])))
    if not source.live and not held:
        taken = Counter(touch.label for touch in lesson.touches[earlier:])
        _say("found in it: " + (", ".join(f"{n} {label}" for label, n in taken.items()) or "none"))
        each, more = divmod(taken.total(), len(teacher.wanted) or 1)
        if teacher.wanted and not earlier and each not in (0, teacher.each) and not more:
            _say(
                f"{taken.total()} touches: if each was touched {each} times, teach another folder "
                f"with --touches {each}"
            )


def _is_held(folder: Path, url: str) -> bool:
    """Return whether a lesson's folder has the touches of the recording that a URL names."""
    from tactile_rt.recording import Recording

    def find(url: str) -> tuple[str, Path]:
        scheme, target, _ = split_url(url)
        return scheme, Path(target).resolve()

    recorded = (Recording(one).description.source for one in folder.glob("session-*.mcap"))
    return find(url) in map(find, recorded)


def _receive(source: "Source", orders: Orders) -> "Generator[tuple[Chunk | None, str], None, None]":
    """Yield (chunk or None, command or empty text); read a live source in a thread."""
    waiting = queue.SimpleQueue[tuple["Chunk | None", str] | Exception]()
    over = threading.Event()

    def read() -> None:
        try:
            while not over.is_set():
                waiting.put((source.read(POLL_S), orders.next()))
        except Exception as error:  # raised again below, in the thread that reads the chunks
            waiting.put(error)

    while not source.live:
        yield source.read(POLL_S), orders.next()
    reader = threading.Thread(target=read, name="tactile-rt-reader", daemon=True)
    reader.start()
    try:
        while not isinstance(item := waiting.get(), Exception):
            yield item
        raise item
    finally:
        over.set()
        reader.join()


def _load_lesson(folder: Path, base: Path | None) -> "Lesson | None":
    """Load the lesson of a folder; return None if the folder has no lesson.

    Args:
        base: network to enrol objects on; if it is a new one, it embeds the recordings again.
    """
    from tactile_rt.classifier.model_file import hash_of
    from tactile_rt.core.locks import alone_in
    from tactile_rt.teaching.lesson import FEATURES, Lesson

    if not (folder / FEATURES).exists():
        return None
    if base is None or hash_of(base) == hash_of(folder / FEATURES):
        return Lesson.read(folder)
    with alone_in(folder):
        lesson = Lesson.embedded_again(folder, base)
    typer.echo(f"touches that {base} finds in the recordings: {len(lesson.touches)}")
    for name in dict.fromkeys(lesson.unfelt):
        typer.echo(f"{name}: touches that {base} does not find: {lesson.unfelt.count(name)}")
    return lesson


def _check_labels(names: list[str]) -> None:
    from tactile_rt.teaching.lesson import ANYTHING_ELSE, check_label

    for name in names:
        check_label(name)
        if name == ANYTHING_ELSE:
            raise ConfigError(f"--classes: {name!r} is asked for after the classes: leave it out")
        if names.count(name) > 1:
            raise ConfigError(f"--classes names {name!r} twice")


def _parse_address(given: str) -> tuple[str, int]:
    host, colon, port = given.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"--page must be HOST:PORT, as 127.0.0.1:8791, not {given!r}")
    return host, int(port)


def _begin(folder: Path, source: "Source") -> "Lesson":
    """Create a lesson in a folder, after measuring the noise of the array at rest."""
    from tactile_rt.teaching.lesson import Lesson
    from tactile_rt.teaching.listener import find_motion, measure_changes, measured_floor
    from tactile_rt.teaching.model import FewShot

    chunks: list[Chunk] = []
    for _ in range(RESTS):
        typer.echo(RESTING)
        chunks = _record_rest(source) or chunks
        if not (moved := find_motion(chunks, source.spec)):
            break
        typer.echo(f"not at rest: {moved} moved")
    else:
        typer.echo("going on without a rest: light touches will be missed")
    taught = FewShot(source.spec, measured_floor(chunks), measure_changes(chunks))
    return Lesson.begin(folder, taught)


def _record_rest(source: "Source") -> "list[Chunk]":
    from tactile_rt.core.stream import EndOfStream

    chunks: list[Chunk] = []
    samples, needed = 0, REST_S * source.spec.rate_hz
    sampled_at = time.monotonic()
    while samples < needed:
        try:
            chunk = source.read(POLL_S)
        except EndOfStream:
            break
        if chunk is not None and len(chunk):
            chunks.append(chunk)
            samples += len(chunk)
            sampled_at = time.monotonic()
        elif time.monotonic() - sampled_at > DEAF_S:
            raise SourceError(
                f"no sample came for {DEAF_S:g} s: is the device on, and the codec right?"
            )
    return chunks


def _describe_lesson(lesson: "Lesson", source: "Source") -> str:
    spec = source.spec
    size = f"{len(spec.elements)} elements x {len(spec.channels)} channels at {spec.rate_hz:g} Hz"
    noise = ", ".join(
        f"{unit} {value:.2g}"
        for unit, value in zip(spec.channels, lesson.taught.floor, strict=True)
    )
    if not lesson.touches:
        return f"{size}; the least noise that counts: {noise}"
    lost = f"; {lesson.lost} lost as it was killed" if lesson.lost else ""
    counts = ", ".join(f"{lesson.count(name)} {name}" for name in lesson.labels)
    return f"{size}; there already: {counts}{lost}"


def _say(text: str) -> None:
    if text:
        typer.echo(text)
