"""docs/tutorials/put-a-policy-on-a-robot.md: the loop drives the exported model, and stops when it must."""

import re
import shutil

import pytest
from support.fenced import REPOSITORY, Block, blocks, run_commands, write_files

PAGE = REPOSITORY / "docs" / "tutorials" / "put-a-policy-on-a-robot.md"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    write_files(blocks(PAGE), folder)
    run_commands([b for b in blocks(PAGE) if "export" in b.text], folder)
    return folder


@pytest.fixture
def robot(exported, tmp_path):
    return shutil.copytree(exported, tmp_path / "robot")


LOOP = [Block("sh", None, "python loop.py 5\n")]


@pytest.mark.slow
def test_control_loop_balances_the_pole(robot):
    """on-a-robot.md; a machine that is slow moves the simulation no slower, so that the steps are the same."""
    loop = robot / "loop.py"
    loop.write_text(loop.read_text().replace("MOST_LATE = 5", "MOST_LATE = 1_000"))  # the tests' machine is not idle
    said = run_commands([b for b in blocks(PAGE) if "loop.py" in b.text and not b.file], robot)
    cart, pole = map(float, re.match(r"stopped at (\S+) (\S+)\n", said).groups())
    assert abs(pole) < 0.05
    assert abs(cart) < 1.0
    assert "300 steps" in said


@pytest.mark.slow
def test_the_policy_in_numpy_alone_gives_the_same_commands(robot):
    script = """
import numpy as np, onnxruntime, policy_numpy
rows = np.random.default_rng(0).normal(size=(64, 4)).astype(np.float32)
theirs = onnxruntime.InferenceSession("policy.onnx").run(["command"], {"obs": rows})[0]
print(np.abs(policy_numpy.run({"obs": rows})["command"] - theirs).max() < 1e-3)
"""
    (robot / "same.py").write_text(script)
    assert run_commands([Block("sh", None, "python same.py\n")], robot) == "True\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("robot.py", ("[0.5, 0.1]", "[0.5, np.nan]"), "a sensor gave"),
        ("robot.py", ("[0.5, 0.1]", "[2.6, 0.1]"), "out of the workspace"),
        ("robot.py", ("mujoco.mj_step(model, data, 2)", "__import__('time').sleep(0.02)"), "missed in a row"),
    ],
)
def test_the_loop_takes_the_power_away_when_something_is_wrong(robot, file, change, said):
    text = (robot / file).read_text()
    assert change[0] in text
    (robot / file).write_text(text.replace(*change))
    with pytest.raises(AssertionError) as failed:
        run_commands(LOOP, robot)
    assert said in str(failed.value)
    assert "stopped at" in str(failed.value)


@pytest.mark.slow
def test_the_loop_refuses_a_policy_that_sees_other_joints(robot):
    text = (robot / "robot.py").read_text()
    (robot / "robot.py").write_text(text.replace('["slider_to_cart", "cart_to_pole"]', '["cart_to_pole", "slider"]'))
    with pytest.raises(AssertionError) as failed:
        run_commands(LOOP, robot)
    assert "AssertionError" in str(failed.value)
    assert "stopped at" not in str(failed.value)
