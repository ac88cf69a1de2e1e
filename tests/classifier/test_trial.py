"""Models on trial: what they need is known before they are let in, and hostile ones are not."""

import ast
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.classifier import trial
from tactile_rt.classifier.classifier import ABSURD, IMPLAUSIBLE
from tactile_rt.classifier.model_file import hash_of, load_model, shipped_model
from tactile_rt.classifier.trial import TrialLimits, try_model
from tactile_rt.core.errors import ModelError
from tests.helpers.hostile_models import BURNERS, GREEDY, SHAPED, UNSOUND, write_burdened
from tests.helpers.tiny_model import GRAPH, write_model
from tests.helpers.waiting import PATIENCE_S, until

LARGEST_CHILD = 400_000_000  # bytes: onnxruntime, Python, and what a trial may take
PROMPT_S = 20.0  # on a busy machine; alone 0.3


# Whose children are only the one on trial.
JUDGE = """
import json, resource, sys
from pathlib import Path
from tactile_rt.classifier.trial import try_model
from tactile_rt.core.errors import ModelError
try:
    try_model(Path(sys.argv[1]))
    said = ""
except ModelError as error:
    said = str(error)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([said, used.ru_utime + used.ru_stime, 1024 * used.ru_maxrss]))
"""


def test_the_shipped_model_says_what_it_needs() -> None:
    found = try_model(shipped_model())
    assert found.sha256 == hash_of(shipped_model())
    assert 0 < found.step_s < 0.045 and 0 < found.load_s < PROMPT_S and 0 < found.memory_mb < 256


@pytest.mark.parametrize("name", GREEDY)
def test_one_that_wants_more_memory_than_it_may_is_refused(name: str, tmp_path: Path) -> None:
    file = write_burdened(tmp_path / "m.onnx", GREEDY[name])
    found = subprocess.run(
        [sys.executable, "-c", JUDGE, file], stdout=subprocess.PIPE, check=True, timeout=PATIENCE_S
    )
    said, processor_s, largest = json.loads(found.stdout)
    assert "\n" not in said and str(file) in said and "limits.model_mb = 256 MB" in said
    assert processor_s < 2.0
    assert largest < LARGEST_CHILD


@pytest.mark.parametrize("name", BURNERS)
def test_one_that_takes_longer_than_it_may_is_refused_when_its_time_is_over(
    name: str, tmp_path: Path
) -> None:
    file = write_burdened(tmp_path / "m.onnx", BURNERS[name])
    began = time.monotonic()
    with pytest.raises(ModelError, match=r"limits\.model_(s = 2 s|mb)"):
        try_model(file, TrialLimits(seconds=2.0))
    assert time.monotonic() - began < 2.0 + PROMPT_S


@pytest.mark.parametrize("name", UNSOUND)
def test_one_that_is_not_sound_is_refused_for_what_it_is(name: str, tmp_path: Path) -> None:
    UNSOUND[name](tmp_path / "m.onnx")
    with pytest.raises(ModelError, match="is not a readable ONNX model"):
        try_model(tmp_path / "m.onnx")


@pytest.mark.parametrize("name", SHAPED)
def test_one_that_makes_a_shape_of_what_is_measured_is_refused(name: str, tmp_path: Path) -> None:
    """A trial cannot make every touch, so what it needs must not follow the touch."""
    with pytest.raises(
        ModelError, match=f"operator '{name}' computes a shape from measured values"
    ):
        try_model(write_burdened(tmp_path / "m.onnx", SHAPED[name]))


@pytest.mark.parametrize(("smallest", "of"), [(0.05, "a touch"), (5.0, "the largest loads")])
def test_one_whose_answer_is_no_number_is_refused(smallest: float, of: str, tmp_path: Path) -> None:
    """At rest it answers, so that nobody would notice before the first touch."""
    sick = "far = Abs(last)\n room = Sub(limit, far)\n zero = Sqrt(room)"
    graph = GRAPH.replace("zero = Sub(last, last)", sick)
    graph = graph.replace("float none = {0}", f"float none = {{0}}, float limit = {{{smallest}}}")
    file = write_model(tmp_path / "m.onnx", graph)
    with pytest.raises(ModelError, match=f"refused: its logits for {of} are not finite$"):
        try_model(file)


def test_a_large_file_may_take_more(tmp_path: Path) -> None:
    """Four times its size is allowed beside what all may have."""
    limits = TrialLimits(memory_mb=16.0)
    with pytest.raises(ModelError, match=r"limits\.model_mb = 16 MB"):
        try_model(write_burdened(tmp_path / "m.onnx", GREEDY["kept_2_GB"]), limits)
    assert try_model(write_model(tmp_path / "tiny.onnx"), limits).memory_mb < 16


def test_it_is_tried_at_rest_on_a_touch_of_its_card_and_beyond_what_any_sensor_gives() -> None:
    card = load_model(shipped_model())[1]
    loads = {name: loads for name, _, loads in trial._list_loads(card)}
    decided = [name for name, decides, _ in trial._list_loads(card) if decides]
    assert decided == ["rest", "a touch", "the largest loads"]
    assert not loads["rest"].any() and np.isnan(loads["no numbers"]).all()
    touch = loads["a touch"] / card.clip
    assert len(touch) == card.steps and touch[0] == pytest.approx(touch[-1])  # it grows and goes
    assert touch[0].max() < 0.1 and 0.2 <= touch[card.steps // 2].min() < 0.25
    assert 0.95 < touch.max() <= 1
    for name, size in (
        ("the largest loads", IMPLAUSIBLE * np.array(card.clip)),
        ("absurd loads", ABSURD),
    ):
        middle = loads[name][1]
        assert abs(middle) == pytest.approx(np.broadcast_to(size, middle.shape))
        assert (middle > 0).any() and (middle < 0).any()


@pytest.mark.parametrize(
    ("code", "why"),
    [
        (-signal.SIGXCPU, "more than limits.model_s = 7 s of the processor"),
        (-signal.SIGKILL, "it needs more memory than limits.model_mb = 256 MB"),
        (trial.MEMORY, "it needs more memory than limits.model_mb = 256 MB"),
        (3, "its trial ended with exit code 3"),
    ],
)
def test_how_a_trial_ended_is_told(code: int, why: str) -> None:
    with pytest.raises(ModelError, match=f"^m.onnx is refused: {why}"):
        trial._read_result(Path("m.onnx"), TrialLimits(seconds=7.0), code, b"")


def test_memory_is_what_the_limit_counts() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    assert trial._read_data_bytes() == pytest.approx(pages * resource.getpagesize(), rel=0.1)


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's")
def test_a_trial_dies_with_whoever_started_it(tmp_path: Path) -> None:
    file = write_burdened(tmp_path / "m.onnx", BURNERS["chained_products"])
    code = (
        "from pathlib import Path; from tactile_rt.classifier.trial import try_model; "
        f"try_model(Path({str(file)!r}))"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )

    def children() -> list[int]:
        found = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
        return [int(pid) for pid in found]

    until(lambda: children() != [])
    (child,) = children()
    until(lambda: b"trial" in Path(f"/proc/{child}/cmdline").read_bytes())
    # by then it has said whom it dies with
    until(lambda: b"onnxruntime" in Path(f"/proc/{child}/maps").read_bytes())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until(lambda: not Path(f"/proc/{child}").exists())


def test_a_child_whose_parent_had_died_before_it_could_say_so_tries_nothing() -> None:
    task = {"path": "m.onnx", "every": 0, "limits": {}, "parent": 1}
    child = [sys.executable, "-m", trial.__name__]
    done = subprocess.run(child, input=json.dumps(task).encode(), stdout=subprocess.PIPE)
    assert done.returncode == 1 and not done.stdout


LIMITED = """
import os, resource, signal, sys
import tactile_rt.classifier.model_file as model_file
import tactile_rt.classifier.trial as trial
from tactile_rt.core.errors import ModelError

def load_model(path, *others):
    kinds = resource.RLIMIT_CPU, resource.RLIMIT_CORE, resource.RLIMIT_DATA
    score = open("/proc/self/oom_score_adj").read().strip()
    deaf = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    raise ModelError(f"{[resource.getrlimit(k) for k in kinds]}, {os.nice(0)}, {score}, {deaf}")

model_file.load_model = load_model
sys.exit(trial._main())
"""


def limits_of(path: Path) -> list:
    """What the child of a trial may: processor time, core file, memory; niceness, and its turn to
    go where memory runs out."""
    task = {"path": str(path), "every": 0, "limits": {"memory_mb": 300.0, "seconds": 7.0}}
    done = subprocess.run(
        [sys.executable, "-c", LIMITED], input=json.dumps(task), capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return ast.literal_eval(f"[{json.loads(done.stdout)['refused']}]")


def test_the_child_limits_itself_before_it_loads(tmp_path: Path) -> None:
    small, large = tmp_path / "small.onnx", tmp_path / "large.onnx"
    small.write_bytes(b"x")
    large.write_bytes(bytes(50_000_000))
    (cpu, core, data), nice, score, deaf = limits_of(small)
    (_, _, more), *_ = limits_of(large)
    assert score == 1000 and deaf  # to Ctrl-C, which is for the parent
    assert cpu == (9, 10) and core == (0, 0) and nice >= 5
    assert data[0] == data[1] > 300e6
    assert more[0] - data[0] == pytest.approx(200e6, abs=20e6)  # four times the file
