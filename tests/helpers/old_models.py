"""Model files as earlier releases wrote them: their text is frozen here, whatever is written today.

The same network as in `tiny_model`, before files had an embedding and said what NaN is. Needs onnx.
"""

from pathlib import Path

import onnx
import onnx.parser

__all__ = ["write_old_model"]

GRAPH = """
<ir_version: 9, opset_import: ["" : 18]>
tiny (float[B,3,3,2] samples, float[B,3,2] offset, float[B,3,2] sigma,
      int64[B] steps, float[B,1] total)
  => (float[B,5] logits, int64[B] steps_next, float[B,1] total_next)
<int64[1] one = {1}, int64 first = {0}, int64[1] head = {0}, int64[1] tail = {2}>
{
  offset_k = Unsqueeze(offset, one)
  tared = Sub(samples, offset_k)
  element = Gather<axis = 2>(tared, first)
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
}
"""

METADATA = {
    1: r"""
{"name": "tiny", "spec": "{\"version\":1,\"name\":\"small\",\"elements\":[\"A0\",\"A1\",\"A2\"],
\"grid\":[[0,0],[0,1],[0,2]],\"positions\":[[0.0,0.0,0.0],[0.0,0.002,0.0],[0.0,0.004,0.0]],
\"orientations\":[[1.0,0.0,0.0,0.0],[1.0,0.0,0.0,0.0],[1.0,0.0,0.0,0.0]],
\"channels\":[\"fy\",\"mz\"],\"units\":[\"N\",\"N m\"],\"rate_hz\":1000.0,\"frame\":\"mount\"}",
"period_ns": 9000000, "substeps": 3, "steps": 4,
"labels": ["nothing", "steps", "sum", "last", "sigma"],
"state": [{"name": "steps", "shape": [], "dtype": "int64"},
{"name": "total", "shape": [1], "dtype": "float32"}],
"clip": [1.0, 1.0], "scale": [0.001, 0.001], "floor": [0.001, 0.001], "temperature": 1.0,
"provenance": {}, "figures": {"parity": 1e-06}, "version": 1}
""",
    2: r"""
{"name": "tiny", "spec": "{\"version\":1,\"name\":\"small\",\"elements\":[\"A0\",\"A1\",\"A2\"],
\"grid\":[[0,0],[0,1],[0,2]],\"positions\":[[0.0,0.0,0.0],[0.0,0.002,0.0],[0.0,0.004,0.0]],
\"orientations\":[[1.0,0.0,0.0,0.0],[1.0,0.0,0.0,0.0],[1.0,0.0,0.0,0.0]],
\"channels\":[\"fy\",\"mz\"],\"units\":[\"N\",\"N m\"],\"rate_hz\":1000.0,\"frame\":\"mount\"}",
"period_ns": 9000000, "substeps": 3, "steps": 4,
"labels": ["nothing", "steps", "sum", "last", "sigma"],
"state": [{"name": "steps", "shape": [], "dtype": "int64", "in_place": false},
{"name": "total", "shape": [1], "dtype": "float32", "in_place": false}],
"clip": [1.0, 1.0], "scale": [0.001, 0.001], "floor": [0.001, 0.001], "temperature": 1.0,
"provenance": {}, "figures": {"parity": 1e-06}, "version": 2, "kind": "step", "precision": "fp32",
"opset": 18, "hashes": {}, "thresholds": {"99 %": 0.8}, "decision": {},
"probe": [
[0.0, 1.0, -0.00987394154, -8.25268726e-05, 0.00100000005],
[0.0, 2.0, -0.0034416886, 0.000531844329, 0.00100000005],
[0.0, 3.0, 0.00261920923, 0.00130783254, 0.00100000005],
[0.0, 4.0, 0.00201300555, -1.13864025e-05, 0.00100000005]]}
""",
}


def write_old_model(path: Path, version: int) -> Path:
    """A file of version 1 or 2."""
    model = onnx.parser.parse_model(GRAPH)
    onnx.checker.check_model(model, full_check=True)
    metadata = METADATA[version].replace("\n", "")
    onnx.helper.set_model_props(model, {"tactile_rt": metadata})
    onnx.save(model, path)
    return path
