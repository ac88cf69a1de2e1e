"""Small good files of every kind, and each with one thing changed that people's files have.

What needs no reckoning is a row of variants.toml: how a kind is written, and plain changes of it.
"""

import base64
import random
import shutil
import struct
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

N, HZ, UTC = 40, 100, 1_700_000_000
EVERY = list(range(N))
T = np.arange(N) / HZ
VALUES = np.stack([0.5 * np.arange(N) - 3, 0.25 - 0.75 * np.arange(N)], axis=1)  # N
WHOLE = (T, VALUES)
TABLES = tomllib.loads(Path(__file__).with_name("variants.toml").read_text("utf-8"))
BUS: dict[str, Any] = {
    "arguments": ["--as", "codec=can-dbc&mapping=BESIDE/force.toml"],
    "beside": {name: text.encode() for name, text in TABLES["beside a bus"].items()},
}
BOX = np.array([1 / 3, 2 / 3, 1, 1.0])  # extents, the largest 1, and the share that is filled


@dataclass(frozen=True)
class Variant:
    """A file with one thing changed.

    Attributes:
        form: A row of text, `begin` when the first is, `cells` between its cells.
        timed: Whether samples have times of their own.
        right: What may be read, any of these; None is a refusal, and `needle` in it.
        due: Whether something is lost, so that a note or a count is due.
        prefix: Whether the first samples alone are right.
        read: Reads the file instead of the command line, and returns notes, too.
    """

    kind: str
    base: str
    name: str = "a.csv"
    arguments: Sequence[str] = ()
    change: str = "as it is"
    form: str = ""
    begin: str = "2024-02-28"
    comma: bool = False
    cells: str = ""
    timed: bool = True
    head: Sequence[str] = ()
    rows: Sequence[str] = ()
    eol: str = "\n"
    encoding: str = "utf-8"
    data: bytes | None = None
    before: bytes = b""
    after: bytes = b""
    beside: Mapping[str, bytes] = field(default_factory=dict)
    right: tuple[Any, ...] = (WHOLE,)
    needle: str = ""
    due: bool = False
    prefix: bool = False
    read: Callable[[Path], tuple[Any, Sequence[str]]] | None = None

    def content(self) -> bytes:
        """Return the bytes of the file."""
        text = "".join(one + self.eol for one in (*self.head, *self.rows))
        body = text.encode(self.encoding) if self.data is None else self.data
        return self.before + body + self.after

    def write(self, folder: Path) -> Path:
        """Write the file, and what belongs beside it."""
        for name, data in {**self.beside, self.name: self.content()}.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
        return (folder / self.name).parent if self.name.endswith(".db3") else folder / self.name

    def but(self, change: str, **changes: Any) -> "Variant":
        """Return it with one thing changed."""
        return replace(self, change=change, **changes)

    def put(self, k: int, *new: str) -> tuple[str, ...]:
        """Return the rows with others in place of row k."""
        return (*self.rows[:k], *new, *self.rows[k + 1 :])

    def of_rows(self, order: Sequence[int]) -> tuple[Any, ...]:
        """Return the samples of some rows; of those without times, at their places or in a row."""
        order = sorted(order) if self.timed else list(order)
        at = (T[order], VALUES[order])
        return (at,) if self.timed else (at, (np.arange(len(order)) / HZ, VALUES[order]))

    def timed_as(self, times: Sequence[float], counts: Sequence[int] = EVERY) -> tuple[str, ...]:
        """Return the rows at other times."""
        rows = []
        for t, k, (x, y) in zip(times, counts, VALUES, strict=True):
            us, data = round(1e6 * t), _frame(k, x, y)
            spaced = data.hex(" ").upper()
            when = datetime.fromisoformat(self.begin) + timedelta(microseconds=us)
            row = self.form.format(
                x=x, y=y, t=t, ms=t * 1e3, us=us, utc=UTC + t, n=k + 1, when=when,
                millis=when.microsecond // 1000, base64=base64.b64encode(data).decode(),
                spaced=spaced, packed=spaced.replace(" ", ""), commas=spaced.replace(" ", ","),
            )  # fmt: skip
            rows.append(row.replace(".", ",") if self.comma else row)
        return tuple(rows)


def _frame(k: int, x: float, y: float) -> bytes:
    return struct.pack(">hhHH", round(100 * x), round(100 * y), k, 7)


def _blank(*rows: int, column: int = 0) -> tuple[Any, Any]:
    values = VALUES.copy()
    values[list(rows), column] = np.nan
    return T, values


def _kept(rows: Sequence[int]) -> tuple[Any, ...]:
    return ((T[rows], VALUES[rows]),)


def _without(*rows: int) -> list[int]:
    return [k for k in EVERY if k not in rows]


# fmt: off


def change_bytes(b: Variant, *tables: str) -> Iterator[Variant]:
    """Change a file as any may be changed, and as the rows of some tables say."""
    yield b
    for change, told in (row for name in ("any file", *tables) for row in TABLES[name].items()):
        fields = {k: v.encode("latin-1") if k in ("data", "before", "after") else v
                  for k, v in told.items() if k != "refused"}
        yield b.but(change, **fields, right=(None,) if "refused" in told else b.right)
    for suffix in random.Random(b.base).sample(("mcap", "bag", "stl", "blf", "csv", "bin"), 2):
        if not b.name.endswith(suffix) and b.kind != "mesh" and not b.beside:
            yield b.but(f"named .{suffix}", name=f"a.{suffix}", right=(*b.right, None))


def change_binary(b: Variant) -> Iterator[Variant]:
    """Change a file that is no text."""
    yield from change_bytes(b, "any binary")
    data, maybe = b.content(), (*b.right, None)
    for share in (0.95, 0.6, 0.2):
        part = data[: int(share * len(data))]
        yield b.but(f"cut at {share:.0%}", data=part, due=True, prefix=True, right=maybe)
    half = len(data) // 2
    for change, odd in {
        "its begin lost": data[64:], "twice in one file": data + data,
        "text above": b"downloaded from\n" + data,
        "zeros in its middle": data[:half] + bytes(64) + data[half + 64 :],
    }.items():
        yield b.but(change, data=odd, right=maybe)


def change_lines(b: Variant, rng: random.Random, *tables: str) -> Iterator[Variant]:
    """Change rows, their order and the text of any log of lines."""
    yield from change_bytes(b, "any text", "any lines", *tables)
    k, rows = rng.randrange(5, N - 5), tuple(b.rows)
    above, below, less = rows[:k], rows[k + 1 :], b.of_rows(_without(k))
    part, whole, first = rows[k][: 2 * len(rows[k]) // 5], b.content(), b.of_rows(EVERY[:k])
    twice = (np.arange(2 * N) / HZ, np.concatenate([VALUES, VALUES]))
    mixed, double = (*EVERY[:k], k + 1, k, *EVERY[k + 2 :]), b.of_rows([*EVERY[:k], k, *EVERY[k:]])
    once = (WHOLE,) if b.timed else ()
    both = double if b.kind == "lines" or not b.timed else ()
    yield b.but("rows swapped", rows=[rows[i] for i in mixed], right=b.of_rows(mixed))
    yield b.but("a row doubled", rows=b.put(k, rows[k], rows[k]), right=(*once, *both))
    yield b.but("a row missing", rows=b.put(k), right=less)
    yield b.but("first row missing", rows=rows[1:], right=b.of_rows(EVERY[1:]))
    yield b.but("ends between rows", rows=above, right=first)
    yield b.but("ends in a row", rows=(*above, part), right=first, due=True)
    yield b.but("a row cut", rows=b.put(k, part), right=less, due=True)
    yield b.but("NULs for a row", rows=b.put(k, "\0" * len(rows[k])), right=less, due=True)
    yield b.but("two rows in one", rows=(*above, part + rows[k + 1], *rows[k + 2 :]), due=True,
                right=(*b.of_rows(_without(k, k + 1)), *less))
    yield b.but("no line end at the end", data=whole[:-1])
    yield b.but("twice in one file", after=whole, right=(twice, None), due=b.timed)
    yield b.but("one row", rows=rows[:1], right=(*b.of_rows([0]), None))
    if b.head:
        yield b.but("head alone", rows=(), right=(None,))
        yield b.but("head again in the middle", rows=b.put(k, *b.head, rows[k]))
    if "relative" in b.base:  # which the head alone tells
        return
    yield b.but("begins in a row", rows=(rows[k][-3:], *below), head=(), due=True,
                right=(None, *b.of_rows(EVERY[k + 1 :])))
    if b.timed:
        gap, reset = np.where(T < T[k], T, T + 3), np.where(T < T[k], T, T - T[k])
        early, far = np.where(np.arange(N) % 10 == 7, T - 0.025, T), np.where(T == T[k], 9e8, T)
        moved = (np.sort(early), VALUES[np.argsort(early, kind="stable")])
        yield b.but("a gap", rows=b.timed_as(gap, [round(t * HZ) for t in gap]),
                    right=((gap, VALUES),))
        yield b.but("from another time", rows=b.timed_as(T + 77.77))
        yield b.but("clock begins again", rows=b.timed_as(reset), due=True)
        yield b.but("stamps 25 ms early", rows=b.timed_as(early), right=(WHOLE, moved))
        yield b.but("one time far off", rows=b.timed_as(far), right=(WHOLE, *less), due=True)
    if b.timed and b.kind != "can":  # whose frames share no time
        coarse = np.repeat(T[::4], 4)
        yield b.but("four rows a time", rows=b.timed_as(coarse), right=(WHOLE, (coarse, VALUES)))


def change_table(b: Variant, rng: random.Random) -> Iterator[Variant]:
    """Change the cells of a table as well."""
    yield from change_lines(b, rng, "any table")
    k, sniffs, heads = rng.randrange(5, N - 5), b.arguments[0] == "sniff", list(b.head)
    cells, less = [row.split(b.cells) for row in b.rows], b.of_rows(_without(k))
    at, gone = len(cells[0]) - 2, (_blank(k), *less)

    def made(change: str, new: Sequence[Sequence[str]], **more: Any) -> Variant:
        return b.but(change, rows=[b.cells.join(row) for row in new], **more)

    def put(value: str, *rows: int) -> list[list[str]]:
        return [[*c[:at], value, *c[at + 1 :]] if i in rows else c for i, c in enumerate(cells)]

    for value in rng.sample(TABLES["blanks"], 4):
        if value or b.cells != " ":
            yield made(f"{value!r} for a number", put(value, k), right=gone)
            yield made(f"{value!r} in the first rows", put(value, 0, 1),
                       right=(_blank(0, 1), *(b.of_rows(EVERY[2:]) if sniffs else ())))
    yield made("a word for a number", put("E", k), due=True, right=gone)
    if b.cells != "," and not b.comma:
        comma = cells[k][at].replace(".", ",")
        yield made("a comma in one row", put(comma, k), right=(WHOLE, *gone))
    more = [[*row, "7"] if i == k else row for i, row in enumerate(cells)]
    yield made("a cell more in a row", more, due=True, right=(WHOLE, *less))
    yield made("quoted", [[f'"{c}"' for c in row] for row in cells])
    yield made("spaces before numbers", [[f" {c}" for c in row] for row in cells])
    if b.cells != " ":
        yield made("a delimiter at the ends", [[*row, ""] for row in cells])
    yield made("a column more", [[*row, str(i % 7)] for i, row in enumerate(cells)],
               head=[b.cells.join([one, "n"]) for one in heads],
               right=(WHOLE,) if heads or sniffs else (WHOLE, None))
    if not sniffs:
        fewer = [c[:at] + c[at + 1 :] for c in (row.split(b.cells) for row in heads)]
        yield made("a column less", [row[:at] + row[at + 1 :] for row in cells], right=(None,),
                   head=[b.cells.join(row) for row in fewer])
    if heads:
        named = b.right if sniffs else (None,)
        renamed = heads[0].replace("Fx", "Kraft")
        yield b.but("a column renamed", head=[renamed, *heads[1:]], right=named)
        yield b.but("names in capitals", head=[heads[0].upper(), *heads[1:]])
        yield b.but("head lost", head=(), right=named)
        yield b.but("head after a row", head=(b.rows[0], *heads), rows=b.rows[1:],
                    right=(WHOLE, *b.of_rows(EVERY[1:]), None))


def change_terminal(b: Variant, rng: random.Random) -> Iterator[Variant]:
    """Change what boards print."""
    yield from change_lines(b, rng, "any terminal")
    k, rows = rng.randrange(5, N - 5), tuple(b.rows)
    yield b.but("a line of words", rows=b.put(k, "WARNING: brown-out", rows[k]))
    for value in ("nan", "ovf", "-", ""):
        odd = rows[k].replace(f"{VALUES[k, 0]:.4f}", value)
        yield b.but(f"{value!r} for a number", rows=b.put(k, odd),
                    right=(_blank(k), *b.of_rows(_without(k))))


def change_bus(b: Variant, rng: random.Random) -> Iterator[Variant]:
    """Change a log of a bus."""
    if b.data is not None:
        yield from change_binary(b)
        return
    yield from change_lines(b, rng)
    k, rows, relative = rng.randrange(5, N - 5), tuple(b.rows), "relative" in b.base
    other = [row.replace("1A0", "1B0").replace("1a0", "1b0") for row in rows]
    yield b.but("another identifier alone", rows=other, right=(None,))
    if not relative:
        both = [one for pair in zip(rows, other, strict=True) for one in pair]
        yield b.but("another identifier between", rows=both)
    if " 8 " in rows[0]:
        short = rows[k].replace(" 8 ", " 4 ", 1)[:-12]
        empty = rows[0].replace(" 8 ", " 0 ", 1)[:-24]
        for change, at, odd in (("a short frame", k, short), ("an empty frame first", 0, empty)):
            yield b.but(change, rows=b.put(at, odd), due=True, right=b.of_rows(_without(at)))
    if b.base.startswith("asc"):
        yield b.but("with its end", after=b"End TriggerBlock\n")
    if b.base.startswith("asc") and not relative:
        error = f"{rows[k].split()[0]} 1  ErrorFrame"
        yield b.but("an error frame", rows=b.put(k, error, rows[k]))


def make_texts(folder: Path, kind: str) -> Iterator[Variant]:
    """Yield good texts of a kind; of a bus, what python-can writes, too."""
    for told in TABLES[kind]:
        b = Variant(kind, **{**(BUS if kind == "can" else {}), **told})
        yield replace(b, rows=b.timed_as(T))
        if b.base == "asc":
            head = [one.replace("absolute", "relative") for one in b.head]
            rows = b.timed_as(np.where(T > 0, 1 / HZ, 0))
            yield replace(b, base="asc, relative", head=head, rows=rows)
    if kind == "can":
        import can

        for suffix in ("blf", "db", "trc", "asc"):
            path = folder / f"made.{suffix}"
            with can.Logger(path) as file:
                for k, t in enumerate(T):
                    data = _frame(k, *VALUES[k])
                    file(can.Message(UTC + t, 0x1A0, False, data=data, channel=0))
            base = f"{suffix} of python-can"
            yield Variant(kind, base, f"a.{suffix}", data=path.read_bytes(), **BUS)


def make_bags(folder: Path) -> Iterator[Variant]:
    """Yield bags of wrenches and arrays, each with one thing changed."""
    def less(k: int, odd: list[float], column: int = 0) -> tuple[Any, ...]:
        return EVERY, {k: odd}, (_blank(k, column=column), *_kept(_without(k)))

    changes: dict[str, tuple[Any, ...]] = {
        "as it is": (EVERY, {}, (WHOLE,)),
        "messages swapped": ([*range(9), 10, 9, *range(11, N)], {}, (WHOLE,)),
        "a message doubled": ([*range(10), *range(9, N)], {}, (WHOLE,)),
        "a message missing": (_without(9), {}, _kept(_without(9))),
        "not a number": less(9, [np.nan, VALUES[9, 1]]),
        "not a number first": less(0, [np.nan, VALUES[0, 1]]),
        "no message": ([], {}, (None,)),
        "an empty message first": (EVERY, {0: []}, _kept(EVERY[1:])),
        "an empty message": (EVERY, {9: []}, _kept(_without(9))),
        "a short message": less(9, [VALUES[9, 0]], column=1),
        "short messages first": (EVERY, {k: [VALUES[k, 0]] for k in range(4)},
                                 (_blank(*range(4), column=1), *_kept(EVERY[4:]))),
        "a long message": (EVERY, {9: [*VALUES[9], 7.0]}, (WHOLE,)),
    }
    stamped = {"without time": T * 0, "that begin again": np.where(T < 0.2, T, T - 0.2)}
    for form in ("bag", "db3", "mcap"):
        for kind in ("wrench", "array"):
            b = Variant("bag", f"{form}, {kind}", f"a/a.{form}")
            for change, (order, odd, right) in changes.items():
                if kind == "array" or all(len(values) == 2 for values in odd.values()):
                    made = write_bag(folder / "bag", form, kind, order, odd)
                    v = b.but(change, **made, right=right)
                    yield from change_binary(v) if change == "as it is" else [v]
            for change, stamps in stamped.items() if kind == "wrench" else ():
                made = write_bag(folder / "bag", form, kind, EVERY, {}, stamps)
                yield b.but(f"headers {change}", **made, due="again" in change)


def write_bag(folder: Path, form: str, kind: str, order: Sequence[int], odd: Mapping[int, Any],
              stamps: Any = T) -> dict[str, Any]:
    """Write a bag of messages in an order; return its data, and what lies beside."""
    from rosbags.rosbag1 import Writer as Ros1Writer
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    ros1 = form == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    name, types = "geometry_msgs/msg/WrenchStamped", store.types
    name = name if kind == "wrench" else "std_msgs/msg/Float64MultiArray"
    vector = types["geometry_msgs/msg/Vector3"]
    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    path = folder / ("a.bag" if ros1 else "a")
    file: Any = Ros1Writer(path) if ros1 else Writer(path, version=9, storage_plugin=plugin)
    with file:
        topic = file.add_connection("/touch", name, typestore=store)
        for i in order:
            values = odd.get(i, VALUES[i])
            if kind == "wrench":
                ns = round((UTC + stamps[i]) * 1e9) if np.any(stamps) else 0
                time = types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
                head = types["std_msgs/msg/Header"](*([0] if ros1 else []), time, "tool0")
                force, torque = vector(*values, 1.0), vector(0.0, 0.0, 0.0)
                message = types[name](head, types["geometry_msgs/msg/Wrench"](force, torque))
            else:
                layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
                message = types[name](layout, np.asarray(values, dtype=float))
            data = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, name)
            file.write(topic, UTC * 10**9 + round(T[i] * 1e9), data)
    files = [path] if ros1 else list(path.iterdir())
    beside = {f"a/{p.name}": p.read_bytes() for p in files if form == "db3" and p.suffix == ".yaml"}
    return {"data": next(p for p in files if p.suffix == f".{form}").read_bytes(), "beside": beside}


def make_meshes() -> Iterator[Variant]:
    """Yield good meshes of a box, 1 : 2 : 3."""
    import trimesh

    box = trimesh.creation.box([1, 2, 3])
    turned = box.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    for base in ("obj", "stl_ascii", "ply", "off", "dae", "glb", "stl"):
        more = {"encoding": "ascii"} if base == "ply" else {}
        data = (turned if base in ("glb", "dae") else box).export(file_type=base, **more)
        b = Variant("mesh", base, f"a.{base[:3]}", right=(BOX,), read=_read_mesh)
        if base in ("glb", "stl"):
            yield replace(b, data=data)
        else:
            text = data if isinstance(data, str) else data.decode()
            yield replace(b, rows=text.strip().split("\n"))


def change_mesh(b: Variant, rng: random.Random) -> Iterator[Variant]:
    """Change a mesh."""
    maybe, rows = (BOX, None), tuple(b.rows)
    if b.data is not None:
        for one in change_binary(b):
            right = (None,) if "cut" in one.change else one.right
            yield replace(one, prefix=False, right=maybe if "after" in one.change else right)
        return
    for one in change_bytes(b, "any text"):
        loose = "after" in one.change or one.change in ("UTF-16", "CR at line ends")
        yield replace(one, right=maybe if loose else one.right)
    for share in (0.9, 0.7, 0.4):
        end = int(share * len(rows))
        yield b.but(f"cut at {share:.0%}", rows=(*rows[:end], rows[end][:4]), right=(None,))
        if b.base != "obj":  # which tells no counts
            yield b.but(f"cut between rows at {share:.0%}", rows=rows[:end], right=(None,))
    yield b.but("head lost", rows=rows[max(1, len(rows) // 5) :], right=(None,))
    k = next(i for i, r in enumerate(rows) if "0.5" in r and ("float_a" in r or b.base != "dae"))
    for value in ("nan", "1e400", "0,5", "x"):
        odd = rows[k].replace("-0.5", value, 1).replace(f"{value}0000000", value)
        yield b.but(f"{value} for a number", rows=b.put(k, odd), right=(None,))
    for name in ("stl", "obj", "ply", "off", "glb"):
        if not b.name.endswith(name):
            yield b.but(f"named .{name}", name=f"a.{name}", right=maybe)
    if b.base in ("obj", "off"):
        at = [i for i, row in enumerate(rows) if row.startswith(("f ", "3 "))][3]
        far = rows[at].rsplit(" ", 1)[0] + " 99"
        yield b.but("index too large", rows=b.put(at, far), right=(None,))
    if b.base == "obj":
        faces = [[i.split("/")[0] for i in row[2:].split()] for row in rows if row[:2] == "f "]
        points = [row for row in rows if row[:2] == "v "]
        backward = [" ".join(["f", *(str(int(i) - 9) for i in f)]) for f in faces]
        yield b.but("negative indices", rows=(*points, *backward))
        normals = [" ".join(["f", *(f"{i}//1" for i in f)]) for f in faces]
        yield b.but("normals", rows=(*points, "vn 0 0 1", *normals))
        yield b.but("inside out", rows=(*points, *(" ".join(["f", *f[::-1]]) for f in faces)))
        yield b.but("a face doubled", rows=(*rows, rows[at]))
        grouped = ("mtllib gone.mtl", "o a", *rows[:9], "g b", *rows[9:])
        yield b.but("objects and groups", rows=grouped)


def _read_mesh(path: Path) -> tuple[Any, Sequence[str]]:
    from tactile_rt.sim_backend.objects.meshes import load_mesh

    thing = load_mesh(path)
    pieces = thing.pieces
    bounds = np.array([p.bounds for p in pieces])
    extents = bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)
    volume = sum(float(abs(p.volume)) for p in pieces)
    notes = ["not closed, taken as plates"] if thing.made_by == "plates" else []
    return np.append(extents / extents.max(), volume / extents.prod()), notes


def make_sessions(folder: Path) -> Iterator[Variant]:
    """Yield sessions of neurons, each with one thing changed."""
    import h5py

    from tactile_rt.alignment.example import Brain
    from tactile_rt.alignment.example_files import write_example

    home, _ = write_example(folder / "brain", Brain(mice=1, sessions=1, units=6, trials=5))
    path = next(home.rglob("*.nwb"))
    with h5py.File(path) as file:
        ends, times = file["units/spike_times_index"][()], file["units/spike_times"][()]
        trials, behavior = file["intervals/trials"], file["processing/behavior"]
        begin, stop = trials["start_time"][()], trials["choice_time"][()]
        good = np.flatnonzero(trials["outcome"][()] == b"correct")
        touched = [behavior[n]["start_time"][()] for n in behavior if n.startswith("contacts")]
    touches, units = np.sort(np.concatenate(touched)), np.split(times, ends[:-1])
    right = np.zeros((len(good), len(units)))
    for i, trial in enumerate(good):
        first, last = touches[touches >= begin[trial]][0], stop[trial]
        bins = len(np.arange(first, last + 0.045, 0.045)) - 1
        right[i] = [((u >= first) & (u < last)).sum() / (bins * 0.045) for u in units]
    b = Variant("neural", "nwb", "a.nwb", read=_read_session, right=(right,))

    def made(change: str, parts: Sequence[Any] = units, **columns: Any) -> Variant:
        odd = folder / "odd.nwb"
        odd.write_bytes(path.read_bytes())
        with h5py.File(odd, "r+") as file:
            del file["units/spike_times"], file["units/spike_times_index"]
            file["units/spike_times"] = np.concatenate(parts)
            file["units/spike_times_index"] = np.cumsum([len(p) for p in parts])
            for name, values in columns.items():
                file[f"intervals/trials/{name}"][...] = values
        return b.but(change, data=odd.read_bytes())

    for v in change_binary(replace(b, data=path.read_bytes())):
        yield replace(v, prefix=False)
    of_times: dict[str, Callable[[Any], Any]] = {
        "clock begins again": lambda t: np.r_[t[: len(t) // 2], t[len(t) // 2 :] - 50],
        "backwards": lambda t: t[::-1], "negative": lambda t: t - 5000, "late": lambda t: t + 5000,
        "half negative": lambda t: np.where(t < np.median(t), t - 5000, t), "ms": lambda t: 1e3 * t,
        "samples": lambda t: np.round(3e4 * t), "doubled": lambda t: np.repeat(t, 2),
        "not a number": lambda t: np.where(t < 40, np.nan, t), "none": lambda t: t[:0],
        "twice": lambda t: np.r_[t, t],
    }
    for change, of in of_times.items():
        yield made(f"a unit's times: {change}", [of(units[0]), *units[1:]])
        yield made(f"all units' times: {change}", [of(t) for t in units])
    yield made("a unit twice", [units[1], *units[1:]])
    yield made("recording ends early", [t[t < 40] for t in units])
    row, half = np.arange(len(begin)) == good[4], np.arange(len(begin)) < len(begin) // 2
    back = np.where(half, 0, begin[~half][0] - 5)
    for change, (start, end) in {
        "begin at 0": (0 * begin, stop), "in ms": (1e3 * begin, 1e3 * stop),
        "one at 0": (np.where(row, 0, begin), stop), "begin again": (begin - back, stop - back),
        "one without time": (np.where(row, np.nan, begin), stop), "late": (begin + 100, stop + 100),
        "one without length": (begin, np.where(row, begin, stop)),
        "one too long": (begin, np.where(row, stop + 60, stop)),
    }.items():
        yield made(f"trials: {change}", start_time=start, choice_time=end)


def _read_session(path: Path) -> tuple[Any, Sequence[str]]:
    from tactile_rt.alignment.building import checked_sessions

    sessions, notes = checked_sessions([path])
    return sessions[0].rates, [n for n in notes if not n.startswith("spikes on the")]


def make_recordings(folder: Path) -> Iterator[Variant]:
    """Yield recordings, each with one thing changed."""
    from tactile_rt.recording.importing.table import import_table
    from tactile_rt.recording.importing.table_form import csv_form, read_table

    table, path, out = next(make_texts(folder, "table")), folder / "made.csv", folder / "made.mcap"
    path.write_bytes(table.content())
    import_table(read_table(path, csv_form(path)), out, table.arguments[1])
    b = Variant("mcap", "recording", "a.mcap", ("convert",), data=out.read_bytes())
    yield from change_binary(b)


def all_variants(folder: Path, kinds: Sequence[str] = ()) -> Iterator[Variant]:
    """Yield every variant of some kinds, or of all."""
    changes = {"table": change_table, "lines": change_terminal, "can": change_bus,
               "mesh": change_mesh}
    makers = {"bag": make_bags, "neural": make_sessions, "mcap": make_recordings}
    for kind in kinds or (*changes, *makers):
        if kind in makers:
            yield from makers[kind](folder)
        else:
            for b in make_meshes() if kind == "mesh" else make_texts(folder, kind):
                yield from changes[kind](b, random.Random(b.base))
