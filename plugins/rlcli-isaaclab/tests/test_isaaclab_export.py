"""Export of direct tasks whose code applies forces to bodies or to joints, as Isaac Lab's quadcopter does."""

import json
import subprocess
import sys

import pytest
from test_unchanged_isaaclab_files import DIRECT, registered

FORCES = {
    "each step": (
        "        self.actions = actions.clone()\n",
        "        self.actions = actions.clone()\n        force = torch.zeros(self.num_envs, 1, 3)\n"
        "        force[:, 0, 0] = 5.0 * actions[:, 0]\n"
        "        self.robot.set_external_force_and_torque(force, torch.zeros_like(force), body_ids=[1])\n",
    ),
    "each physics step": (
        "        self.applied += 1\n",
        "        self.applied += 1\n        force = torch.zeros(self.num_envs, 1, 3)\n"
        "        force[:, 0, 0] = 5.0 * self.actions[:, 0] - self.robot.data.joint_vel[:, 0]\n"
        "        composer = self.robot.permanent_wrench_composer\n"
        "        composer.set_forces_and_torques(force, torch.zeros_like(force), body_ids=[1])\n",
    ),
}


@pytest.mark.parametrize("when", FORCES)
@pytest.mark.parametrize("decimation", [1, 2])
def test_forces_of_the_environment_act_in_the_verification(tmp_path, when, decimation):
    folder = tmp_path / "pole"
    folder.mkdir()
    text = DIRECT.replace(*FORCES[when]).replace("decimation = 2", f"decimation = {decimation}")
    text = text.replace("torch.ones(self.num_envs, device=self.device)", "-self.robot.data.joint_pos[:, 0].abs()")
    (folder / "pole_env.py").write_text(text)
    (folder / "models.yaml").write_text("pole.usd: cartpole:cartpole.xml\n")
    registered(folder, ["skrl"])
    for words in (
        ["train", str(folder), "--max-iterations", "1", "--num-envs", "4"],
        ["export", "--checkpoint", "latest", "--verify", "--episodes", "4", "--json", "--format", "numpy"],
    ):
        done = subprocess.run([sys.executable, "-m", "rlcli", *words], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    verified = json.loads(done.stdout)["verified"]
    assert verified["passed"]
    assert "force data.xfrc_applied" in verified["closed_by_task"]
    assert "run_policy.py applies no forces" in done.stderr
