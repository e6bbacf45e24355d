"""Keys of OmniIsaacGymEnvs' task YAML.

Each key has a status (mapped, approximated, ignored, or task: only the task's class reads it) and a note for the user.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlcli.config.strict_yaml import Path
from rlcli.formats import Status

ROOT_SETTINGS: Mapping[str, Any] = {
    "task_name": "", "experiment": "", "num_envs": "", "seed": 42, "torch_deterministic": False,
    "max_iterations": "", "physics_engine": "physx", "pipeline": "cpu", "sim_device": "cpu", "device_id": 0,
    "rl_device": "cpu", "multi_gpu": False, "num_threads": 4, "solver_type": 1, "test": False, "checkpoint": "",
    "evaluation": False, "headless": True, "enable_livestream": False, "mt_timeout": 300, "enable_recording": False,
    "recording_interval": 2000, "recording_length": 100, "recording_fps": 30, "recording_dir": "",
    "wandb_activate": False, "wandb_group": "", "wandb_name": "", "wandb_entity": "", "wandb_project": "",
    "kit_app": "", "extras": [], "warp": False,
}  # fmt: skip
"""Settings of OmniIsaacGymEnvs' command line, which interpolations of the task may refer to."""

EPISODE_KEYS = ("episodeLength", "maxEpisodeLength")
MOVED_KEYS: Mapping[Path, str] = {
    ("env", "numEnvs"): "scene.num_envs",
    ("env", "envSpacing"): "scene.env_spacing",
    ("env", "controlFrequencyInv"): "decimation",
    ("env", "clipObservations"): "clip_observations",
    ("env", "clipActions"): "clip_actions",
    ("env", "episodeLength"): "episode_length_s",
    ("env", "maxEpisodeLength"): "episode_length_s",
    ("sim", "dt"): "sim.dt",
    ("sim", "gravity"): "sim.gravity",
    ("sim", "add_ground_plane"): "scene.ground",
    ("sim", "add_distant_light"): "scene.lights.distant",
    ("viewport", "camera_position"): "viewer.eye",
    ("viewport", "camera_target"): "viewer.lookat",
    ("viewport", "viewport_camera_width"): "viewer.width",
    ("viewport", "viewport_camera_height"): "viewer.height",
}
"""Key of the YAML -> key of `TaskConfig`. The task's class still finds the values in `_task_cfg`."""

TOP_KEYS = (
    "name",
    "physics_engine",
    "env",
    "sim",
    "domain_randomization",
    "viewport",
    "mjcf",
    "rl",
    "ctrl",
    "randomize",
)
_DEVICE = "use --device"
SIM_KEYS: Mapping[str, tuple[Status, str]] = {
    "use_gpu_pipeline": ("ignored", _DEVICE),
    "use_fabric": ("ignored", "rlcli has no USD stage"),
    "use_flatcache": ("ignored", "rlcli has no USD stage"),
    "enable_scene_query_support": ("ignored", "rays are always available"),
    "disable_contact_processing": ("ignored", "contacts are always processed"),
    "enable_cameras": ("task", ""),
    "replicate_physics": ("ignored", "every environment is simulated separately"),
    "rendering_dt": ("approximated", "videos have one frame per step, or fewer with sim.render_interval"),
    "substeps": ("approximated", "for more than 1, set a smaller sim.dt and a larger decimation"),
    "default_material": ("ignored", "OmniIsaacGymEnvs ignores this key, too, and reads default_physics_material"),
    "gravity_mag": ("task", ""),
    "disable_gravity": ("task", ""),
    "add_damping": ("task", ""),
    "disable_franka_collisions": ("task", ""),
    "disable_nut_collisions": ("task", ""),
    "disable_bolt_collisions": ("task", ""),
}
MATERIAL_KEYS: Mapping[str, tuple[Status, str]] = {
    "dynamic_friction": ("mapped", "sliding friction of contacts with the ground"),
    "static_friction": ("approximated", "MuJoCo has one sliding friction: dynamic_friction is used"),
    "restitution": ("approximated", "the ground's contact damping is chosen for this restitution of contacts"),
}
_SOLVER = "MuJoCo's solver iterates until it converges; the MJCF's <option> sets its limits"
_OFFSET = "the MJCF's solref, solimp and margin set how contacts behave"
_SLEEP = "MuJoCo's bodies do not sleep"
_BUFFER = "memory for contacts is estimated; set sim.contacts_per_env to change it"
PHYSX_KEYS: Mapping[str, tuple[Status, str]] = {
    "use_gpu": ("ignored", _DEVICE),
    "worker_thread_count": ("ignored", "use sim.engine_threads"),
    "num_threads": ("ignored", "use sim.engine_threads"),
    "solver_type": ("ignored", _SOLVER),
    "solver_position_iteration_count": ("ignored", _SOLVER),
    "solver_velocity_iteration_count": ("ignored", _SOLVER),
    "contact_offset": ("ignored", _OFFSET),
    "rest_offset": ("ignored", _OFFSET),
    "bounce_threshold_velocity": ("ignored", _OFFSET),
    "max_depenetration_velocity": ("ignored", _OFFSET),
    "friction_offset_threshold": ("ignored", _OFFSET),
    "friction_correlation_distance": ("ignored", _OFFSET),
    "enable_sleeping": ("ignored", _SLEEP),
    "enable_stabilization": ("ignored", _SLEEP),
    "sleep_threshold": ("ignored", _SLEEP),
    "stabilization_threshold": ("ignored", _SLEEP),
    "enable_gyroscopic_forces": ("ignored", "MuJoCo always computes them"),
    "density": ("ignored", "the MJCF's masses and densities are used"),
    **dict.fromkeys(
        (
            "gpu_max_rigid_contact_count", "gpu_max_rigid_patch_count", "gpu_found_lost_pairs_capacity",
            "gpu_found_lost_aggregate_pairs_capacity", "gpu_total_aggregate_pairs_capacity",
            "gpu_max_soft_body_contacts", "gpu_max_particle_contacts", "gpu_heap_capacity",
            "gpu_temp_buffer_capacity", "gpu_max_num_partitions", "gpu_collision_stack_size",
        ),
        ("ignored", _BUFFER),
    ),
}  # fmt: skip
ACTOR_KEYS: Mapping[str, tuple[Status, str]] = {
    **{
        key: PHYSX_KEYS[key]
        for key in (
            "solver_position_iteration_count", "solver_velocity_iteration_count", "sleep_threshold",
            "stabilization_threshold", "max_depenetration_velocity", "contact_offset", "rest_offset",
            "enable_gyroscopic_forces",
        )
    },
    "override_usd_defaults": ("ignored", "there is no USD file"),
    "make_kinematic": ("mapped", "the body moves only when its pose is set"),
    "enable_self_collisions": ("approximated", "false: no contacts between its bodies; otherwise the MJCF decides"),
    "density": ("mapped", "density of all geoms of the actor; -1: the MJCF's"),
    "mass": ("mapped", "total mass of the actor; -1: the MJCF's"),
    "static_friction": MATERIAL_KEYS["static_friction"],
    "dynamic_friction": ("approximated", "a contact uses the larger friction of its two geoms"),
    "restitution": ("ignored", _OFFSET),
}  # fmt: skip
