"""Good files of every kind with one thing changed: read rightly, told, or wrong without a word.

python -m bench.drivers.variants [-v] [KIND ...]       of table, lines, can, mesh, bag, neural, mcap

What is right is computed from what a file was made of, never by a reader. Each file goes through
the command that a user would type, in this process; meshes and neurons through what it calls.
"""

import contextlib
import io
import json
import os
import re
import shlex
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.drivers.variant_files import Variant, all_variants

VERDICTS = ("right", "told", "silent", "traceback")
TOLD = re.compile(r"[1-9]\d* (?:corrupt|missing)")


class Judgement(NamedTuple):
    """A verdict on a file, one of `VERDICTS`, and what was said, or how what was read differs."""

    verdict: str
    said: str


def call_command(*arguments: str) -> tuple[int, str, str]:
    """Call `tactile-rt` in this process; return its exit code, stdout and stderr."""
    import typer.main

    from tactile_rt.cli import main, tables

    tables.LINE_S = threading.TIMEOUT_MAX
    if not hasattr(typer.main.get_command, "cache_info"):  # made once, not for each of hundreds
        typer.main.get_command = cache(typer.main.get_command)
    out, err, argv, code = io.TextIOWrapper(io.BytesIO()), io.StringIO(), sys.argv, 0
    sys.argv = ["tactile-rt", *arguments]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 0
    finally:
        sys.argv = argv
    if code > 128:  # a signal, which the command takes for itself
        raise KeyboardInterrupt
    out.seek(0)
    return code, out.read(), err.getvalue()


def read_variant(variant: Variant, path: Path) -> tuple[Any, str]:
    """Read a file as a user would: what was read, None if refused, and what was said."""
    from tactile_rt.core.errors import TactileError
    from tactile_rt.core.stream import concatenate
    from tactile_rt.recording import Recording

    if variant.read is not None:
        try:
            read, notes = variant.read(path)
        except TactileError as error:
            return None, str(error)
        return read, "; ".join(notes)
    out, rest = path.parent / "out.mcap", list(variant.arguments)
    if rest[:1] == ["sniff"]:
        code, said, err = call_command("sniff", str(path), "--json", "-")
        command = json.loads(said)["command"] if said.startswith("{") else None
        if code or not command:
            return None, err + said
        rest = [a for a in shlex.split(command)[3:] if a != str(path)]
        rest += variant.arguments[1:] if "--rate" not in rest else []
    if rest[:1] == ["convert"]:
        code, said, err = call_command("convert", str(path), str(out.with_suffix(".npz")))
    else:
        rest = [a.replace("BESIDE", str(path.parent)) for a in rest]
        code, said, err = call_command("import", str(path), str(out), *rest)
    if "Traceback" in err:
        raise RuntimeError(err)
    if code:
        return None, err
    if rest[:1] == ["convert"]:
        with np.load(out.with_suffix(".npz")) as made:
            t_ns, values, valid = made["t_ns"], made["values"], made["valid"]
    else:
        whole = concatenate(list(Recording(out)))
        t_ns, values, valid = whole.t_ns, whole.values, whole.valid
    values = np.where(valid[:, :, None], values, np.nan).reshape(len(values), -1)
    return ((t_ns - t_ns[:1]) / 1e9, values), err or " ".join(TOLD.findall(said))


def sort_variant(variant: Variant, folder: Path) -> Judgement:
    """Read a file with one thing changed, and judge what came of it."""
    path = variant.write(folder)
    try:
        read, said = read_variant(variant, path)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1].name
        last = (str(error).strip().splitlines() or [""])[-1]
        return Judgement("traceback", f"{type(error).__name__}: {last} ({where})")
    said = " ".join(said.replace(f"{folder}/", "").split())
    if read is None:
        refusable = any(right is None for right in variant.right) and variant.needle in said
        return Judgement("right" if refusable and said else "told" if said else "silent", said)
    differs = [differ(read, right, variant) for right in variant.right]
    if "" in differs:
        fine = said or not variant.due
        return Judgement("right" if fine else "silent", said or "nothing said of what is lost")
    return Judgement("told" if said else "silent", said or max(differs, key=len))


def differ(read: Any, right: Any, variant: Variant) -> str:
    """Say how what was read differs from what is right; empty where it does not."""
    if right is None:
        return "was read"
    if variant.read is not None:
        same = np.shape(read) == np.shape(right) and (np.abs(read - right) <= 0.02).all()
        return "" if same else f"{np.round(np.ravel(read)[:4], 2)} of {np.shape(read)}"
    (times, values), (due_times, due) = _heard(*read), _heard(*right)
    if variant.prefix and len(values):
        due_times, due = due_times[: len(values)], due[: len(values)]
    if len(values) != len(due) or values.shape[1] < due.shape[1]:
        return f"{len(values)} samples of {values.shape[1]} values for {len(due)} of {due.shape[1]}"
    close = np.isclose(values[:, : due.shape[1]], due, atol=1e-3, equal_nan=True).all(axis=1)
    if not close.all():
        k = int(np.argmin(close))
        return (
            f"{(~close).sum()} samples differ: {k} is {values[k].tolist()}, not {due[k].tolist()}"
        )
    k = int(np.argmax(np.abs(times - due_times))) if len(times) else 0
    if len(times) and abs(times[k] - due_times[k]) > 2e-3:
        return f"times differ: {k} is at {times[k]:.3f} s, not {due_times[k]:.3f}"
    return ""


def _heard(times: Any, values: Any) -> tuple[Any, Any]:
    """Leave samples without a value out: to be invalid or corrupt is one here."""
    kept = ~np.isnan(values).all(axis=1)
    return times[kept] - times[kept][:1], values[kept]


def sort_variants(kinds: Sequence[str] = ()) -> list[tuple[Variant, Judgement]]:
    """Read variants of some kinds, or of all."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        for k, variant in enumerate(all_variants(Path(folder), kinds)):
            place = Path(folder) / str(k)
            place.mkdir()
            found.append((variant, sort_variant(variant, place)))
    return found


def main() -> int:
    """Print how many variants of each kind were read how, and those that are wrong; 1: any."""
    say, began, verbose = sys.stdout.write, time.process_time(), "-v" in sys.argv
    found = sort_variants([a for a in sys.argv[1:] if a != "-v"])
    counts = Counter((v.kind, v.base, o.verdict) for v, o in found)
    say(f"{'':38}" + "".join(f"{v:>10}" for v in VERDICTS) + "\n")
    for kind, base in dict.fromkeys((v.kind, v.base) for v, _ in found):
        row = "".join(f"{counts[kind, base, v]:10}" for v in VERDICTS)
        say(f"{kind:7} {base:30}{row}\n")
    total = Counter(o.verdict for _, o in found)
    say(f"{len(found):<38}" + "".join(f"{total[v]:10}" for v in VERDICTS) + "\n")
    of_bases = {(v.kind, v.base): o.verdict for v, o in found if v.change == "as it is"}
    for v, judged in found:
        wrong_base = of_bases[v.kind, v.base] != "right" and v.change != "as it is"
        if verbose or (judged.verdict in VERDICTS[2:] and not wrong_base):
            say(f"{judged.verdict:9} {v.kind}, {v.base}: {v.change}: {judged.said[:200]}\n")
    say(f"{time.process_time() - began:.0f} s of processor time\n")
    return int(total["silent"] + total["traceback"] > 0)


if __name__ == "__main__":
    sys.exit(main())
