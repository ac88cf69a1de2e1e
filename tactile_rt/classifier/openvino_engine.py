"""Model files run by OpenVINO on the CPU, in float32 or with products in bfloat16.

Only `engines` imports this, when OpenVINO was chosen.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import openvino

from tactile_rt.classifier.model_card import ModelCard, one_line
from tactile_rt.classifier.model_file import check_graph, read_model
from tactile_rt.classifier.network import Network, Tensor
from tactile_rt.classifier.runtime import FlushDenormals
from tactile_rt.errors import ModelError

__all__ = ["open_openvino"]

DEVICE = "CPU"
MESSAGE = 300  # characters of what OpenVINO has us say
TYPES = {"f32": "float", "f64": "double", "i64": "int64", "i32": "int32", "boolean": "bool"}


def open_openvino(path: Path, precision: str, threads: int) -> tuple[Network, ModelCard]:
    """Read a file of kind ``step``; it is compiled for as many lanes as it is bound to.

    Args:
        path: the ``.onnx`` file.
        precision: ``f32`` or ``bf16``, of products and what lies between them. State, inputs and
            outputs keep their types.
        threads: that may share one operator.

    Raises:
        ModelError: as `read_model`; the graph disagrees with its metadata, or OpenVINO cannot run
            it: int8 files use operators of onnxruntime's own.
    """
    card, _, data = read_model(path, "step")
    try:
        model = openvino.Core().read_model(data)
    except Exception as error:  # a plain RuntimeError, of several lines
        raise _refused(path, error) from None
    inputs = {port.any_name: _described(port) for port in model.inputs}
    outputs = {name: _described(port) for port in model.outputs for name in port.names}
    check_graph(card, inputs, outputs, path)
    return _OpenVINONetwork(path, model, precision, threads), card


class _OpenVINONetwork:
    device = "cpu"
    in_place = False  # how it writes rows is not known
    providers: tuple[str, ...] = ()

    def __init__(self, path: Path, model: Any, precision: str, threads: int) -> None:
        self._path, self._model = path, model
        first = model.inputs[0].partial_shape[0]
        self.batch = first.get_length() if first.is_static else None
        self._options = {
            "INFERENCE_PRECISION_HINT": precision,
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,  # the robot has other work for its cores
        }
        self._compiled: Any = None

    def bind(
        self, inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor]
    ) -> Callable[[], object]:
        try:
            if self._compiled is None:
                # Of known shapes it makes faster code: 0.35 ms a step where others took 0.46.
                self._model.reshape({name: t.array.shape for name, t in inputs.items()})
                with FlushDenormals():  # which in the end puts the thread's mode back
                    self._compiled = openvino.Core().compile_model(
                        self._model, DEVICE, self._options
                    )
            request = self._compiled.create_infer_request()
            for name, tensor in (*inputs.items(), *outputs.items()):
                shared = openvino.Tensor(tensor.array, shared_memory=True)
                request.set_tensor(name, shared)
        except Exception as error:
            raise _refused(self._path, error) from None
        infer: Callable[[], object] = request.infer
        return infer


def _described(port: Any) -> tuple[tuple[Any, ...], str]:
    """(shape with None where it is not known, element type as onnxruntime writes it)"""
    kind = port.element_type.get_type_name()
    axes = port.partial_shape
    if axes.rank.is_dynamic:
        return (), f"tensor({TYPES.get(kind, kind)})"
    shape = tuple(axis.get_length() if axis.is_static else None for axis in axes)
    return shape, f"tensor({TYPES.get(kind, kind)})"


def _refused(path: Path, error: Exception) -> ModelError:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    said = next((line for line in lines if not line.startswith(("Exception from", "Check '"))), "")
    return ModelError(f"{path}: OpenVINO cannot run it: {one_line(said)[:MESSAGE]}")
