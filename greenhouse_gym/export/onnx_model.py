"""A policy as an ONNX model for runtimes on robots and in browsers, without this package."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym import __version__
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.errors import InvalidValueError

OPSET, IR_VERSION = 17, 8  # of 2022, for old runtimes; the operators used are older still
_NODES = {"tanh": "Tanh", "relu": "Relu"}
_OUTPUTS = {"clip": "Clip", "tanh": "Tanh"}


def export_policy(policy: Policy, path: str | Path, name: str = "policy") -> Path:
    """Write a policy as one ONNX file; see `onnx_model`."""
    return write_atomically(path, onnx_model(policy, name))


def onnx_model(policy: Policy, name: str = "policy") -> bytes:
    """Return a policy as a self-contained ONNX model: scaling, layers and clipping.

    The input ``observation`` is float32 (n, size) and the output ``action`` float32 (n, joints) within [-1, 1], for
    any n. The metadata describe the input: ``robot`` and ``observation`` by name, and as JSON ``env_options``
    (keywords of `gymnasium.make`), ``observation_layout`` (name and number of entries of each group, in order) and
    ``training``.

    Raises:
        MissingDependencyError: The extra ``onnx`` is not installed.
        InvalidValueError: The layers do not fit together, or the environment or training notes are not JSON.
    """
    with needs("onnx"):
        import onnx
    from onnx import helper, numpy_helper

    constants: dict[str, Any] = {"center": policy.center, "scale": policy.scale}
    if policy.output == "clip":
        constants |= {"low": np.float32(-1.0), "high": np.float32(1.0)}
    nodes = [
        helper.make_node("Sub", ["observation", "center"], ["centered"]),
        helper.make_node("Div", ["centered", "scale"], ["hidden_0"]),
    ]
    last = len(policy.weights) - 1
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        constants |= {f"weight_{i}": weight, f"bias_{i}": bias}
        nodes.append(helper.make_node("Gemm", [f"hidden_{i}", f"weight_{i}", f"bias_{i}"], [f"layer_{i}"], transB=1))
        if i < last:
            nodes.append(helper.make_node(_NODES[policy.activation], [f"layer_{i}"], [f"hidden_{i + 1}"]))
    bounds = ["low", "high"] if policy.output == "clip" else []
    nodes.append(helper.make_node(_OUTPUTS[policy.output], [f"layer_{last}", *bounds], ["action"]))

    def batch(tensor: str, size: int) -> Any:
        return helper.make_tensor_value_info(tensor, onnx.TensorProto.FLOAT, ["n", size])

    graph = helper.make_graph(
        nodes,
        name,
        [batch("observation", len(policy.center))],
        [batch("action", len(policy.biases[-1]))],
        [numpy_helper.from_array(np.asarray(array, np.float32), key) for key, array in constants.items()],
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="greenhouse-gym",
        producer_version=__version__,
    )
    helper.set_model_props(model, _metadata(policy))
    try:
        onnx.checker.check_model(model, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise InvalidValueError(f"this policy cannot be written: its layers do not fit together: {error}") from error
    return model.SerializeToString()


def _metadata(policy: Policy) -> dict[str, str]:
    options = dict(policy.env_options)
    named = {str(key): str(options[key]) for key in ("robot", "observation") if key in options}
    values = {"env_options": options, "observation_layout": policy.layout, "training": dict(policy.training)}
    try:
        texts = {key: json.dumps(value, allow_nan=False) for key, value in values.items()}
    except (TypeError, ValueError) as error:
        raise InvalidValueError(
            f"this policy cannot be written: its environment or its notes on training are no JSON: {error}"
        ) from error
    return {**named, **texts}
