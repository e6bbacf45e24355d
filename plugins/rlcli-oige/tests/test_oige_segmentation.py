"""Images of instance segmentation by a camera of a robot's model, and tasks that name the device `cuda`."""

import pytest
import torch
from reacher import ARM, YAML, arm_folder
from test_unchanged_oige_files import UNCHANGED, build

from rlcli.errors import TaskError

torch.set_num_threads(1)

HEAD = """
import warp as wp
from omni.isaac.core.utils.semantics import add_update_semantics
from omni.isaac.sensor.scripts.camera import Camera
"""
CAMERAS = """        add_update_semantics(get_prim_at_path(ball.prim_path), semantic_label="ball", type_label="class")
        self.annotators = []
        for number in range(self._num_envs):
            path = f"/World/envs/env_{number}/Arm/base/eye_mount/eye"
            camera = Camera(prim_path=path)
            camera.set_clipping_range(far_distance=8.0)
            camera.set_focal_length(0.6)
            product = self.rep.create.render_product(path, resolution=(32, 32))
            annotator = self.rep.AnnotatorRegistry.get_annotator(name="instance_segmentation")
            annotator.attach([product])
            self.annotators.append(annotator)
        super().set_up_scene(scene)
"""
OBSERVE = """        shares, paths = torch.zeros(self.num_envs, device="cuda"), []
        for number, annotator in enumerate(self.annotators):
            found = annotator.get_data(device="cuda")
            ids = wp.to_torch(found["data"].view(wp.int32)).squeeze()
            labels = {path: int(key) for key, path in found["info"]["idToLabels"].items()}
            paths.append(sorted(labels))
            mask = torch.zeros(*ids.shape, dtype=bool, device="cuda")
            mask += torch.isin(ids, labels.get(f"/World/envs/env_{number}/ball", -1))
            shares[number] = mask.float().mean().cuda()
        self.shares, self.paths = shares, paths
        self.obs_buf[:, 3] = shares
"""
EYE = '<camera name="eye" pos="0 0 2.1" xyaxes="0 -1 0 1 0 0" fovy="120"/>'


def seeing(folder, eye=EYE, annotator="instance_segmentation"):
    task = (HEAD + UNCHANGED).replace("        super().set_up_scene(scene)\n", CAMERAS)
    task = task.replace("        self.obs_buf[:, 3] = 100.0\n", OBSERVE).replace("instance_segmentation", annotator)
    yaml = YAML.replace("  add_ground_plane: False", "  add_ground_plane: False\n  enable_cameras: True")
    arm_folder(folder, yaml, task.replace("from omniisaacgymenvs.robots.shared", "from shared"))
    body = '<body name="base" pos="0 0 1">'
    assert body in ARM
    (folder / "arm.xml").write_text(ARM.replace(body, f"{body}{eye}"))
    return folder


def test_mask_shows_the_labelled_object_of_its_own_environment(tmp_path):
    # the camera looks down at the ball and a box, which has no label
    env = build(seeing(tmp_path / "arm"))
    env.step(torch.zeros(4, 1))
    assert env.task.paths[2] == ["/World/envs/env_2/ball", "BACKGROUND", "UNLABELLED"]
    assert bool((env.task.shares > 0.003).all())
    assert env.task.shares.device.type == "cpu"


def test_model_without_the_camera_is_refused(tmp_path):
    with pytest.raises(TaskError, match="no camera at '/World/envs/env_0/Arm/base/eye_mount/eye'") as caught:
        build(seeing(tmp_path / "arm", eye=""))
    assert '<camera name="eye"/>' in caught.value.hint


def test_other_annotators_are_refused_with_the_line(tmp_path):
    with pytest.raises(TaskError, match=r"arm.py:\d+: the annotator 'bounding_box_3d' has no counterpart"):
        build(seeing(tmp_path / "arm", annotator="bounding_box_3d"))
