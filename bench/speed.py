"""Is this checkout as fast as another one? The same work in both, in turn, in CPU time.

python -m bench.speed OTHER_CHECKOUT [--pairs 10] [--most 60] [--only NAME]

Each measurement is a process of its own that does a fixed amount of work with what its checkout
has, and prints the CPU seconds of each figure. The two checkouts take turns, so that whatever else
the machine does meets both. Reported is the median over the pairs of this checkout's time over the
other's, with a bootstrap 95 % interval of it; 1 is returned if an interval lies above 1.05.
Names move between releases: `find` looks for where a checkout defines them.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

HERE = Path(__file__).parents[1]
PAIRS, MOST, RESAMPLES, SLOWER = 10, 60, 10_000, 1.05
WIDTH = 0.04  # of the interval of a ratio
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
Work = tuple[Callable[[], object], int]  # what is timed, and how often it is done


def module_of(name: str, near: str = "") -> str | None:
    """The module of the checkout that defines a name, of those with `near` in their path."""
    definition = re.compile(rf"^(class|def) {name}\b|^{name}\b[^=\n]*= ", re.MULTILINE)
    for root in ("tactile_rt", "bench"):
        for path in sorted(Path(root).rglob("*.py")):
            if near in str(path) and definition.search(path.read_text(encoding="utf-8")):
                return ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    return None


def find(*names: str, near: str = "") -> Any:
    """The first of these names that the checkout has; a `LookupError` if it has none."""
    for name in names:
        if module := module_of(name, near):
            return getattr(import_module(module), name)
    raise LookupError(f"no {' nor '.join(names)} in {near or 'the checkout'}")


def synthetic(seconds: float, elements: int = 35) -> Any:
    """A synthetic array at 1 kHz, as fast as it is read."""
    options = find("SyntheticOptions")(1000.0, seconds, pace="fast")
    return find("SyntheticSource")(f"{elements}x6", options)


def decode() -> Iterator[tuple[str, Work]]:
    """Every codec on what its device sends, packet by packet."""
    near = "drivers/fuzzing"
    with find("all_codecs", near=near)() as codecs:
        for name, make in codecs.items():
            codec, packets = make(), find("wire_of", near=near)(make())

            def feed(codec: Any = codec, packets: Any = packets) -> None:
                for packet in packets:
                    codec.feed(packet, 1)

            yield f"decode {name}", (feed, 200)


def classify() -> Iterator[tuple[str, Work]]:
    """The shipped model on four seconds of stream."""
    model = find("shipped_model")()
    spec, stream = find("load_model")(model)[1].array, list(synthetic(4.0, 30))
    classifier = find("Classifier", near="classifier")

    def push() -> None:
        one = classifier(model, spec)
        for chunk in stream:
            one.push(chunk)

    yield "classifier, 4 s of stream", (push, 2)


def sweep() -> Iterator[tuple[str, Work]]:
    """A mug that goes by, a third of a second of each profile."""
    array, mug = find("load_array")("mouse"), find("load_object")("mug-50")
    way, profiles = find("Sweep", near="sim_backend/sweep")(), find("PROFILES", near="world")
    for name in ("dataset", "realtime"):
        simulation = find("SweepSimulation")(array, mug, way, profiles[name])
        yield f"sweep, {name}", (lambda s=simulation: s.advance(100), 3)  # type: ignore[misc]


def train() -> Iterator[tuple[str, Work]]:
    """An update of a small network."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)
    config = find("EADConfig")(24, "zhuang-intersection-ln", "none", width=1 / 8)
    step = find("training_step")(find("EAD", near="ead")(config), torch.randn(8, 22, 30, 5, 7))
    yield "training step", (step, 3)


def align() -> Iterator[tuple[str, Work]]:
    """Two animals frozen as a benchmark, twenty layers scored against them."""
    import numpy as np

    rng = np.random.default_rng(0)
    animals = {name: find("_animal", near="align")(rng) for name in "ab"}
    layers = {f"layer-{i}": rng.normal(size=(6, 256)) for i in range(20)}
    freeze, score = find("freeze_paper_code"), find("score", near="alignment/scoring")
    frozen = freeze(animals, 50)
    yield "alignment, freezing", (lambda: freeze(animals, 50), 10)
    yield "alignment, scoring", (lambda: score(frozen, layers), 100)


def record() -> Iterator[tuple[str, Work]]:
    """Ten seconds of 35 x 6 written and read."""
    source, writer, read = synthetic(10.0), find("StreamWriter"), find("read_stream", "Recording")
    stream = list(source)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stream.mcap"

        def write() -> None:
            path.unlink(missing_ok=True)
            with writer(path, source) as file:
                for chunk in stream:
                    file.push(chunk)

        yield "recording, writing 10 s", (write, 6)
        yield "recording, reading 10 s", (lambda: list(read(path)), 6)


def encode() -> Iterator[tuple[str, Work]]:
    """A second of 35 x 6 as messages, and for the page."""
    kind, stream = find("SourceChunk", "Samples", near="daemon/items"), synthetic(1.0)
    items = [kind("a", stream.spec, chunk, int(chunk.t_ns[-1]), 0) for chunk in stream]
    put, message = find("encode", near="daemon/messages"), find("message_of")
    feed = find("Feed", near="daemon/page")()
    yield "messages, 1 s", (lambda: [put(message(item)) for item in items], 8)
    yield "page, 1 s", (lambda: feed.take(items, {"a"}), 100)


def onboard() -> Iterator[tuple[str, Work]]:
    """What a robot's program imports: the first time is what counts."""
    wanted = (("open_source", "source"), ("Classifier", "classifier"), ("Session", "session"))
    modules = [module_of(*one) or "tactile_rt" for one in wanted]
    yield "import on board", (lambda: [import_module(name) for name in modules], 1)


ALL = (decode, classify, sweep, train, align, record, encode, onboard)
WORKS = {work.__name__: work for work in ALL}


def cpu_s(work: Callable[[], object], times: int) -> float:
    """CPU time of doing this so often, s; what the first call does once is not counted."""
    for _ in range(min(times - 1, 1)):
        work()
    began = time.process_time()
    for _ in range(times):
        work()
    return time.process_time() - began


def ask(checkout: Path, name: str) -> dict[str, float]:
    """The same, in a process of its own."""
    command = [sys.executable, "-P", __file__, "--measure", name, str(checkout)]
    environment = {**os.environ, **ENVIRONMENT, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, cwd=checkout, env=environment, stdout=subprocess.PIPE)
    found: dict[str, float] = {} if done.returncode else json.loads(done.stdout)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path, help="the checkout to compare with")
    parser.add_argument("--pairs", type=int, default=PAIRS, help="of processes, for each figure")
    parser.add_argument("--most", type=int, default=MOST, help="pairs, while it is too wide")
    parser.add_argument("--only", action="append", choices=WORKS)
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        figures = WORKS[args.measure]()
        print(json.dumps({figure: cpu_s(*work) for figure, work in figures}))  # noqa: T201
        return 0
    import numpy as np

    other, rng, slower = args.other.resolve(), np.random.default_rng(0), 0

    def interval(found: list[float]) -> tuple[float, float]:
        draws = np.median(rng.choice(found, (RESAMPLES, len(found))), axis=1)
        low, high = np.percentile(draws, (2.5, 97.5))
        return float(low), float(high)

    for name in args.only or WORKS:
        pairs: dict[str, list[float]] = {}
        for k in range(args.most + 1):
            order = (HERE, other) if k % 2 else (other, HERE)
            taken = {checkout: ask(checkout, name) for checkout in order}
            for figure in taken[HERE].keys() & taken[other].keys() if k else ():  # 0 warms up
                pairs.setdefault(figure, []).append(taken[HERE][figure] / taken[other][figure])
            if k >= args.pairs and all(
                high - low <= WIDTH for low, high in map(interval, pairs.values())
            ):
                break
        for figure, found in sorted(pairs.items()):
            low, high = interval(found)
            slower += high > SLOWER
            line = f"{figure:<28}{np.median(found):7.3f} [{low:.3f}, {high:.3f}] {len(found)} pairs"
            print(line + (" SLOWER" if high > SLOWER else ""), flush=True)  # noqa: T201
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
