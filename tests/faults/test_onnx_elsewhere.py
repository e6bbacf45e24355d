"""ONNX files whose tensors are in other files are not opened."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from rlcli.deploy.export import require_self_contained
from rlcli.errors import CheckpointError


def elsewhere(where):
    value = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    value.external_data.add(key="location", value=where)
    return value


def model_of(place, value):
    """Return a model with a tensor at this position."""
    obs, action = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in ("obs", "action"))
    nodes, settings = [helper.make_node("Identity", ["obs"], ["action"])], {}
    if place == "initializer":
        settings["initializer"] = [value]
    elif place == "constant":
        nodes.append(helper.make_node("Constant", [], ["c"], value=value))
    elif place == "branch":
        inner = helper.make_graph([], "inner", [], [action], initializer=[value])
        nodes.append(helper.make_node("If", ["obs"], ["c"], then_branch=inner, else_branch=inner))
    graph = helper.make_graph(nodes, "g", [obs], [action], **settings)
    if place == "sparse":
        graph.sparse_initializer.add(values=value)
    model = helper.make_model(graph)
    if place == "function":
        constant = helper.make_node("Constant", [], ["y"], value=value)
        model.functions.append(helper.make_function("d", "f", [], ["y"], [constant], []))
    return model.SerializeToString()


@pytest.mark.parametrize("place", ["initializer", "constant", "branch", "sparse", "function"])
@pytest.mark.parametrize("where", ["/etc/passwd", "../secret", "weights.bin"])
def test_tensor_in_another_file_is_refused(place, where):
    with pytest.raises(CheckpointError, match=r"policy\.onnx stores 'w' in another file") as caught:
        require_self_contained(model_of(place, elsewhere(where)), Path("policy.onnx"))
    assert where in str(caught.value)


@pytest.mark.parametrize("place", ["initializer", "constant", "branch", "sparse", "function"])
def test_tensor_in_the_file_is_accepted(place):
    require_self_contained(model_of(place, numpy_helper.from_array(np.ones(1, np.float32), "w")), Path("policy.onnx"))


@pytest.mark.parametrize("data", [b"\xff" * 100, b"text, and no model"])
def test_invalid_onnx_file_is_refused(data):
    with pytest.raises(CheckpointError, match="not a valid ONNX file"):
        require_self_contained(data, Path("policy.onnx"))


def test_onnx_library_reads_external_tensors(tmp_path):
    (tmp_path / "secret").write_bytes(np.ones(1, np.float32).tobytes())
    (tmp_path / "policy.onnx").write_bytes(model_of("initializer", elsewhere("secret")))
    assert onnx.load(tmp_path / "policy.onnx").graph.initializer[0].raw_data == np.ones(1, np.float32).tobytes()
