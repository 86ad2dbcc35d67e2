"""A network of an ONNX file on the CPU, and what is wrong with the file where it is none."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from artemis_edge.errors import InputError

Array = NDArray[Any]
_DTYPES: dict[str, Any] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
}
# Of one tensor: more than an image of 4096 x 4096 with sixteen channels fills the memory of small machines (1 GB).
_MOST_VALUES = 16 * 4096 * 4096
_OPSET = re.compile(r"[Oo]pset (\d+) is .*?till opset (\d+)", re.DOTALL)
_IR = re.compile(r"Unsupported model IR version: (\d+), max supported IR version: (\d+)")
_OPERATOR = re.compile(r"(?:No Op registered for (\w+)|Fatal error: ([\w.]+:\w+))")


class Network:
    """An inference session with one thread, which does not spin: the other core belongs to the mapping.

    ``inputs`` and ``outputs`` give the shape of each tensor by name; None stands for an open dimension.
    Raises InputError with one sentence where the file cannot be run.
    """

    def __init__(self, path: Path) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4  # what fails is told by us, in one sentence
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
            )  # the fallback would try the same again and print on stdout
        except Exception as error:  # the classes of onnxruntime have no base of their own
            raise InputError(f"{path.name} {_complaint(str(error), onnxruntime.__version__)}") from None
        self.file = path.name
        self.inputs = {node.name: _shape(node.shape) for node in self._session.get_inputs()}
        self.outputs = {node.name: _shape(node.shape) for node in self._session.get_outputs()}
        for name, shape in (self.inputs | self.outputs).items():
            if math.prod(side or 1 for side in shape) > _MOST_VALUES:
                sides = " x ".join(str(side or "?") for side in shape)
                raise InputError(
                    f"{self.file} has the tensor '{name}' of {sides}, too large; export it smaller"
                )
        self._dtypes = {node.name: _DTYPES.get(node.type) for node in self._session.get_inputs()}
        self.metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map

    def run(self, *values: Array) -> dict[str, Array]:
        """Outputs by name; ``values`` in the order of the inputs, converted to the types that they have.

        Raises InputError where the network cannot take them or gives values that are no numbers.
        """
        feed = {}
        for (name, dtype), value in zip(self._dtypes.items(), values, strict=True):
            if dtype is None:
                raise InputError(f"input '{name}' of {self.file} is of a type that is not known here")
            feed[name] = np.ascontiguousarray(value, dtype)
        try:
            outputs = dict(zip(self.outputs, self._session.run(None, feed), strict=True))
        except Exception as error:  # as above
            first = str(error).splitlines()[0][:200]
            raise InputError(f"{self.file} does not run on this input: {first}") from None
        with np.errstate(all="ignore"):  # a sum over everything is finite only if everything is
            if not all(np.isfinite(np.sum(value, dtype=np.float64)) for value in outputs.values()):
                raise InputError(f"{self.file} gives values that are no numbers; export it again")
        return outputs


def _shape(shape: Sequence[Any]) -> tuple[int | None, ...]:
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)


def _complaint(message: str, version: str) -> str:
    """The rest of a sentence that begins with the file's name."""
    if found := _OPSET.search(message):
        return (
            f"is of ONNX opset {found[1]}, and onnxruntime {version} runs opsets up to {found[2]}; "
            "export the model again with an older opset, for example 17"
        )
    if found := _IR.search(message):
        return (
            f"is of ONNX format (IR) {found[1]}, and onnxruntime {version} reads up to {found[2]}; "
            "export the model again with an older onnx package"
        )
    if found := _OPERATOR.search(message):
        operator = found[1] or found[2]
        return f"uses the operator {operator}, which onnxruntime {version} does not have; export it without"
    if "protobuf" in message.lower() or "codec can't decode" in message:
        return "is not a complete ONNX file; it may be truncated: download or export it again"
    if "external" in message.lower():
        return "keeps its weights in another file; save the model as one file"
    return f"cannot be run by onnxruntime {version} ({message.splitlines()[0][:200]}); export it again"
