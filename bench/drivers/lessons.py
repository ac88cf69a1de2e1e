"""Teaching on emulated sensors: over lines in real time, and by the same touches in process.

`python -m bench.drivers.lessons [--devices bota,xela] [--drawings 1] [--busy]`. Of each drawing
five kinds are taught by ten touches each, as `teach` does, and tested by 20; three strange ones are
tested by ten, again where one class had 2, 3, 5 touches. In brackets: above that in process.
"""

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from itertools import takewhile
from multiprocessing import Process
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic_ns, sleep
from types import SimpleNamespace
from typing import Any

import numpy as np

from bench.drivers.sensor_touches import RESTS_S, SENSORS, TAUGHT, Drawing, draw_touches
from bench.emulated import PRIORITY, LoopedSource
from bench.processes import Helper
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.session import Session
from tactile_rt.cli.teach import _begin, _teach
from tactile_rt.core.stream import NS_PER_S
from tactile_rt.drivers.emulation.device import EmulatedCan, EmulatedSerial
from tactile_rt.sources.opening import open_source
from tactile_rt.teaching.lesson import MODEL
from tactile_rt.teaching.teacher import Teacher

NAMED_S, LAST_S, START_S, FEW = 0.25, 3.0, 60.0, (2, 3, 5)  # before a touch; after the last
FIGURES = ("known", "refused", *(f"of {n}" for n in FEW), "missed", "split", "mistaught")


def run_lesson(opened: Any, drawn: Drawing, now: Any, began_ns: int) -> dict[str, float]:
    """Teach and test, where the touches' time began at `began_ns` of the clock `now`."""
    starts, taught, heard = drawn.starts, drawn.kinds[: drawn.tested], []
    due = [(start_s - NAMED_S, kind) for start_s, kind in zip(starts, taught, strict=False)]
    due.append((starts[drawn.tested] - RESTS_S[1], "done"))
    who = SimpleNamespace(listen=lambda: None)
    who.next = lambda: due.pop(0)[1] if due and began_ns + due[0][0] * NS_PER_S < now() else ""
    end_ns = began_ns + (starts[-1] + LAST_S) * NS_PER_S

    def judge(decisions: Any) -> dict[str, float]:
        return drawn.judge(((d.onset_ns - began_ns) / 1e9, d.label) for d in decisions if d.final)

    with TemporaryDirectory() as folder:
        with opened() as source:
            lesson = _begin(Path(folder) / "lesson", source)
            _teach(Teacher(lesson, list(dict.fromkeys(taught)), TAUGHT), source, "", who)
        lesson.learn()
        with Session(opened(), Classifier(lesson.folder / MODEL, drawn.spec)) as session:
            heard += takewhile(lambda _: now() < end_ns, session)
        row = judge(one for _, decisions in heard for one in decisions)
        row["mistaught"] = sum(abs(lesson.count(kind) - TAUGHT) for kind in set(taught))
        strange_ns = began_ns + (starts[drawn.strange] - LAST_S) * NS_PER_S
        few = next(kind for kind in taught if kind not in drawn.too_fast)
        many, some = ([t for t in lesson.touches if (t.label == few) == own] for own in (0, 1))
        for n in FEW:
            lesson.touches = many + some[:n]
            lesson.learn()
            model = Classifier(lesson.folder / MODEL, drawn.spec)
            strange = (chunk for chunk, _ in heard if chunk.t_ns[0] > strange_ns)
            row[f"of {n}"] = judge(d for chunk in strange for d in model.push(chunk))["refused"]
    return row


def play(pipe: Any, name: str, drawn: Drawing) -> None:
    """Be a sensor: say its URL, then when its first sample was due, until nobody listens."""
    with suppress(OSError):  # a device has a processor of its own; where that is allowed
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    made = EmulatedCan if SENSORS[name].wire == "can" else EmulatedSerial
    with made(LoopedSource(drawn.spec, drawn.signal), name) as device:
        pipe.send(f"{device.url}&start_s={START_S:g}")
        while not device._began_ns:
            sleep(0.01)
        pipe.send(device._began_ns)
        pipe.poll(None)


def measure(name: str, drawing: int) -> tuple[dict[str, float], dict[str, float], set[str]]:
    """The figures over a line, and in process; the kinds that do not count."""
    drawn = draw_touches(name, drawing)
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # what `teach` says
    with Helper(play, name, drawn) as device:
        url = device.hear(START_S)
        open_source(url).close()  # which starts it
        at_ns = device.hear()
        line = run_lesson(lambda: open_source(url), drawn, monotonic_ns, at_ns)
    inside, rate_hz = LoopedSource(drawn.spec, drawn.signal), drawn.spec.rate_hz
    inside.close = lambda: None  # it goes on when it is opened again
    row = run_lesson(lambda: inside, drawn, lambda: NS_PER_S * inside._sent / rate_hz, 0)
    return line, row, drawn.too_fast


def show(title: str, rows: list[Any]) -> dict[str, float]:
    """Print means, and return those over lines; `above`: of refusals."""
    line, inside = ({f: np.mean([row[k][f] for row in rows]) for f in FIGURES} for k in (0, 1))
    told = "".join(f"{f} {line[f]:.1f} ({line[f] - inside[f]:+.1f})  " for f in FIGURES)
    left_out = ", ".join(sorted(set().union(*(row[2] for row in rows))))
    sys.stdout.write(f"{title:18}{told}{left_out and 'not counted: ' + left_out}\n")
    sys.stdout.flush()
    return {**line, "above": line["refused"] - inside["refused"]}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.drivers.lessons")
    parser.add_argument("--devices", default=",".join(SENSORS))
    parser.add_argument("--drawings", type=int, default=6)
    parser.add_argument("--side-by-side", type=int, default=15)
    parser.add_argument("--busy", action="store_true", help="beside two busy loops")
    asked = parser.parse_args()
    rows: dict[str, list[Any]] = {name: [] for name in asked.devices.split(",")}
    os.environ["OMP_NUM_THREADS"] = "1"  # as `teach` has it
    for _ in range(2 * asked.busy):
        Process(target=exec, args=("while True: pass",), daemon=True).start()
    with ProcessPoolExecutor(asked.side_by_side, max_tasks_per_child=1) as pool:
        jobs = {pool.submit(measure, n, k): (n, k) for k in range(asked.drawings) for n in rows}
        for job in as_completed(jobs):
            rows[jobs[job][0]].append(job.result())
            show("{} {}".format(*jobs[job]), [job.result()])
    means = [show(name, measured) for name, measured in rows.items()]
    line = show("all", [row for measured in rows.values() for row in measured])
    bars = {
        "known": (line["known"], 92),
        "known, worst sensor": (min(one["known"] for one in means), 86),
        "refused, above in process, worst sensor": (min(one["above"] for one in means), -5),
        **{f"refused, {n} touches of one class": (line[f"of {n}"], 70) for n in FEW},
    }
    for what, (value, bar) in bars.items():
        sys.stdout.write(f"{what}: {value:.1f} >= {bar}{'' if value >= bar else '  MISSED'}\n")
    return int(any(value < bar for value, bar in bars.values()))


if __name__ == "__main__":
    sys.exit(main())
