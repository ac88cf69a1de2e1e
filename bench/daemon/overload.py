"""Three times as much to do as the machine can: how old are the decisions that are published?

python -m bench.daemon.overload

Two arrays on emulated lines, a model on each, and either six programs that compute beside the
daemon, at its own priority, for every two cores, or a model of which a step takes 135 ms where the
network's step is 45 ms of the stream. A peer of zmq says how old each decision is in its hand.
"""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
from onnx import helper, numpy_helper
from rich.console import Console

from bench.daemon.accounts import account, recorded
from bench.daemon.disturbed import DisturbedDaemon
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import load_model
from tactile_rt.models.evaluation.records import Record, show

QUICK_S, WHOLE_S = 15.0, 60.0
HOGS_PER_CORE = 3
HOG = "while True: pass"
STEP_MS = 135.0
WIDE = 512  # of the products that make a step slow
STATED_MS = 150.0


def overload(quick: bool) -> list[Record]:
    """Both ways to have too much to do."""
    seconds = QUICK_S if quick else WHOLE_S
    return [*_hogs(seconds), *_slow_model(seconds)]


def slow_down(path: Path, step_ms: float) -> float:
    """Make a model's step take so long, ms, by products that do not change what it says; what it
    takes then, ms."""
    plain, products, took = path.read_bytes(), 0, _step_ms(path)
    for _ in range(6):
        each = max(0.05, (took - _step_ms_of(plain, path)) / products) if products else 1.0
        products = max(1, products + round((step_ms - took) / each))
        path.write_bytes(plain)
        _add_products(path, products)
        took = _step_ms(path)
        if abs(took - step_ms) < 0.05 * step_ms:
            break
    return took


def _step_ms_of(plain: bytes, path: Path) -> float:
    path.write_bytes(plain)
    return _step_ms(path)


def _add_products(path: Path, products: int) -> None:
    model = onnx.load(path)
    graph = model.graph
    rng = np.random.default_rng(0)
    matrix = (rng.normal(size=(WIDE, WIDE)) / np.sqrt(WIDE)).astype(np.float32)
    graph.initializer.append(numpy_helper.from_array(matrix, "burn"))
    graph.initializer.append(numpy_helper.from_array(np.zeros((), np.float32), "burn_none"))
    graph.initializer.append(numpy_helper.from_array(np.array([0], np.int64), "burn_first"))
    (out,) = (o for o in graph.output if o.name == "logits")
    for node in graph.node:
        for i, name in enumerate(node.output):
            if name == "logits":
                node.output[i] = "logits_before"
    # Of an input, so that nothing is computed beforehand.
    nodes = [
        helper.make_node("ReduceMax", ["sigma"], ["burn_input"], keepdims=0),
        helper.make_node("Mul", ["burn", "burn_input"], ["burn_0"]),
    ]
    for n in range(products):
        nodes.append(helper.make_node("MatMul", [f"burn_{n}", "burn"], [f"burn_{n + 1}"]))
    nodes += [
        helper.make_node("ReduceMax", [f"burn_{products}"], ["burn_most"], keepdims=0),
        helper.make_node("Mul", ["burn_most", "burn_none"], ["burn_zero"]),
        helper.make_node("Add", ["logits_before", "burn_zero"], [out.name]),
    ]
    graph.node.extend(nodes)
    onnx.save(model, path)


def _step_ms(path: Path) -> float:
    _, card = load_model(path)
    stepper = Classifier(path, card.array)._stepper
    took = []
    for _ in range(9):
        began = time.perf_counter()
        stepper.run()
        took.append(time.perf_counter() - began)
    return 1e3 * min(took)  # on a busy machine the others say more of it than of the model


def _hogs(seconds: float) -> list[Record]:
    count = HOGS_PER_CORE * (os.cpu_count() or 1)
    hogs: list[subprocess.Popen[bytes]] = []

    def begin(scene: DisturbedDaemon) -> None:
        hogs.extend(subprocess.Popen([sys.executable, "-c", HOG]) for _ in range(count))

    try:
        return _measure("hogs", seconds, lambda path: None, begin, f"{count} programs that compute")
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def _slow_model(seconds: float) -> list[Record]:
    took = [0.0]

    def prepare(path: Path) -> None:
        took[0] = slow_down(path, STEP_MS)

    records = _measure(
        "slow_model", seconds, prepare, lambda scene: None, "a step of 135 ms every 45 ms"
    )
    return [*records, Record("daemon.overload.slow_model_step", took[0], "ms", "", "alone")]


def _measure(
    name: str,
    seconds: float,
    prepare: Callable[[Path], None],
    begin: Callable[[DisturbedDaemon], None],
    what: str,
) -> list[Record]:
    with DisturbedDaemon(prepare=prepare) as scene:
        _, card = load_model(scene.model)
        peer = _Peer(scene.ports["zmq"], card.period_ns)
        begin(scene)
        time.sleep(seconds)
        heard = peer.stop()
        state, played, code = scene.finish()
        files = sorted((scene.folder / "recordings").glob("*.mcap"))
        lost = 0
        told = []
        for source in state["sources"]:
            part = source["part"]["name"].partition(".")[2]
            wire = "serial" if part == "whiskers" else "slcan"
            found = account(wire, played[part], source["stats"], recorded(files, part).seq)
            lost += found.unbalanced + found.unexplained + found.miscounted
            told.append(found.told)
    models = {m["source"]: m for m in state["models"]}
    how = (
        f"{what}, {seconds:g} s; "
        + ", ".join(f"{n}: {m['skipped']} skips, {m['late']} late" for n, m in models.items())
    )  # fmt: skip
    records = []
    for source in models:
        mine = [h for h in heard if h.source == source]
        for where, ages in (
            ("published", [h.published_ms for h in mine]), ("heard", [h.age_ms for h in mine])
        ):  # fmt: skip
            p50, p99, most = np.percentile(ages or [np.inf], (50, 99, 100), method="lower").tolist()
            records.append(
                Record(
                    f"daemon.overload.{name}_{source}_{where}_age_p99", p99, "ms",
                    f"<= {STATED_MS:g}" if where == "published" else "",
                    f"p50 {p50:.1f}, worst {most:.1f} of {len(mine)} decisions", how,
                )
            )  # fmt: skip
    unmarked = sum(h.age_ms > STATED_MS and not h.late for h in heard)
    return [
        *records,
        Record(f"daemon.overload.{name}_not_marked", unmarked, "decisions", "== 0", "", "old ones"),
        Record(f"daemon.overload.{name}_lost", lost, "samples", "== 0", "", "; ".join(told)),
        Record(f"daemon.overload.{name}_exit_code", code, "", "== 0"),
    ]  # fmt: skip


@dataclass(frozen=True)
class HeardDecision:
    """A decision in a peer's hand.

    Attributes:
        source: Name of its source.
        age_ms: Age of its newest sample then, ms; the peer had to wait for its turn, too.
        published_ms: Age of its newest sample when the message was written, ms.
        late: Whether it was marked as late.
    """

    source: str
    age_ms: float
    published_ms: float
    late: bool


class _Peer:
    """Hears decisions, and how old each one's newest sample is then."""

    def __init__(self, port: int, half_ns: int) -> None:
        self._port, self._half_ns = port, half_ns
        self._heard: list[HeardDecision] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def stop(self) -> list[HeardDecision]:
        """All that was heard."""
        self._over.set()
        self._thread.join(10)
        return self._heard

    def _listen(self) -> None:
        import zmq

        context: Any = zmq.Context()
        with context, context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.RCVTIMEO, 100)
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.SUBSCRIBE, b"")
            socket.connect(f"tcp://127.0.0.1:{self._port}")
            while not self._over.is_set():
                try:
                    topic, line = socket.recv_multipart()
                except zmq.Again:
                    continue
                now = time.monotonic_ns()
                if topic.endswith(b"decision"):
                    message = msgspec.json.decode(line)
                    age = (now - message["t_ns"] - self._half_ns) / 1e6
                    self._heard.append(
                        HeardDecision(message["source"], age, message["age_ms"], message["late"])
                    )


def main() -> None:
    """Print the table."""
    show(overload("--quick" in sys.argv), Console())


if __name__ == "__main__":
    main()
