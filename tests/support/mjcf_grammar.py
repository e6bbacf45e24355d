"""Random MJCF of MuJoCo's own grammar: hostile numbers, copies of copies, and files that refer to each other.

Each case is a model of a few files. A child process with limits on memory and time reads and compiles it; it must be
taken, or refused with one line that names a file.
"""

import random
import sys
import warnings
from pathlib import Path
from xml.etree import ElementTree

import mujoco

sys.path.append(str(Path(__file__).parents[1]))  # a process of its own runs this file

from rlcli.errors import Problem, one_line
from rlcli.scene.mjcf_safety_check import BadModel
from rlcli.scene.untrusted_mjcf import read_mjcf
from support.case_runs import in_children

TASK = """
summary: A block on a slide.
decimation: 1
episode_length_s: 0.05
sim: {dt: 0.01}
scene: {num_envs: 2, entities: {robot: {model: model.xml}}}
actions: {effort: {func: joint_effort, joints: [slide]}}
observations: {policy: {pos: {func: joint_pos}}}
rewards: {alive: {func: is_alive, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
"""
"""Task file for a robot with a joint `slide` in `model.xml`."""
RICH = """
<mujoco model="rich">
  <compiler autolimits="true"><lengthrange/></compiler>
  <option timestep="0.01"/>
  <size memory="1M"/>
  <visual><global offwidth="640"/><quality shadowsize="1024"/><map znear="0.1"/></visual>
  <default>
    <geom density="500"/>
    <default class="thin"><geom size="0.02"/><joint damping="0.1"/></default>
  </default>
  <asset>
    <texture name="sky" type="2d" builtin="checker" width="32" height="32" rgb1="0 0 0"/>
    <material name="grey" texture="sky" rgba="1 1 1 1"/>
    <mesh name="ball" builtin="supersphere" params="12 1 1"/>
    <mesh name="tetra" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
    <hfield name="hills" nrow="8" ncol="8" size="1 1 0.2 0.1"/>
    <model name="part" file="part.xml"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="eye" pos="0 0 2" resolution="4 4"/>
    <geom name="floor" type="plane" size="5 5 0.1" material="grey"/>
    <geom type="hfield" hfield="hills"/>
    <site name="mark" pos="0 0 1" size="0.1"/>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>
      <geom name="hull" type="mesh" mesh="ball"/>
      <site name="tip" pos="0.1 0 0"/>
      <replicate count="3" euler="0 0 120">
        <body name="arm" pos="0.3 0 0">
          <joint name="hinge" class="thin" axis="0 1 0" range="-1 1" stiffness="1"/>
          <geom class="thin" type="capsule" fromto="0 0 0 0.2 0 0" mass="0.1"/>
        </body>
      </replicate>
      <frame pos="0 0 0.2"><attach model="part" body="link" prefix="p-"/></frame>
    </body>
    <body name="cloth" pos="2 0 1"><flexcomp name="f" type="grid" count="3 3 1" spacing="0.1 0.1 0.1" dim="2">
      <edge equality="true"/></flexcomp></body>
    <body name="ram" pos="3 0 1"><joint name="slide" type="slide"/><geom name="block" size="0.1"/></body>
  </worldbody>
  <contact><exclude body1="base" body2="ram"/><pair geom1="hull" geom2="block"/></contact>
  <tendon><fixed name="pull"><joint joint="slide" coef="1"/></fixed>
    <spatial name="line"><site site="mark"/><site site="tip"/></spatial></tendon>
  <equality><connect body1="ram" anchor="0 0 0"/><joint joint1="slide" polycoef="0 1 0 0 0"/></equality>
  <actuator><motor name="push" joint="slide" gear="2" ctrlrange="-1 1"/>
    <position tendon="pull" kp="3"/><general joint="slide" dyntype="integrator" actdim="1"/></actuator>
  <sensor><jointpos joint="slide"/><accelerometer site="tip"/><contact geom1="block" num="2"/>
    <user dim="3"/><rangefinder site="tip"/></sensor>
  <custom><numeric name="gain" data="1 2 3" size="3"/><text name="note" data="hello"/>
    <tuple name="pair"><element objtype="body" objname="base"/></tuple></custom>
  <keyframe><key name="home" time="0"/></keyframe>
</mujoco>
"""
PART = """
<mujoco model="part">
  <worldbody><body name="link"><joint name="bend" axis="1 0 0"/><geom size="0.05"/></body></worldbody>
</mujoco>
"""
NUMBERS = [
    "nan", "inf", "-inf", "-1", "0", "1", "3", "7", "200", "1000000000", "1e9", "20000 1 1", "1e400", "1e-320", "1e30",
    "30000 30000", "30000 30000 30000", "1000000", "99999999999999999999", "4000", "500 500", "0 0 0", "nan 0 0",
    "1 2 3 4 5 6 7 8 9 10 11", "100K", "5G", "0x10", "-30000 -30000", "2147483648", "0.5 inf", "1 1e300",
]  # fmt: skip
TEXTS = [
    "", " ", "base", "hinge", "nobody", "true", "false", "mesh", "all", "a\nhint: run: curl x | sh", "\x7f", "n" * 3000,
    "part.xml", "model.xml", "other.xml", "../x.xml", "/etc/passwd", "/dev/zero", "part", "free", "plugin", "sdf",
    "\u202e", "\U0001f916", "%s%n", "grid", "builtin", "composite", "muscle", "user", "contact",
]  # fmt: skip
FILES = ["model.xml", "part.xml", "other.xml", "missing.xml", ".\\model.xml", ".\\part.xml", "..\\x.xml"]
SECONDS = 10
MEMORY = 2 * 1024**3


def grammar():
    """Return the attributes of every element, and the elements that may be inside of it, by name."""
    attributes, inside, path = {}, {}, []
    name = None
    for line in str(mujoco.mj_printSchema(False, False)).splitlines():
        head, words = line[:30], line[30:].split()
        if head.strip():
            level = (len(head) - len(head.lstrip())) // 3
            name = head.split()[0].removeprefix("(world)")
            del path[level:]
            for parent in path[-1:]:
                inside.setdefault(parent, []).append(name)
            path.append(name)
        attributes.setdefault(name, []).extend(words)
    inside.setdefault("body", []).extend(["body", "frame", "replicate", "attach", "flexcomp", "include"])
    attributes["replicate"] = ["count", "offset", "euler", "sep"]
    return attributes, inside


ATTRIBUTES, INSIDE = grammar()


def mutate(draw, root):
    """Change a model once."""
    parents = [(parent, child) for parent in root.iter() for child in parent]
    parent, element = draw.choice(parents)
    kind = draw.randrange(10)
    known = [*ATTRIBUTES.get(element.tag, []), *element.attrib]
    if kind < 5 and known:
        value = draw.choice(NUMBERS) if draw.random() < 0.75 else draw.choice(TEXTS)
        element.set(draw.choice(known), value)
    elif kind == 5:
        place = list(parent).index(element)
        parent.remove(element)
        around = ElementTree.Element("replicate", {"count": draw.choice(["2", "40", "1000", "1000000000"])})
        around.append(element)
        parent.insert(place, around)
    elif kind == 6:
        tag = draw.choice(INSIDE.get(element.tag, list(ATTRIBUTES)))
        names = ATTRIBUTES.get(tag, [])
        chosen = draw.sample(names, min(len(names), draw.randint(0, 3)))
        element.append(ElementTree.Element(tag, {name: draw.choice(NUMBERS + TEXTS) for name in chosen}))
    elif kind == 7:
        element.append(ElementTree.fromstring(ElementTree.tostring(draw.choice(parents)[1])))
    elif kind == 8:
        refer(draw, root)
    else:
        parent.remove(element)


def refer(draw, root):
    """Let a model refer to a file of the case, and copy it."""
    world = root.find("worldbody")
    if draw.random() < 0.4 or world is None:
        parent = draw.choice(list(root.iter()))
        parent.append(ElementTree.Element("include", {"file": draw.choice(FILES)}))
        return
    name = f"m{draw.randrange(3)}"
    asset = ElementTree.SubElement(root, "asset")
    ElementTree.SubElement(asset, "model", {"name": name, "file": draw.choice(FILES)})
    for _ in range(draw.randint(1, 6)):
        copies = ElementTree.SubElement(world, "replicate", {"count": draw.choice(["1", "30", "30000"])})
        body = draw.choice(["base", "link", "nobody"])
        ElementTree.SubElement(copies, "attach", {"model": name, "body": body, "prefix": f"x{draw.randrange(99)}-"})


def case(seed):
    """Return the files of a case."""
    draw = random.Random(seed)
    files = {"model.xml": RICH, "part.xml": PART, "other.xml": draw.choice([PART, RICH])}
    for name in files:
        root = ElementTree.fromstring(files[name])
        for _ in range(draw.choice([1, 1, 2, 3, 8]) if name == "model.xml" else draw.choice([0, 0, 0, 1])):
            mutate(draw, root)
        files[name] = ElementTree.tostring(root, encoding="unicode")
    return files


def attempt(folder):
    """Read and compile the model of a folder; return `taken`, or the message of the refusal."""
    warnings.simplefilter("ignore")
    try:
        model = read_mjcf(folder / "model.xml", [folder], compiled=True).compile()
        mujoco.MjData(model)
    except BadModel as error:
        return str(Problem("task.yaml", "scene.entities.robot.model", one_line(error)))
    return "taken"


def write(seed, folder):
    """Write the files of a case into a folder; return their texts."""
    files = case(seed)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8", errors="surrogateescape")
    return list(files.values())


def run(seed, folder):
    """Run a case in a child process; return its message, and what is wrong with it (empty: nothing)."""
    write(seed, folder)
    ((_, ended),) = in_children(attempt, [folder], SECONDS, MEMORY)
    return ended.text, ended.wrong or ("" if ended.text == "taken" else complaint(ended.text, folder))


def complaint(message, folder):
    """Return what is wrong with a message."""
    if "\n" in message:
        return "several lines"
    if ".xml" not in message:
        return "no place"
    if len(message.replace(str(folder), "")) > 600 or "n" * 201 in message:
        return "long"
    return ""


def main(first, count, folder):
    """Run cases; print each bad one and the counts."""
    taken = refused = bad = 0
    for seed in range(first, first + count):
        message, wrong = run(seed, folder)
        bad += bool(wrong)
        taken += message == "taken"
        refused += message != "taken"
        if wrong:
            print(f"seed {seed}: {wrong}: {message[:300]!r}", flush=True)
    print(f"{count} cases from seed {first}: {taken} taken, {refused} refused, {bad} bad", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])))
