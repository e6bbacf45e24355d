"""Give a name to every element of a model that has none.

The scene calls the function, and so does the subprocess that compiles untrusted models.
"""

import mujoco


def name_all(child: mujoco.MjSpec) -> None:
    """Give a name to every element of a model that has none: in the scene, entities find their elements by name."""
    for kind in ("body", "joint", "site", "sensor", "actuator", "geom", "tendon", "pair"):
        elements = child.bodies[1:] if kind == "body" else getattr(child, f"{kind}s")  # the first body is the world
        used = {element.name for element in elements}
        for number, element in enumerate(elements):
            if not element.name:
                new_name = element.target if kind == "actuator" and element.target not in used else f"{kind}_{number}"
                while new_name in used:
                    new_name += "_"
                element.name = new_name
                used.add(new_name)
