"""The properties of mjlab in our ONNX files, in its own format."""

import onnx
import pytest

from rlcli.deploy.export import export
from rlcli.deploy.metadata import mjlab_properties
from rlcli.runs.checkpoint_reader import open_checkpoint


@pytest.fixture(scope="module")
def file(runs, tmp_path_factory):
    run = max((runs / "arm").iterdir())
    checkpoint = max(path for path in (run / "checkpoints").iterdir() if path.is_dir())
    return export(open_checkpoint(checkpoint), tmp_path_factory.mktemp("mjlab") / "policy.onnx")


def test_properties_have_mjlab_keys_and_format(file):
    found = {entry.key: entry.value for entry in onnx.load(file.file).metadata_props}
    assert found["joint_names"] == "shoulder,elbow,wrist"
    assert found["joint_stiffness"] == "0,5,0"
    assert found["joint_damping"] == "0,0,0"
    assert [float(x) for x in found["default_joint_pos"].split(",")] == pytest.approx([0.0, 0.25, 0.0])
    assert found["command_names"] == ""
    assert found["observation_names"] == "rates,angle"
    scales = found["observation_terms_scale"].split(",")
    assert [float(x) for x in scales[0].split(";")] == pytest.approx([0.1, 0.2, 0.3])
    assert float(scales[1]) == 2.0
    assert found["observation_terms_clip"] == "-5;5,-inf;inf"
    assert found["observation_terms_history_length"] == "0,0"
    assert found["observation_terms_flatten_history_dim"] == "True,True"
    assert [float(x) for x in found["action_scale"].split(",")] == pytest.approx([4.0, 0.6, 10.0])
    assert found["run_path"] == file.metadata["run"]


def test_names_with_separators_are_left_out(file):
    first = {**file.metadata["observations"][0], "name": "a,b"}
    properties = mjlab_properties({**file.metadata, "observations": [first, file.metadata["observations"][1]]})
    assert "observation_names" not in properties
    assert properties["joint_names"] == "shoulder,elbow,wrist"


def test_properties_without_robot_description(file):
    properties = mjlab_properties({**file.metadata, "deployment": None})
    assert "joint_names" not in properties
    assert properties["action_scale"]
