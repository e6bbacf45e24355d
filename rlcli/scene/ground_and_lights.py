"""Add a ground plane, the ground's material, the sky and lights to the model of a scene."""

from __future__ import annotations

import mujoco

from rlcli.config.schema import GroundConfig, LightsConfig


def add_ground_plane(spec: mujoco.MjSpec, ground: GroundConfig) -> None:
    """Add a ground plane, with its material and the sky, to the model of a scene."""
    add_materials(spec)
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[ground.size / 2, ground.size / 2, 1.0],
        material="ground", friction=[ground.friction, 0.005, 0.0001], pos=[0.0, 0.0, ground.height],
    )  # fmt: skip


def add_materials(spec: mujoco.MjSpec) -> None:
    """Add the material of the ground, and the sky, to the model of a scene."""
    spec.add_texture(
        name="ground", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.86, 0.88, 0.90], rgb2=[0.77, 0.79, 0.82], width=512, height=512,
    )  # fmt: skip
    material = spec.add_material(name="ground", texrepeat=[1, 1], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.45, 0.63, 0.83], rgb2=[0.86, 0.91, 0.95], width=256, height=1536,
    )  # fmt: skip


def add_lights(spec: mujoco.MjSpec, lights: LightsConfig) -> None:
    """Add ambient light (`dome`) and directional light (`distant`) to a model; intensity 1000 is full strength."""
    headlight = spec.visual.headlight
    if lights.dome is not None:
        strength = min(1.0, lights.dome.intensity / 1000.0)
        headlight.ambient = [strength * c for c in lights.dome.color]
        headlight.diffuse = [0.7 * strength * c for c in lights.dome.color]
        headlight.specular = [0.1 * strength] * 3
    if lights.distant is not None:
        strength = min(1.0, lights.distant.intensity / 1000.0)
        spec.worldbody.add_light(
            name="distant", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=lights.distant.direction,
            pos=[0, 0, 20], diffuse=[strength * c for c in lights.distant.color], castshadow=True,
        )  # fmt: skip
