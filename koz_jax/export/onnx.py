"""ONNX graph of a controller: observation (batch, entries) to action (batch, 3) and torque (batch, 3) [N m]."""

from typing import Any

import numpy as np

from koz_jax.agents.numpy_policy import NumpyPolicy
from koz_jax.errors import SettingsError, missing_extra
from koz_jax.export.metadata import Metadata
from koz_jax.sac.dials import DIAL_FEATURES, spacing
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


def onnx_files(policy: NumpyPolicy, metadata: Metadata) -> dict[str, bytes]:
    """The checked model by its file name.  Its metadata are in the model's properties, under ``koz_jax`` as JSON."""
    graph = _Graph()
    action = _decide(graph, policy)
    _torque(graph, action, metadata)

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
    helper.set_model_props(model, {"koz_jax": metadata.to_json()})
    onnx.checker.check_model(model, full_check=True)
    return {"koz_policy.onnx": model.SerializeToString()}


def _decide(graph: _Graph, policy: NumpyPolicy) -> str:
    """Encode, layer by layer, tanh; features of the dials are the last inputs of every layer.

    Returns the name of the action.
    """
    seen = ["observation"]
    axis = graph.constant("axis", np.array([1], np.int64))
    for number, (start, stop, scale) in enumerate(policy.views):
        bounds = [graph.constant(f"view_{number}_{at}", np.array([at], np.int64)) for at in (start, stop)]
        part = graph.node("Slice", ["observation", *bounds, axis], f"view_{number}_part")
        divisor = graph.constant(f"view_{number}_scale", np.float32(scale))
        seen.append(graph.node("Tanh", [graph.node("Div", [part, divisor], f"view_{number}_scaled")], f"view_{number}"))
    dialled = _dial_features(graph, policy, axis)
    x = graph.node("Concat", [*seen, *dialled], "encoded", axis=1)
    for number, layer in enumerate(policy.layers):
        weights = [graph.constant(f"kernel_{number}", layer.kernel), graph.constant(f"bias_{number}", layer.bias)]
        x = graph.node("Gemm", [x, *weights], f"layer_{number}")
        if layer.gain is not None:
            gain = graph.constant(f"gain_{number}", layer.gain)
            gained = graph.node("MatMul", [*dialled, gain], f"gained_{number}")
            x = graph.node("Mul", [x, graph.node("Add", [gained, "one"], f"scale_{number}")], f"scaled_{number}")
        if number < len(policy.layers) - 1:
            x = graph.node("Relu", [x], f"relu_{number}")
            x = graph.node("Concat", [x, *dialled], f"beside_{number}", axis=1) if dialled else x
    return graph.node("Tanh", [x], "action")


def _dial_features(graph: _Graph, policy: NumpyPolicy, axis: str) -> list[str]:
    """Gaussian features of all dials.  Returns the name of (batch, features), or nothing where there are no dials."""
    if not policy.dials:
        return []
    centres = graph.constant("centres", np.arange(DIAL_FEATURES, dtype=np.float32))
    minus_half = graph.constant("minus_half", np.float32(-0.5))
    graph.constant("one", np.float32(1.0))
    features = []
    for number, (entry, low, high) in enumerate(policy.dials):
        bounds = [graph.constant(f"dial_{number}_{at}", np.array([at], np.int64)) for at in (entry, entry + 1)]
        steps = graph.node("Slice", ["observation", *bounds, axis], f"dial_{number}_entry")
        for operator, value in (("Sub", low), ("Div", spacing(low, high))):
            operand = graph.constant(f"dial_{number}_{operator}_by", np.float32(value))
            steps = graph.node(operator, [steps, operand], f"dial_{number}_{operator}")
        steps = graph.node("Sub", [steps, centres], f"dial_{number}_steps")
        square = graph.node("Mul", [steps, steps], f"dial_{number}_square")
        exponent = graph.node("Mul", [square, minus_half], f"dial_{number}_exponent")
        features.append(graph.node("Exp", [exponent], f"dial_{number}"))
    return [graph.node("Concat", features, "dialled", axis=1)]


def _torque(graph: _Graph, action: str, metadata: Metadata) -> None:
    """The torque that an action asks for, by the name ``torque_B``.

    Raises:
        SettingsError: the spacecraft has wheels, and the policy does not see what they leave of the torque.

    """
    limit = graph.constant("torque_limit", np.asarray(metadata.torque_limit, np.float32))
    if metadata.scaling is None:
        if metadata.wheels:
            raise SettingsError(
                f"spacecraft.wheels: must be none for {metadata.name} to onnx, for what they leave of the torque is not"
                " in its observation; allowed are --to c and --to stablehlo"
            )
        graph.node("Mul", [action, limit], "torque_B")
        return
    per_action = graph.constant("torque_per_action", np.array(metadata.scaling.torque_per_action, np.float32).T)
    asked = graph.node("MatMul", [action, per_action], "asked_B")
    if metadata.wheels:
        limit = _left(graph, limit, metadata)
    below = graph.node("Min", [asked, limit], "below_B")
    graph.node("Max", [below, graph.node("Neg", [limit], "negative_limit")], "torque_B")


def _left(graph: _Graph, limit: str, metadata: Metadata) -> str:
    """What wheels leave of the limit: by the same share, they leave less of what the policy sees of its reach."""
    assert metadata.scaling is not None
    (start,) = (entry.start for entry in metadata.observation if entry.name == "reach")
    bounds = [graph.constant(f"reach_{at}", np.array([at], np.int64)) for at in (start, start + 1)]
    reach = graph.node("Slice", ["observation", *bounds, "axis"], "reach")
    at_rest = graph.constant("reach_at_rest", np.float32(metadata.scaling.seen["reach"][0]))
    share = graph.node("Div", [reach, at_rest], "share")
    return graph.node("Mul", [share, limit], "limit_left")
