"""A model file whose logits say what the runtime fed it, so that every feed can be checked.

    logits = [0, steps so far, sum of all windows, last sample, sigma]
    embedding = [steps so far, last sample]

of the first channel of the first element, sample and sum less the offset; what is not finite is
at rest. Needs onnx, not torch.
"""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import onnx.parser

from tactile_rt.classifier.enrolment import LOG_ODDS, IdentityRule
from tactile_rt.classifier.model_file import METADATA_KEY, ModelCard, StateTensor
from tactile_rt.testing import small_spec

PERIOD_NS = 9_000_000
SUBSTEPS, STEPS = 3, 4
LABELS = ("nothing", "steps", "sum", "last", "sigma")

GRAPH = """
<ir_version: 9, opset_import: ["" : 18]>
tiny (float[B,3,3,2] samples, float[B,3,2] offset, float[B,3,2] sigma,
      int64[B] steps, float[B,1] total)
  => (float[B,5] logits, float[B,2] embedding, int64[B] steps_next, float[B,1] total_next)
<int64[1] one = {1}, int64 first = {0}, int64[1] head = {0}, int64[1] tail = {2},
 float none = {0}, float most = {3e38}>
{
  offset_k = Unsqueeze(offset, one)
  load = Sub(samples, offset_k)
  size = Abs(load)
  known = Less(size, most)
  deviation = Where(known, load, none)
  element = Gather<axis = 2>(deviation, first)
  channel = Gather<axis = 2>(element, first)
  sum = ReduceSum<keepdims = 1>(channel, one)
  total_next = Add(total, sum)
  last = Gather<axis = 1>(channel, tail)
  steps_next = Add(steps, one)
  steps_float = Cast<to = 1>(steps_next)
  steps_column = Unsqueeze(steps_float, one)
  noise = Gather<axis = 1>(sigma, first)
  noise_column = Gather<axis = 1>(noise, head)
  zero = Sub(last, last)
  logits = Concat<axis = 1>(zero, steps_column, total_next, last, noise_column)
  embedding = Concat<axis = 1>(steps_column, last)
}
"""

# An episode at once, of any number of steps; its logits say nothing.
WINDOW = """
<ir_version: 9, opset_import: ["" : 18]>
tiny (float[B,T,3,3,2] samples, float[B,3,2] offset, float[B,3,2] sigma)
  => (float[B,T,5] logits, float[B,T,2] embedding)
<int64[2] axes = {3, 4}, int64[1] width = {2}, int64[3] same = {1, 1, 5},
 int64[3] twice = {1, 1, 2}, int64[2] steps = {1, 2}, float none = {0}, float most = {3e38}>
{
  offset_k = Unsqueeze(offset, steps)
  load = Sub(samples, offset_k)
  size = Abs(load)
  known = Less(size, most)
  deviation = Where(known, load, none)
  spread = ReduceSum<keepdims = 0>(deviation, axes)
  first = ReduceSum<keepdims = 1>(spread, width)
  logits = Tile(first, same)
  embedding = Tile(first, twice)
}
"""

CARD = ModelCard(
    name="tiny",
    spec=small_spec().to_json(),
    period_ns=PERIOD_NS,
    substeps=SUBSTEPS,
    steps=STEPS,
    labels=LABELS,
    state=(StateTensor("steps", (), "int64"), StateTensor("total", (1,), "float32")),
    clip=(1.0, 1.0),
    scale=(1e-3, 1e-3),
    floor=(1e-3, 1e-3),
    embedding=2,
)


def write_model(
    path: Path, graph: str = GRAPH, metadata: str | None = None, **changes: Any
) -> Path:
    """Write the model with some fields of its card changed, or with other metadata altogether."""
    model = onnx.parser.parse_model(graph)
    onnx.checker.check_model(model, full_check=True)
    if metadata is None:
        metadata = msgspec.json.encode(msgspec.structs.replace(CARD, **changes)).decode()
    if metadata:
        onnx.helper.set_model_props(model, {METADATA_KEY: metadata})
    onnx.save(model, path)
    return path


def identity_rule(spread: float, between: tuple[float, ...], *thresholds: float) -> IdentityRule:
    """Of touches that differ by so much in each unit, and objects by `between` times that."""
    units, among = len(between), (1, 5)[: len(thresholds) // 10]
    directions = (np.eye(units) / spread).astype("<f2").tobytes()
    return IdentityRule(
        LOG_ODDS, 0.05, among, thresholds, 40, bytes(2 * units), directions, between
    )


def force_rule() -> IdentityRule:
    """Of this model: objects differ by their last sample, N, touches of one by half of one."""
    return identity_rule(0.5, (1e-6, 100.0), *[0.5] * 10)


def logits_of(probabilities: np.ndarray, temperature: float = 1.0) -> np.ndarray:
    """The logits behind a posterior of this model, whose first one is zero."""
    evidence = np.log(probabilities.astype(np.float64)) * temperature
    logits: np.ndarray = evidence - evidence[0]
    return logits
