"""ONNX graph of a controller: observation (batch, entries) to action (batch, 3) and torque (batch, 3) [N m]."""

from typing import Any

import numpy as np

from koz_jax.agents.numpy_policy import NumpyPolicy
from koz_jax.errors import missing_extra
from koz_jax.export.metadata import describe
from koz_jax.task.observation_layout import ACTION_SIZE

try:
    import onnx
    from onnx import helper, numpy_helper
except ImportError as error:
    raise missing_extra(error, "onnx", "onnx") from None

# Old enough for runtimes of years ago, new enough for all operators here.
_OPSET = 13
_IR_VERSION = 8


class _Graph:
    """Nodes and constants as they are added."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: np.ndarray | np.float32) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value, order="C"), name))
        return name

    def node(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output


def onnx_files(policy: NumpyPolicy) -> dict[str, bytes]:
    """The checked model by its file name.  Its metadata are in the model's properties, under ``koz_jax`` as JSON."""
    metadata = describe(policy)
    graph = _Graph()
    action = _decide(graph, policy)
    limit = graph.constant("torque_limit", np.asarray(metadata.torque_limit, np.float32))
    graph.node("Mul", [action, limit], "torque_B")

    def rows(name: str, size: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", size])

    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "koz_policy",
            inputs=[rows("observation", sum(entry.size for entry in metadata.observation))],
            outputs=[rows("action", ACTION_SIZE), rows("torque_B", ACTION_SIZE)],
            initializer=graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="koz_jax",
        producer_version=metadata.koz_jax_version,
    )
    helper.set_model_props(model, {"koz_jax": metadata.model_dump_json()})
    onnx.checker.check_model(model, full_check=True)
    return {"koz_policy.onnx": model.SerializeToString()}


def _decide(graph: _Graph, policy: NumpyPolicy) -> str:
    """Encode, layer by layer, tanh.  Returns the name of the action."""
    seen = ["observation"]
    axis = graph.constant("axis", np.array([1], np.int64))
    for number, (start, stop, scale) in enumerate(policy.views):
        bounds = [graph.constant(f"view_{number}_{at}", np.array([at], np.int64)) for at in (start, stop)]
        part = graph.node("Slice", ["observation", *bounds, axis], f"view_{number}_part")
        divisor = graph.constant(f"view_{number}_scale", np.float32(scale))
        seen.append(graph.node("Tanh", [graph.node("Div", [part, divisor], f"view_{number}_scaled")], f"view_{number}"))
    x = graph.node("Concat", seen, "encoded", axis=1)
    for number, layer in enumerate(policy.layers):
        weights = [graph.constant(f"kernel_{number}", layer.kernel), graph.constant(f"bias_{number}", layer.bias)]
        x = graph.node("Gemm", [x, *weights], f"layer_{number}")
        if number < len(policy.layers) - 1:
            x = graph.node("Relu", [x], f"relu_{number}")
    return graph.node("Tanh", [x], "action")
