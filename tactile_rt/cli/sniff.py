"""`tactile-rt sniff`: find the codec, speed or columns that fit a port, a bus or a file."""

import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn
from urllib.parse import quote, urlencode

import typer

from tactile_rt.cli.app import app, leaving, starting
from tactile_rt.cli.options import STDOUT, Json, argument, option
from tactile_rt.cli.tables import print_table, told_as_json
from tactile_rt.core.errors import ConfigError, SpecMismatch

if TYPE_CHECKING:
    from rich.table import Table

    from tactile_rt.drivers.sniffing import CodecFit, Tried

NOTHING = 1  # exit code: nothing fits
SHOWN = 6  # fits that are listed
DESCRIBE = "frames of one length can be described: codec=binary_frame"
DOUBTFUL = 0.1  # damaged frames per intact one: more in text are a coincidence
GUESSED_HZ = 100  # placeholder if the file has no times
FORMS = {
    "hex": "bytes in hexadecimal",
    "terminal": "lines of text and when each came",
}  # fmt: skip


@app.command(epilog="tactile-rt sniff /dev/ttyUSB0 --ask")
def sniff(
    target: Annotated[str, argument("A port, can:INTERFACE:CHANNEL, a log, a table or a bag.")],
    seconds: Annotated[
        float, option("How long to listen at each baud rate, s.", min=0.05, max=60)
    ] = 0.5,
    baud: Annotated[list[int] | None, option("Baud rate to try; may be repeated.")] = None,
    further: Annotated[
        list[str] | None, option("Also try codec=NAME&OPTION=VALUE; may be repeated.", "--try")
    ] = None,
    ask: Annotated[bool, option("Also send the start command of each codec.", "--ask")] = False,
    json: Json = None,
) -> None:
    """Find the protocol of a device, a log, a table or a bag.

    Every codec, with the options that change its frames, decodes half a second of the data, on
    a port at every baud rate that codecs name. Those that fit are listed, the best first; for
    lines of text, columns are proposed. The last line is the command to continue with. Exit
    code 1: nothing fits.

    It only listens. A device that waits for a start command is found with --ask.
    """
    from tactile_rt.cli.importing import codec_fields

    out = _Output(target, json)
    tried = [codec_fields(text, "--try") for text in further or []]
    candidates: list[Tried] = [(fields.pop("codec"), fields) for fields in tried]
    path = Path(target.removeprefix("serial://").removeprefix("serial:"))
    with starting(), leaving(None):
        if target.startswith("can:"):
            _sniff_bus(target, seconds, candidates, ask, out)
        elif target.startswith(("serial:", "socket:", "rfc2217:")) or path.is_char_device():
            port = str(path) if path.exists() else target.removeprefix("serial:")
            _sniff_port(port, seconds, baud, candidates, ask, out)
        elif path.exists():
            _sniff_file(path, candidates, out)
        else:
            raise ConfigError(
                f"{target} is no port, bus or file: `tactile-rt list` shows what is plugged in"
            )


class _Output:
    """Writer of findings: prints each as it comes, and writes JSON at the end."""

    def __init__(self, target: str, json: Path | None) -> None:
        self._json, self._alone = json, json == STDOUT
        self._all: dict[str, Any] = {"target": target, "fits": [], "said": [], "command": None}

    def show(self, what: str, value: Any, table: "Table") -> None:
        """Print a table, and store its data for the JSON under the key `what`."""
        self._all[what] = value
        if not self._alone:
            print_table(table)

    def say(self, text: str) -> None:
        self._all["said"].append(text)
        if not self._alone:
            typer.echo(text)

    def end_with_command(self, *words: object) -> None:
        """Print the command to continue with as the last line; write the JSON."""
        self._all["command"] = command = shlex.join(["tactile-rt", *map(str, words)])
        if not self._alone:
            typer.echo(command)
        told_as_json(self._all, self._json)

    def end_without_result(self, what: str, hint: str = "") -> NoReturn:
        """Print that nothing was found, write the JSON, and exit with `NOTHING`."""
        self.say(f"{what}{f': {hint}' if hint else ''}")
        told_as_json(self._all, self._json)
        raise typer.Exit(NOTHING)


# lines


def _sniff_port(
    port: str, seconds: float, bauds: list[int] | None, further: "list[Tried]", ask: bool,
    out: _Output,
) -> None:  # fmt: skip
    from tactile_rt.drivers.links import SerialLink
    from tactile_rt.drivers.sniffing import ask_devices, hear_port, line_speeds, sniff_bytes
    from tactile_rt.recording.importing.table_guess import propose_line_columns

    speeds = [(b, "N") for b in bauds] if bauds else line_speeds()
    found: list[tuple[CodecFit, int]] = []
    texts: list[tuple[int, bytes]] = []
    for baud, _, data in hear_port(port, seconds, speeds):
        typer.echo(f"{baud} bit/s: {len(data)} bytes", err=True)
        found += [(fit, baud) for fit in sniff_bytes(data, further)]
        texts.append((baud, data))
    if not found and ask:
        typer.echo("asking for samples as each codec does", err=True)
        for speed in bauds or [0]:  # 0: each codec's own

            def connect(codec: Any, speed: int = speed) -> SerialLink:
                return SerialLink(port, speed or codec.baud, codec.parity)

            for _, data in ask_devices("serial", connect, seconds):
                found += [(fit, speed or _find_baud(fit)) for fit in sniff_bytes(data, further)]
    found.sort(
        key=lambda one: (
            one[0].explained * (1 + one[0].proof), one[1] == _find_baud(one[0]), one[0].intact
        ),
        reverse=True,
    )  # fmt: skip
    url = f"serial://{port}" if "://" not in port else f"serial:{port}"
    if found:
        _show([fit for fit, _ in found], out, [baud for _, baud in found])
        fit, baud = found[0]
        # over USB the bytes are the same at every speed
        usual = any(b == _find_baud(fit) for one, b in found if one.codec == fit.codec)
        _propose_run(url, fit, {} if usual else {"baud": str(baud)}, out)
        return
    printed = [(propose_line_columns(data), baud) for baud, data in texts]
    proposed = [(p.samples, baud, p.columns) for p, baud in printed if p is not None]
    if proposed:
        n, baud, columns = max(proposed)
        out.say(f"{n} lines at {baud} bit/s are samples: names and units are for you to say")
        fields = {"codec": "ascii_line", "columns": columns}
        fields |= {} if baud == 115_200 else {"baud": str(baud)}
        out.end_with_command("run", "--source", f"{url}?{_make_query(fields)}")
        return
    if not any(data for _, data in texts):
        hint = "" if ask else "try --ask: it may have to be started"
        out.end_without_result(f"nothing came from {port}", hint)
    out.end_without_result(f"nothing fits what came from {port}", DESCRIBE)


def _sniff_bus(url: str, seconds: float, further: "list[Tried]", ask: bool, out: _Output) -> None:
    from tactile_rt.drivers.opening import open_line
    from tactile_rt.drivers.sniffing import ask_devices, hear_bus, sniff_frames

    frames = hear_bus(url, seconds)
    fits = sniff_frames(frames, further)
    if not fits and ask:
        typer.echo("asking for samples as each codec does", err=True)
        for _, answer in ask_devices("can", lambda _: open_line(url), seconds):
            fits += sniff_frames(answer, further)
    if not fits:
        if not frames:
            out.end_without_result(
                f"nothing came from {url}",
                "is the bit rate right?"
                + ("" if ask else " or try --ask: the device may wait for a command"),
            )
        _show_identifiers(frames, out)
        out.end_without_result(
            f"no codec fits what came from {url}", "with a DBC file of it: codec=can-dbc"
        )
    _show(fits, out)
    _propose_run(url, fits[0], {}, out)


def _propose_run(url: str, fit: "CodecFit", further: dict[str, str], out: _Output) -> None:
    fields = fit.fields | further
    if not fit.described:
        out.say("it has not described its array here; it does when it is started")
    sign = "&" if "?" in url else "?"
    out.end_with_command("run", "--source", f"{url}{sign}{_make_query(fields)}")


def _find_baud(fit: "CodecFit") -> int:
    from tactile_rt.drivers.opening import make_codec

    codec: Any = make_codec("serial", fit.codec, dict(fit.options))
    return int(codec.baud)


# files


def _sniff_file(path: Path, further: "list[Tried]", out: _Output) -> None:
    from tactile_rt.drivers.logs import read_log
    from tactile_rt.drivers.sniffing import LOOK_BYTES, LOOK_FRAMES, sniff_bytes, sniff_frames
    from tactile_rt.recording.importing.bag_file import is_bag

    if is_bag(path):
        _sniff_bag(path, out)
        return
    if path.is_dir():
        raise ConfigError(f"{path} is a folder, and no bag: name a file")
    log = read_log(path)
    if log.form != "raw":
        typer.echo(f"{path}: {FORMS.get(log.form, f'a CAN log ({log.form})')}", err=True)
    is_can = log.wire == "can"
    start: Any = [] if is_can else bytearray()
    for packet, _ in log.packets():
        start += packet
        if len(start) >= (LOOK_FRAMES if is_can else LOOK_BYTES):
            break
    data = b"" if is_can else bytes(start)
    fits = sniff_frames(start, further) if is_can else sniff_bytes(data, further)
    # In text with rows, frames are a coincidence if many of them are damaged.
    doubtful = log.form == "raw" and data.isascii() and b"\0" not in data
    if fits and not (doubtful and fits[0].corrupt > DOUBTFUL * fits[0].intact):
        _show(fits, out)
        fields = fits[0].fields
        if not fits[0].described:
            out.say("it did not describe its array: array=FILE.json of `tactile-rt describe` does")
            fields["array"] = "FILE.json"
        out.end_with_command("import", path, "--as", _make_query(fields))
    elif is_can:
        _show_identifiers(start, out)
        for note in log.notes:
            out.say(note)
        hint = "with a DBC file of it: --as 'codec=can-dbc&mapping=FILE.toml'"
        out.end_without_result(f"no codec fits {path}", hint)
    elif log.form not in ("raw", "terminal") or not _sniff_text(path, data, log.form, out):
        out.end_without_result(f"nothing fits {path}", _describe_lack(data) or DESCRIBE)


def _sniff_text(path: Path, data: bytes, form: str, out: _Output) -> bool:
    """Propose columns for a table or for printed lines; return False if none fit."""
    from tactile_rt.recording.importing.table_guess import propose_columns, propose_line_columns

    try:
        proposed = propose_columns(path, data) if form == "raw" else propose_line_columns(data)
    except ConfigError as error:
        out.end_without_result(str(error))
    if proposed is None:
        return False
    if not proposed.columns:
        out.end_without_result(f"no columns were found that fit: {proposed.said}"[:200])
    out.say(f"{proposed.said}: names and units are for you to say")
    options: list[object] = ["--columns", proposed.columns]
    if not proposed.table:
        options = ["--as", _make_query({"codec": "ascii_line", "columns": proposed.columns})]
    elif not proposed.timed:
        which = "the header's" if proposed.rate_hz else f"not {GUESSED_HZ}"
        out.say(f"no column is a time: --rate says how many came in a second, {which}")
        options += ["--rate", f"{proposed.rate_hz or GUESSED_HZ:g}"]
    out.end_with_command("import", path, *options)
    return True


def _describe_lack(data: bytes) -> str:
    """Return a note if text has too few rows of numbers, else empty text."""
    from tactile_rt.drivers.codecs.ascii_text import fields, is_text, number
    from tactile_rt.recording.importing.table_guess import LEAST

    lines = [x for x in data.decode("utf-8", "replace").splitlines() if x.strip()]
    rows = sum(any(number(word) is not None for word in fields(line)) for line in lines)
    few = f"{rows} rows, too few to tell" if rows else "no rows"
    return f"it holds {few}" if rows < LEAST and all(map(is_text, lines)) else ""


def _sniff_bag(path: Path, out: _Output) -> None:
    from rich.table import Table

    from tactile_rt.classifier.model_card import element_order
    from tactile_rt.classifier.model_file import read_model, shipped_model
    from tactile_rt.recording import Recording
    from tactile_rt.recording.importing.bag import bag_topics, is_recording
    from tactile_rt.recording.ros2 import messages

    if is_recording(path):
        about = Recording(path).description
        out.say(f"{path}: a recording of {about.spec.name}, {about.spec.rate_hz:g} Hz")
        try:
            element_order(read_model(shipped_model())[0].array, about.spec)
        except SpecMismatch:
            out.end_with_command("teach", f"replay:{path}?speed=0", "lesson", "--classes", "A,B")
        else:
            out.end_with_command("run", "--source", f"replay:{path}")
        return
    topics = bag_topics(path)
    table = Table("topic", "type", "messages", "columns", box=None, header_style="bold")
    for topic in topics:
        table.add_row(topic.name, topic.type, str(topic.messages), topic.columns)
    out.show("topics", topics, table)
    known = [t for t in topics if t.columns or t.type == messages.SAMPLES]
    proposed = [t for t in topics if t.proposed]
    if not known and proposed:
        best = max(proposed, key=lambda t: t.messages)
        out.say(f"{best.name} has numbers: names and units are for you to say")
        out.end_with_command("import", path, "--topic", best.name, "--columns", best.proposed)
        return
    if not known:
        out.end_without_result(
            f"{path}: of no topic is known what is what", "say it with --columns"
        )
    best = max(known, key=lambda t: t.messages)
    out.end_with_command("import", path, *(["--topic", best.name] if len(known) > 1 else []))


# output


def _show(fits: "list[CodecFit]", out: _Output, speeds: Sequence[int] = ()) -> None:
    from rich.table import Table

    found = [
        vars(fit) | ({"baud": speeds[k]} if speeds else {}) for k, fit in enumerate(fits[:SHOWN])
    ]
    names = ["codec", "options", *(["baud"] if speeds else []), "intact", "corrupt", "explains"]
    table = Table(*names, "notices damage", box=None, header_style="bold")
    for one in found:
        options = "&".join(f"{a}={b}" for a, b in one["options"].items())
        shown = one | {"options": options, "explains": f"{one['explained']:.0%}"}
        proof = f"{one['proof']:.0%}" if one["wire"] == "serial" else "by CAN"
        table.add_row(*(str(shown[name]) for name in names), proof)
    out.show("fits", found, table)


def _show_identifiers(frames: "list[Any]", out: _Output) -> None:
    counts = Counter((f.id, f.extended, len(f.data)) for f in frames)
    for (number, extended, length), n in counts.most_common(12):
        out.say(f"{number:0{8 if extended else 3}X}  {n} frames of {length} bytes")


def _make_query(fields: dict[str, str]) -> str:
    # characters that shells and URLs leave as they are stay readable
    return urlencode(fields, quote_via=quote, safe=":*,.{}()[]/ -_")
