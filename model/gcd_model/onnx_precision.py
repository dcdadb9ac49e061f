"""Narrower numbers in a graph that was exported in float32: half precision, or weights of eight bits.

Pure: a model of `onnx` in, a model out. What goes in and out of a graph stays float32.
"""

from typing import Any

import numpy as np

from gcd_model.onnx_manifest import ExportPrecision

# onnx publishes no types for its messages
# pyright: reportMissingTypeStubs=false

_WIDE = frozenset({"InstanceNormalization", "LayerNormalization", "ReduceMean", "ReduceSum", "Softmax", "Resize"})
"""Sums over many numbers, which half precision would lose or overflow in."""

_WEIGHTS = {"Conv": 0, "Gemm": 0, "MatMul": 1}
"""Operators whose second input is a matrix of weights, and the axis of its outputs."""

_SMALLEST = 1024  # fewer numbers save nothing
_FLOAT, _HALF = 1, 10  # onnx.TensorProto.DataType


def narrowed(model: Any, precision: ExportPrecision) -> Any:
    """The model with its weights in that precision; it is changed in place.

    float16: everything computes in half precision but norms and softmax. int8: weights of convolutions and matrix
    products are stored as whole numbers with a scale for every output channel, and widened when they are used: what is
    computed is float32.
    """
    if precision == "float16":
        return _half(model)
    return _eight_bits(model) if precision == "int8" else model


def _half(model: Any) -> Any:
    """onnxruntime's own converter gives two casts one name where a value feeds two norms; hence this one."""
    graph = model.graph
    nodes, casts = list(graph.node), _Casts(graph)
    del graph.node[:]
    for value in graph.input:
        casts.narrow(value.name)
    for node in nodes:
        casts.take(node)
    for value in graph.output:
        casts.give(value.name)
    casts.halve_weights()
    del graph.value_info[:]  # they state what is no longer so
    return model


class _Casts:
    """Goes through a graph in its order and puts a cast wherever the two precisions meet.

    A float32 value NAME of the old graph is NAME:half in the new one; beside it stands NAME, where anything wants it.
    """

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.weights = {each.name: each for each in graph.initializer}
        values = (*graph.input, *graph.output, *graph.value_info)
        self.floats = {each.name for each in values if each.type.tensor_type.elem_type == _FLOAT}
        self.floats |= {name for name, each in self.weights.items() if each.data_type == _FLOAT}
        self.wide = {each.name for each in graph.input} | set(self.weights)  # there in float32
        self.halved: set[str] = set()  # weights that are wanted in half precision

    def take(self, node: Any) -> None:
        """One node of the old graph, its inputs and outputs renamed."""
        if node.op_type in _WIDE:
            for name in node.input:
                self.give(name)
            self.graph.node.append(node)
            made: list[str] = list(node.output)
            for name in made:
                self.wide.add(name)
                self.narrow(name)
            return
        self._state_half(node)
        for names in (node.input, node.output):
            for i, name in enumerate(names):
                names[i] = self._half_name(name)
        self.graph.node.append(node)

    def narrow(self, name: str) -> None:
        """Make the half of what is there in float32."""
        if name in self.floats:
            self._cast(name, f"{name}:half", _HALF)

    def give(self, name: str) -> None:
        """Make the float32 value of what is there in half, unless it is there."""
        if name in self.floats and name not in self.wide:
            self.wide.add(name)
            self._cast(f"{name}:half", name, _FLOAT)

    def halve_weights(self) -> None:
        """Store what is wanted in half so; what nothing wants in float32 is left out."""
        from onnx import numpy_helper

        kept = {name for node in self.graph.node for name in node.input}
        for name in self.halved:
            array = numpy_helper.to_array(self.weights[name]).astype(np.float16)
            self.graph.initializer.append(numpy_helper.from_array(array, f"{name}:half"))
            if name not in kept:
                self.graph.initializer.remove(self.weights[name])

    def _half_name(self, name: str) -> str:
        if name not in self.floats:
            return name
        if name in self.weights:
            self.halved.add(name)
        return f"{name}:half"

    def _cast(self, name: str, result: str, to: int) -> None:
        from onnx import helper

        self.graph.node.append(helper.make_node("Cast", [name], [result], f"{result}.cast{to}", to=to))

    def _state_half(self, node: Any) -> None:
        """Nodes that say themselves what they give."""
        from onnx import numpy_helper

        for attribute in node.attribute:
            if node.op_type == "Cast" and attribute.name == "to" and attribute.i == _FLOAT:
                attribute.i = _HALF
            if attribute.name == "value" and attribute.t.data_type == _FLOAT:
                half = numpy_helper.to_array(attribute.t).astype(np.float16)
                attribute.t.CopyFrom(numpy_helper.from_array(half))
                self.floats.update(node.output)


def _eight_bits(model: Any) -> Any:
    graph = model.graph
    weights = {each.name: each for each in graph.initializer}
    made: dict[str, Any] = {}
    for node in graph.node:
        name = node.input[1] if node.op_type in _WEIGHTS and len(node.input) > 1 else ""
        if name not in weights or int(np.prod(weights[name].dims)) < _SMALLEST:
            continue
        if name not in made:
            made[name] = _widening(graph, weights[name], _axis(node))
        node.input[1] = made[name].output[0]
    kept = {name for node in graph.node for name in node.input}
    for name in made:
        if name not in kept:
            graph.initializer.remove(weights[name])
    nodes = [*made.values(), *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return model


def _widening(graph: Any, weight: Any, axis: int) -> Any:
    """A node that makes a weight from its eight bits, which are put into the graph."""
    from onnx import helper, numpy_helper

    whole, scale = eight_bit_weights(numpy_helper.to_array(weight), axis)
    name = weight.name
    stored = (numpy_helper.from_array(whole, f"{name}:int8"), numpy_helper.from_array(scale, f"{name}:scale"))
    graph.initializer.extend(stored)
    inputs = [each.name for each in stored]
    return helper.make_node("DequantizeLinear", inputs, [f"{name}:widened"], f"{name}:widen", axis=axis)


def _axis(node: Any) -> int:
    if node.op_type != "Gemm":
        return _WEIGHTS[node.op_type]
    return 0 if any(each.name == "transB" and each.i for each in node.attribute) else 1


def eight_bit_weights(weights: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Whole numbers in -127..127 and the scale of each slice along `axis`: weights are about numbers times scale."""
    others = tuple(i for i in range(weights.ndim) if i != axis)
    scale = np.abs(weights).max(axis=others) / 127
    scale = np.where(scale > 0, scale, 1).astype(np.float32)
    shape = [1] * weights.ndim
    shape[axis] = -1
    return np.rint(weights / scale.reshape(shape)).astype(np.int8), scale
