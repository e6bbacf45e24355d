"""Untrusted MJCF: no file outside the task is opened, nothing hangs, and the message names cause and place."""

import os
import struct
import subprocess
import sys
import time

import pytest
from support import mjcf_grammar, mjcf_mutants
from support.child_processes import PATIENCE
from support.fault_sizes import amount, chosen, seeds

from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import folder_task
from rlcli.scene import untrusted_mjcf
from rlcli.scene.mjcf_safety_check import BadModel, MjcfScan
from rlcli.scene.untrusted_mjcf import check_mjcf, read_mjcf

BLOCK = '<body name="block"><joint name="slide" type="slide"/><geom type="box" size="0.3 0.3 0.3" mass="1"/></body>'


def model(inner="", body="", asset=""):
    return f"<mujoco>{inner}<asset>{asset}</asset><worldbody>{BLOCK}{body}</worldbody></mujoco>"


ATTACH = '<body><attach model="m" body="block" prefix="m-"/></body>'
PARTS = {
    "leads_out": '<mujoco><include file="../../outside.xml"/></mujoco>',
    "attaches_back": model(asset='<model name="m" file="../model.xml"/>', body=ATTACH),
    "many": model(body='<replicate count="1000"><geom size="1"/></replicate>'),
    "geoms": "<mujoco>" + '<geom size="1"/>' * 100 + "</mujoco>",
    "wrong": '<mujoco>\n<worldbody>\n<geom size="1" sise="2"/></worldbody></mujoco>',
    "no_mass": "<mujoco><worldbody>\n\n\n<body><joint/></body></worldbody></mujoco>",
}


def png(width, height):
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height) + b"\x08\x02\0\0\0" + b"\0" * 40


def linked(folder, name, target):
    (folder / name).symlink_to(target)


NAMED = {
    "an include of a user's file": (model('<include file="/etc/passwd"/>'), "lies outside"),
    "an include of a folder above": (model('<include file="../outside.xml"/>'), "lies outside"),
    "an include with backslashes": (model('<include file="..\\outside.xml"/>'), "lies outside"),
    "a mesh with backslashes": (model(asset='<mesh name="m" file=".\\..\\outside.obj"/>'), "lies outside"),
    "a mesh folder with backslashes": (
        model('<compiler meshdir="..\\"/>', asset='<mesh name="m" file="outside.obj"/>'),
        "lies outside",
    ),
    "a mesh whose folder is stripped": (
        model('<compiler meshdir=".." strippath="true"/>', asset='<mesh name="m" file="no/outside.obj"/>'),
        "lies outside",
    ),
    "an include far above": (model(f'<include file="{"../" * 30}etc/passwd"/>'), "lies outside"),
    "an include behind an asset folder": (
        model('<compiler assetdir=".."/><include file="outside.xml"/>'),
        "lies outside",
    ),
    "an include by a link": (model('<include file="link.xml"/>'), "lies outside"),
    "an include by a linked folder": (model('<include file="up/outside.xml"/>'), "lies outside"),
    "an include of an include outside": (model('<include file="parts/leads_out.xml"/>'), "lies outside"),
    "an include in references": (model('<include file="&#46;&#46;/outside.xml"/>'), "lies outside"),
    "an include of itself": (model('<include file="model.xml"/>'), "includes itself"),
    "an include of text": (model('<include file="notes.txt"/>'), "not MJCF"),
    "a pipe": (model('<include file="pipe.xml"/>'), "not a regular file"),
    "a folder as model": (model('<include file="folder.xml"/>'), "folder.xml"),
    "a mesh outside": (model(asset='<mesh name="m" file="../outside.obj"/>'), "lies outside"),
    "an absolute mesh": (model(asset='<mesh name="m" file="/etc/passwd"/>'), "lies outside"),
    "a device as mesh": (model(asset='<mesh name="m" file="/dev/zero" content_type="model/obj"/>'), "lies outside"),
    "a mesh behind a mesh folder": (
        model('<compiler meshdir="../"/>', asset='<mesh name="m" file="outside.obj"/>'),
        "lies outside",
    ),
    "a mesh folder that is named later": (
        f'<mujoco><asset><mesh name="m" file="outside.obj"/></asset><worldbody>{BLOCK}</worldbody>'
        '<compiler meshdir=".."/></mujoco>',
        "lies outside",
    ),
    "a mesh that is a pipe": (model(asset='<mesh name="m" file="pipe.obj"/>'), "not a regular file"),
    "a texture outside": (model(asset='<texture name="t" type="2d" file="../outside.png"/>'), "lies outside"),
    "a side of a cube outside": (model(asset='<texture name="t" fileright="../outside.png"/>'), "lies outside"),
    "a height field outside": (model(asset='<hfield name="h" file="../outside.png" size="1 1 1 1"/>'), "lies outside"),
    "a skin outside": (model("<deformable><skin file='../outside.skn'/></deformable>"), "lies outside"),
    "a flex outside": (model(body='<flexcomp name="f" type="mesh" file="../outside.obj"/>'), "lies outside"),
    "a model outside": (model(asset='<model name="m" file="../outside.xml"/>'), "lies outside"),
    "a compiled model as asset": (model(asset='<model name="m" file="bin.mjb"/>'), "compiled model"),
    "a resource of another kind": (
        model(asset='<mesh name="m" file="http://example.invalid/m.obj"/>'),
        "is not a file name",
    ),
    "a picture of four terapixels": (
        model(asset='<texture name="t" type="2d" file="huge.png"/>'),
        "the model is too large: its cost is",
    ),
    "a thousand million copies": (
        model(body='<replicate count="1000000000"><geom size="1"/></replicate>'),
        "the model is too large: its cost is",
    ),
    "a hundred million copies of nothing": (
        model(body='<replicate count="100000000"/>'),
        "the model is too large: its cost is",
    ),
    "copies of copies of copies": (
        model(body='<replicate count="1000">' * 3 + '<geom size="1"/>' + "</replicate>" * 3),
        "the model is too large: its cost is",
    ),
    "a flex of 3000 cubed": (
        model(body='<flexcomp name="f" type="grid" count="3000 3000 3000" spacing="1 1 1" dim="3"/>'),
        "the model is too large: its cost is",
    ),
    "a height field of 100,000 squared": (
        model(asset='<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>'),
        "the model is too large: its cost is",
    ),
    "a texture of 100,000 squared": (
        model(asset='<texture name="t" type="2d" builtin="flat" width="100000" height="1000000"/>'),
        "the model is too large: its cost is",
    ),
    "a time step of nothing": (model('<option timestep="0"/>'), "timestep is 0"),
    "a time step below nothing": (model('<option timestep="-1"/>'), "timestep is -1"),
    "a time step that is no number": (model('<option timestep="nan"/>'), "is not finite; give a finite number"),
    "endless iterations": (model('<option iterations="1000000000"/>'), "iterations is 1000000000"),
    "endless line search": (model('<option ls_iterations="1000000000"/>'), "ls_iterations"),
    "iterations below nothing": (model('<option iterations="-4"/>'), "iterations is -4"),
    "gravity that is no number": (model('<option gravity="0 nan 0"/>'), "is not finite; give a finite number"),
    "gravity of a neutron star": (
        model('<option gravity="0 0 -1e12"/>'),
        "is too large; at most 10,000 m/s^2 is allowed",
    ),
    "a huge geom": (model(body='<geom size="1e308"/>'), 'geom size="1e308" is too large; at most 1e+30 is allowed'),
    "a huge number in digits": (model(body=f'<geom size="{"9" * 40}"/>'), "is too large; at most 1e+30 is allowed"),
    "negative damping": (model(body='<joint damping="-1"/><geom size="1"/>'), 'damping="-1" is negative'),
    "negative armature": (model(body='<joint armature="-1"/><geom size="1"/>'), 'armature="-1" is negative'),
    "negative friction": (model('<default><joint frictionloss="-1"/></default>'), 'frictionloss="-1" is negative'),
    "an endless impratio": (model('<option impratio="inf"/>'), "is not finite; give a finite number"),
    "a tolerance that is no number": (model('<option tolerance="NaN"/>'), "is not finite; give a finite number"),
    "a keyframe of the wrong size": (model('<keyframe><key name="k" qpos="1 2 3"/></keyframe>'), "keyframe 'k'"),
    "a terabyte": (model('<size memory="1T"/>'), "size memory"),
    "a hundred gigabytes": (model('<size memory="100G"/>'), "size memory"),
    "a hundred million keyframes": (model('<size nkey="100000000"/>'), "size nkey"),
    "user data without end": (model('<size nuserdata="1000000000"/>'), "size nuserdata"),
    "a hundred thousand bodies in bodies": (model(body="<body>" * 100_000 + "</body>" * 100_000), "nested deeper"),
    "an entity bomb": (
        '<!DOCTYPE m [<!ENTITY a "b"><!ENTITY c "&a;&a;">]>' + model(body="&c;"),
        "DOCTYPE",
    ),
    "a file as entity": ('<!DOCTYPE m [<!ENTITY a SYSTEM "/etc/passwd">]>' + model(body="&a;"), "DOCTYPE"),
    "no XML": ("garbage", "not well-formed"),
    "nothing": ("", "not well-formed"),
    "XML cut short": (model()[:-30], "not well-formed"),
    "two documents": (model() + "<include file='../outside.xml'/>", "not well-formed"),
    "a null byte": (model() + "\0", "not well-formed"),
    "an unknown element": (model("<evil/>"), "evil"),
    "a model that attaches itself": (
        model(asset='<model name="m" file="model.xml"/>', body=ATTACH),
        "the model attaches itself",
    ),
    "a model that attaches itself by a backslash": (
        model(asset='<model name="m" file=".\\model.xml"/>', body=ATTACH),
        "the model attaches itself",
    ),
    "two models that attach each other": (
        model(asset='<model name="m" file="parts/attaches_back.xml"/>', body=ATTACH),
        "model.xml -> attaches_back.xml -> model.xml",
    ),
    "a model in copies of copies": (
        model(
            asset='<model name="m" file="parts/many.xml"/>',
            body='<replicate count="2000">' + ATTACH + "</replicate>",
        ),
        "the model is too large: its cost is",
    ),
    "an include in copies": (
        model(body='<replicate count="20000"><body><include file="parts/geoms.xml"/></body></replicate>'),
        "the model is too large: its cost is",
    ),
    "a sensor that every copy doubles": (
        model(body='<replicate count="40"><geom size="1"/></replicate>').replace(
            "</mujoco>", "<sensor><clock/></sensor></mujoco>"
        ),
        "sensors without an object",
    ),
    "a sensor of every copy": (
        model(body='<replicate count="2300"><site name="s"/></replicate>').replace(
            "</mujoco>", '<sensor><rangefinder site="s"/></sensor></mujoco>'
        ),
        "2,300 sensors, actuators and the like",
    ),
    "a sensor of the actuator of the tendon of every copy": (
        model(body='<replicate count="1500"><body><joint name="j"/><geom size="1"/></body></replicate>').replace(
            "</mujoco>",
            '<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon><actuator><motor name="a" tendon="t"/>'
            '</actuator><sensor><actuatorpos actuator="a"/></sensor></mujoco>',
        ),
        "4,500 sensors, actuators and the like",
    ),
    "a sensor of 900 million numbers": (
        model().replace("</mujoco>", '<sensor><user dim="900000000"/></sensor></mujoco>'),
        "the model is too large: its cost is",
    ),
    "a sensor of 100 million contacts": (
        model().replace("</mujoco>", '<sensor><contact subtree1="block" num="100000000"/></sensor></mujoco>'),
        "the model is too large: its cost is",
    ),
    "user data of every element": (
        model('<size nuser_geom="1000000"/>', body='<replicate count="4000"><geom size="1"/></replicate>'),
        "the model is too large: its cost is",
    ),
    "a mesh of 20,000 rows": (
        model(asset='<mesh name="m" builtin="supersphere" params="20000 1 1"/>'),
        "the model is too large: its cost is",
    ),
    "a plugin of a flex without a name": (
        model(
            body='<body name="f"><flexcomp name="f" count="3 3 1" spacing="1 1 1" dim="2"><plugin/></flexcomp></body>'
        ),
        "the plugin has no name",
    ),
    "numbers that one element stores for all others": (
        model(
            body='<replicate count="4000"><geom size="1"/></replicate><geom size="1" user="' + "0 " * 300_000 + '"/>'
        ),
        "the model is too large: its cost is",
    ),
    "a mesh file of every copy": (
        model(
            body='<replicate count="1000"><body><flexcomp name="f" type="mesh" file="large.obj" mass="1"/></body>'
            "</replicate>"
        ),
        "the model is too large: its cost is",
    ),
    "an element of 1,000 attributes": (
        model("<option " + " ".join(f'a{i}="1"' for i in range(1000)) + "/>"),
        "model.xml:1: the element has more than 200 attributes",
    ),
    "asset folders times assets": (
        model(
            "".join(f'<compiler meshdir="d{i}"/>' for i in range(1000)),
            asset="".join(f'<mesh name="m{i}" file="m{i}.obj"/>' for i in range(900)),
        ),
        "names 1001 folders of assets",
    ),
    "a million includes of one file": (model('<include file="parts/eye.xml"/>' * 400_000), "includes more than"),
    "fewer copies than none": (
        model(body='<replicate count="-4"><geom size="1"/></replicate>'),
        "replicate count is below 0",
    ),
    "a mass that is no number": (model(body='<geom size="1" mass="nan"/>'), 'geom mass="nan" is not finite'),
    "a place that is no number": (model(body='<geom size="1" pos="0 nan 0"/>'), 'geom pos="0 nan 0" is not finite'),
    "a damping without end": (model(body='<body><joint damping="inf"/></body>'), 'joint damping="inf" is not finite'),
    "a mistake in an included file": (model('<include file="parts/wrong.xml"/>'), "parts/wrong.xml: "),
    "a mistake that the compiler finds in an included file": (
        model('<include file="parts/no_mass.xml"/>'),
        "parts/no_mass.xml: ",
    ),
    "twenty megabytes of spaces": (model(" " * (20 << 20)), "larger than"),
}


@pytest.fixture
def task(tmp_path):
    """A task folder with links, pipes and other traps in it and beside it."""
    folder = tmp_path / "task"
    (folder / "parts").mkdir(parents=True)
    (folder / "task.yaml").write_text(mjcf_grammar.TASK)
    (folder / "notes.txt").write_text("<mujoco/>")
    (folder / "bin.mjb").write_bytes(b"\0" * 100)
    (folder / "huge.png").write_bytes(png(2_000_000, 2_000_000))
    with (folder / "large.obj").open("wb") as large:
        large.truncate(30 << 20)
    (folder / "folder.xml").mkdir()
    for name, text in PARTS.items():
        (folder / "parts" / f"{name}.xml").write_text(text)
    (tmp_path / "outside.xml").write_text("<mujoco/>")
    for name in ("obj", "png", "skn"):
        (tmp_path / f"outside.{name}").write_text("v 0 0 0")
    linked(folder, "link.xml", tmp_path / "outside.xml")
    linked(folder, "up", tmp_path)
    for name in ("pipe.xml", "pipe.obj"):
        os.mkfifo(folder / name)
    return folder


@pytest.mark.parametrize("name", chosen(list(NAMED), 16))
def test_bad_model_is_refused_by_name_before_it_is_opened(name, task):
    text, reason = NAMED[name]
    (task / "model.xml").write_text(text)
    begin = time.process_time()
    with pytest.raises(ConfigError) as caught:
        make_env(resolve(folder_task(task)))
    assert time.process_time() - begin < 10
    assert "model" in str(caught.value)
    assert reason in str(caught.value)
    assert ", line 0" not in str(caught.value)
    assert "task.yaml:6:" in str(caught.value)


def test_validate_exits_3_for_a_bad_model(task, capsys, monkeypatch):
    monkeypatch.chdir(task.parent)
    (task / "model.xml").write_text(model('<include file="../outside.xml"/>'))
    assert main(["validate", "./task", "--deep"]) == 3
    message = capsys.readouterr().err
    assert "model.xml:1: include: '../outside.xml' lies outside of" in message


def test_compiled_model_is_not_opened(task):
    (task / "task.yaml").write_text(mjcf_grammar.TASK.replace("model.xml", "bin.mjb"))
    with pytest.raises(ConfigError, match=r"compiled models \(.mjb\) are not opened"):
        make_env(resolve(folder_task(task)))


def test_files_of_task_package_and_links_are_opened(tmp_path):
    package = tmp_path / "robots"
    folder = package / "block"
    (folder / "parts").mkdir(parents=True)
    (package / "common").mkdir()
    for place in (package, folder):
        (place / "__init__.py").touch()
    (folder / "task.yaml").write_text(mjcf_grammar.TASK)
    (package / "common" / "floor.xml").write_text('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
    (folder / "parts" / "eye.xml").write_text('<mujoco><worldbody><site name="eye"/></worldbody></mujoco>')
    linked(folder, "light.xml", folder / "parts" / "light.xml")
    (folder / "parts" / "light.xml").write_text("<mujoco><worldbody><light/></worldbody></mujoco>")
    includes = '<include file="../common/floor.xml"/><include file="parts/eye.xml"/><include file="light.xml"/>'
    (folder / "model.xml").write_text(model(includes))
    env = make_env(resolve(folder_task(folder)))
    assert (env.engine.model.nsite, env.engine.model.nbody) == (1, 2)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the limits of a process are the system's")
def test_large_model_is_first_compiled_under_limits(tmp_path, monkeypatch):
    file = tmp_path / "model.xml"
    many = '<replicate count="6000" offset="1 0 0"><geom size="0.1"/></replicate>'
    file.write_text(model(body=many))
    assert len(read_mjcf(file, [tmp_path]).geoms) > 6_000  # much, and within the limits
    monkeypatch.setattr(untrusted_mjcf, "TIME_S", 1)
    file.write_text(model(body=many.replace("6000", "400000")))
    begin = os.times()
    with pytest.raises(BadModel, match=r"model\.xml: compiling takes more than"):
        read_mjcf(file, [tmp_path])
    assert os.times().children_user - begin.children_user < 5
    monkeypatch.setattr(untrusted_mjcf, "_WALL_TIME_S", 0.01)
    with pytest.raises(BadModel, match=r"takes more than 0.01 s; try again when the machine is less busy"):
        read_mjcf(file, [tmp_path])


def test_references_to_copies_cost_copies_times_references(tmp_path):
    """A scanner of 360 rays on a robot with 40 motors: MuJoCo looks 360 times at 400 elements."""
    file = tmp_path / "model.xml"
    rays = model(body='<body name="scanner"><replicate count="360"><site name="ray"/></replicate></body>')
    parts = '<actuator><motor joint="slide"/></actuator>' * 40 + '<sensor><rangefinder site="ray"/></sensor>'
    file.write_text(rays)
    without = check_mjcf(file, [tmp_path]).cost.total
    file.write_text(rays.replace("</mujoco>", parts + "</mujoco>"))
    cost = check_mjcf(file, [tmp_path]).cost
    assert cost.referring == 400
    assert 360 * 400 / 10 < cost.total - without < 360 * 400 / 3


def test_elements_are_named_under_limits(tmp_path, monkeypatch):
    """MuJoCo compares each new name with all others, which takes as long as reading a file with many joints."""
    file, log = tmp_path / "model.xml", tmp_path / "log"
    file.write_text(model())
    note = f"open({str(log)!r}, 'w').write(repr([geom.name for geom in scene.geoms]))"
    code = untrusted_mjcf._SUBPROCESS_CODE.replace("    scene.compile()", f"    {note}\n    scene.compile()")
    monkeypatch.setattr(untrusted_mjcf, "SUBPROCESS_COST", 0)
    monkeypatch.setattr(untrusted_mjcf, "_SUBPROCESS_CODE", code)
    read_mjcf(file, [tmp_path])
    assert log.read_text() == "['geom_0']"


def test_system_without_limits_reads_models(tmp_path, monkeypatch):
    file = tmp_path / "model.xml"
    file.write_text(model())
    monkeypatch.setattr(untrusted_mjcf, "SUBPROCESS_COST", 0)
    hidden = "import sys; sys.modules['resource'] = None\n"
    monkeypatch.setattr(untrusted_mjcf, "_SUBPROCESS_CODE", hidden + untrusted_mjcf._SUBPROCESS_CODE)
    assert len(read_mjcf(file, [tmp_path]).geoms) == 1


def test_same_files_are_compiled_in_one_subprocess(tmp_path, monkeypatch):
    file, mesh, log = tmp_path / "model.xml", tmp_path / "part.obj", tmp_path / "log"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    file.write_text(model(asset='<mesh name="part" file="part.obj"/>', body='<geom type="mesh" mesh="part"/>'))
    note = f"open({str(log)!r}, 'a').write('x')\n"
    monkeypatch.setattr(untrusted_mjcf, "SUBPROCESS_COST", 0)
    monkeypatch.setattr(untrusted_mjcf, "_SUBPROCESS_CODE", note + untrusted_mjcf._SUBPROCESS_CODE)
    for _ in range(3):
        read_mjcf(file, [tmp_path])
    assert log.read_text() == "x"
    mesh.write_text(mesh.read_text().replace("v 0 0 1", "v 0 0 1.5"))
    read_mjcf(file, [tmp_path])
    assert log.read_text() == "xx"


# --- mutants ---


@pytest.mark.skipif(not hasattr(os, "fork"), reason="children are forked")
@pytest.mark.parametrize("first", seeds(1, 10, 500)[::10])
def test_mutated_models_are_accepted_or_refused_without_a_crash(first, tmp_path):
    count = amount(1, 10)
    line = [sys.executable, mjcf_mutants.__file__, str(first), str(count), str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert done.stdout.count("taken") == count


@pytest.mark.skipif(not hasattr(os, "fork"), reason="children are forked")
@pytest.mark.parametrize("first", seeds(1, 20, 200))
def test_models_of_the_grammar_are_accepted_or_refused_with_a_place(first, tmp_path):
    count = amount(20, 100)
    line = [sys.executable, mjcf_grammar.__file__, str(first * count), str(count), str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def test_large_model_leaves_no_log_in_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    geoms, odd = '<geom size="1"/>' * 6000, '<custom><text name="odd" data="NaN"/></custom>'  # which MuJoCo warns of
    (tmp_path / "model.xml").write_text(f"<mujoco>{odd}<worldbody>{geoms}</worldbody></mujoco>")
    read_mjcf(tmp_path / "model.xml", [tmp_path])
    assert [file.name for file in tmp_path.iterdir()] == ["model.xml"]


# --- several entities ---


def several(task, count, text, name="o.xml"):
    """Let the task have `count` more entities with one model."""
    (task / "model.xml").write_text(model())
    (task / name).write_text(text)
    entities = "".join(f", r{i}: {{model: {name}}}" for i in range(count))
    (task / "task.yaml").write_text(mjcf_grammar.TASK.replace("model.xml}", "model.xml}" + entities))
    return resolve(folder_task(task))


BODY = '<worldbody><body name="b"><geom size="0.1"/></body></worldbody>'
HFIELD = f'<mujoco><asset><hfield name="t" nrow="2100" ncol="2100" size="1 1 1 1"/></asset>{BODY}</mujoco>'
COPIES = model(body='<replicate count="4000"><geom size="0.1"/></replicate>')


@pytest.mark.parametrize("text", [HFIELD, COPIES], ids=["height fields", "copies"])
def test_models_of_many_entities_are_too_large_together(task, text):
    begin = time.process_time()
    with pytest.raises(
        ConfigError, match=r"o\.xml: the first \d+ models of the scene are too large together: the estimated"
    ):
        make_env(several(task, 300, text))
    assert time.process_time() - begin < 10


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the limits of a process are the system's")
def test_models_of_many_entities_are_first_compiled_under_limits(task):
    with pytest.raises(ConfigError, match=r"o\.xml \(81 models together\): compiling takes more than"):
        make_env(several(task, 80, HFIELD))


def test_numbers_that_one_entity_stores_for_all_others_count(task):
    (task / "user.xml").write_text(
        f'<mujoco><worldbody><body><geom size="1" user="{"0 " * 300_000}"/></body></worldbody></mujoco>'
    )
    resolved = several(task, 1, COPIES)
    text = (task / "task.yaml").read_text()
    (task / "task.yaml").write_text(text.replace("r0: {", "u: {model: user.xml}, r0: {"))
    with pytest.raises(ConfigError, match="too large together"):
        make_env(resolve(resolved.source))


def test_small_models_of_many_entities_are_compiled_at_once(task, monkeypatch):
    monkeypatch.setattr(untrusted_mjcf, "_compile_in_subprocess", lambda files: pytest.fail("a subprocess"))
    small = f"<mujoco>{BODY}</mujoco>"
    assert make_env(several(task, 40, small)).engine.model.nbody == 42


def test_file_of_many_entities_is_parsed_once(task, monkeypatch):
    parsed = []
    read = MjcfScan.read
    monkeypatch.setattr(MjcfScan, "read", lambda scan: (parsed.append(scan.main.name), read(scan))[1])
    make_env(several(task, 40, f"<mujoco>{BODY}</mujoco>"))
    assert sorted(parsed) == ["model.xml", "o.xml"]


def test_many_shapes_are_refused(task):
    with pytest.raises(ConfigError, match="601 entities are too many; at most 500"):
        several(task, 600, f"<mujoco>{BODY}</mujoco>")


def test_chain_of_attached_models_costs_its_elements(tmp_path):
    """Each of 30 files attaches the next one once: about 90 bodies."""
    for i in range(30):
        asset = f'<asset><model name="m" file="a{i + 1}.xml"/></asset>' if i < 29 else ""
        attach = '<attach model="m" body="r" prefix="p"/>' if i < 29 else ""
        text = f'{asset}<worldbody><body name="r"><body><geom size=".1"/>{attach}</body></body></worldbody>'
        (tmp_path / f"a{i}.xml").write_text(f"<mujoco>{text}</mujoco>")
    checked = check_mjcf(tmp_path / "a0.xml", [tmp_path])
    assert checked.cost.elements < 300
    assert checked.cost.total < 5_000
    assert len(read_mjcf(tmp_path / "a0.xml", [tmp_path]).bodies) > 50


def test_models_that_are_attached_twice_double_at_every_level(tmp_path):
    for i in range(30):
        asset = f'<asset><model name="m" file="a{i + 1}.xml"/></asset>' if i < 29 else ""
        attach = (
            '<body><attach model="m" body="r" prefix="p"/></body><body><attach model="m" body="r" prefix="q"/></body>'
        )
        text = f'{asset}<worldbody><body name="r"><geom size=".1"/>{attach if i < 29 else ""}</body></worldbody>'
        (tmp_path / f"a{i}.xml").write_text(f"<mujoco>{text}</mujoco>")
    with pytest.raises(BadModel, match="the model is too large: its cost is"):
        read_mjcf(tmp_path / "a0.xml", [tmp_path])
