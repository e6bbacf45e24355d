"""first-task.md: the two conversions of a URDF to MJCF."""

import os

import mujoco
import pytest
from support.fenced import all_blocks, page_path, write_files

from rlcli.cli.app import main

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
URDF = """<robot name="arm"><!-- options -->
  <link name="base">
    <inertial><mass value="3"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="arm"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="5" velocity="10"/><dynamics damping="0.05"/>
  </joint>
  <link name="arm">
    <inertial>
      <origin xyz="0 0 0.25"/><mass value="1"/>
      <inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual><geometry><mesh filename="package://arm/meshes/hip.obj"/></geometry></visual>
  </link>
</robot>
"""
PAGE = page_path("first-task.md")
SHORT, LINE, FREE = (block for block in all_blocks(PAGE, "### Convert a URDF"))


@pytest.fixture
def converted(tmp_path, monkeypatch):
    def convert(block, line=""):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "hip.obj").write_text(MESH)
        (tmp_path / "robot.urdf").write_text(URDF.replace("<!-- options -->", line))
        exec(block.text, {})
        return mujoco.MjModel.from_xml_path("robot.xml")

    return convert


def test_short_conversion_fixes_root_to_world(converted):
    model = converted(SHORT)
    assert (model.nbody, model.nq, model.nu) == (2, 1, 0)
    assert model.jnt_actfrcrange[0].tolist() == [-5.0, 5.0]
    assert model.ngeom == 1, "the box of the base; visual geometry is left out"


def test_options_keep_root_and_visuals_and_free_joint_is_added(converted):
    model = converted(FREE, LINE.text)
    assert (model.nbody, model.nq, model.ngeom, model.nmesh) == (3, 8, 2, 1)


def test_converted_model_works_in_task_of_page(converted, tmp_path, capsys):
    converted(SHORT)
    write_files([block for block in all_blocks(PAGE) if block.file], tmp_path)
    os.replace("robot.xml", tmp_path / "my_task" / "pendulum.xml")
    assert main(["validate", "--deep", str(tmp_path / "my_task")]) == 0
    assert "files and model" in capsys.readouterr().out
