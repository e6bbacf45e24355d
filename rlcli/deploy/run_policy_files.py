"""Writer of the files beside a policy exported with --verify: the MuJoCo model, and a program that runs the policy."""

import contextlib
import ctypes
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from rlcli.deploy.metadata import required_inputs, terms_of_task_code
from rlcli.deploy.numpy_export import literal, substitute
from rlcli.errors import UsageError
from rlcli.runs.atomic_io import disk_errors, require_regular, write_atomic

PROGRAM = "run_policy.py"
MODEL = "model.xml"
BINARY_MODEL = "model.mjb"
_MARK = "<!-- written by rlcli export -->\n"
"""First line of an exported model. A model file with this line may be overwritten."""
_PROGRAM_MARK = b'"""Runs an exported policy on its robot in MuJoCo'
"""First bytes of the program. A binary model may be overwritten if a program with these bytes beside it loads it."""
_TEMPLATE = Path(__file__).parent / "deployed" / PROGRAM
_OPEN = {
    "onnx": """        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        self.metadata = json.loads(session.get_modelmeta().custom_metadata_map["rlcli"])
        self.policy = lambda x: dict(zip([o.name for o in session.get_outputs()], session.run(None, x), strict=True))
""",
    "numpy": """        space = runpy.run_path(str(file))
        self.metadata, self.policy = space["METADATA"], space["run"]
""",
    "torch": """        program = torch.export.load(str(file), extra_files=(extra := {"rlcli": ""})).module()
        names, self.metadata = ("obs", "h_in", "c_in"), json.loads(extra["rlcli"])
        tensors = lambda x: [torch.from_numpy(x[name]) for name in names if name in x]  # noqa: E731
        self.policy = lambda x: {name: value.detach().numpy() for name, value in program(*tensors(x)).items()}
""",
}
"""Format -> lines of `Controller.__init__` that open a policy file; the template contains the lines for onnx."""
_STANDARD = "import json\nimport sys\nfrom pathlib import Path\n\nimport mujoco\nimport numpy as np\n"
_IMPORTS = {
    "onnx": f"{_STANDARD}import onnxruntime\n",
    "numpy": _STANDARD.replace("json", "runpy"),
    "torch": f"{_STANDARD}import torch\n",
}
_PACKAGES = {"onnx": "numpy, mujoco, onnxruntime", "numpy": "numpy and mujoco", "torch": "numpy, mujoco and torch"}
_ACT = "    def act(self, data, inputs):\n"
_CHECK = """        sizes = SIZES
        for name, size in sizes.items():
            if np.size(inputs.get(name, ())) != size:
                needed = f"Controller.act needs inputs['{name}'] ({size} values)"
                way = "an observation is the value of one step, with its modifiers, clip and scale applied"
                raise ValueError(f"{needed}; {way}")
"""
"""Lines that are inserted at the start of `Controller.act` for a policy that needs inputs."""
_CHECK_SUBSTEPS = """        # remove this check if the drives of the robot compute the actuator models, with `targets`
        if self.substeps < self.metadata["decimation"]:
            names = ", ".join(model["name"] for model in self.plan["actuator_models"])
            raise ValueError(f"call Controller.controls before every physics step: it computes the actuators {names}")
"""
"""Lines that are inserted at the start of `Controller.act` for a robot with actuator models."""
_LOOP = "    policy, xml = "
"""Start of the program's simulation loop, which runs the policy with all commands zero."""
_TOLERANCE = {"rtol": 1e-4, "atol": 1e-5}
"""Largest accepted difference of a model that was read from XML, which may have only six digits."""


def generate_program(policy: Path, model: Path, format_: str, metadata: dict[str, Any]) -> str:
    """Return the source code of the program that runs a policy file on a model file.

    The program must be in the same folder as the two files. If only the task's code can compute an observation or a
    control, the program's simulation loop is replaced by an error message; the class `Controller` still works.
    """
    text = _TEMPLATE.read_text(encoding="utf-8")
    for parts in (_PACKAGES, _IMPORTS, _OPEN):
        text = text.replace(parts["onnx"], parts[format_])
    reader = "from_xml_path" if model.suffix == ".xml" else "from_binary_path"
    names = {'"policy.onnx"': literal(policy.name), '"model.xml"': literal(model.name), "from_xml_path": reader}
    text = substitute(text, names)
    # inserted last: nothing is substituted in names that come from the checkpoint
    if sizes := required_inputs(metadata):
        text = text.replace(_ACT, _ACT + _CHECK.replace("SIZES", literal(sizes)))
    if (metadata["deployment"] or {}).get("actuator_models"):
        text = text.replace(_ACT, _ACT + _CHECK_SUBSTEPS)
    if terms := terms_of_task_code(metadata):
        text = text[: text.index(_LOOP)] + f"    sys.exit({literal('error: ' + '; '.join(terms))})\n"
    return text


def check_overwrites(policy: Path) -> None:
    """Check that the files that --verify writes beside `policy` overwrite neither the policy nor a model of the user.

    Raises:
        UsageError: if the policy has the program's name, or the folder has a model that export did not write.
    """
    if policy.name == PROGRAM:
        message = f"--verify writes the program {PROGRAM}, which would overwrite the policy"
        raise UsageError(message, hint="give the policy another name with --output FILE")
    for model in (policy.with_name(MODEL), policy.with_name(BINARY_MODEL)):
        require_regular(model)
        if os.path.lexists(model) and not _is_exported(model):
            message = f"--verify may overwrite {model}, which is not a file of `rlcli export`"
            raise UsageError(message, hint="give an --output in another folder")


def _is_exported(model: Path) -> bool:
    """Return whether `rlcli export` wrote this model file.

    An XML has a mark in its first line; a binary file has none, so the program that loads it must be beside it.
    """
    is_xml = model.name == MODEL
    try:
        with (model if is_xml else model.with_name(PROGRAM)).open("rb") as file:
            text = file.read(2**20)
    except OSError:  # no program, a folder, or no permission
        return False
    if is_xml:
        return text.startswith(_MARK.encode())
    return text.startswith(_PROGRAM_MARK) and literal(model.name).encode() in text


def write_program(folder: Path, text: str) -> bool:
    """Write the program `run_policy.py` if there is no file of this name; return whether the file now has this text.

    An existing file is never replaced: the user may have edited it.

    Raises:
        MachineError: if the file cannot be written.
    """
    file = folder / PROGRAM
    with disk_errors(folder):
        if file.exists() or file.is_symlink():
            return file.is_file() and file.stat().st_size < 2**20 and file.read_bytes() == text.encode()
        write_atomic(file, text)
    return True


def write_model(spec: mujoco.MjSpec, model: mujoco.MjModel, folder: Path) -> Path:
    """Write a model to a folder and return the path of the file.

    The file is XML if XML can describe the whole model, else a binary file for this version of MuJoCo.

    Args:
        spec: the specification from which the model was compiled.
        model: the model.
        folder: the folder.

    Raises:
        MachineError: if the file cannot be written.
    """
    text = _model_xml(spec, model)
    file = folder / (MODEL if text is not None else BINARY_MODEL)
    if text is not None:
        return write_atomic(file, _MARK + text)
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return write_atomic(file, buffer.tobytes())


def open_model(file: Path) -> mujoco.MjModel:
    """Load the model from a file that `write_model` has written."""
    read = mujoco.MjModel.from_xml_path if file.suffix == ".xml" else mujoco.MjModel.from_binary_path
    return read(str(file))


def _model_xml(spec: mujoco.MjSpec, model: mujoco.MjModel) -> str | None:
    """Return a model as XML; None if the XML would need other files, or does not compile to the same model."""
    assets = [*spec.meshes, *spec.hfields, *spec.textures, *spec.skins]
    if any(getattr(asset, "file", "") or any(getattr(asset, "cubefiles", [])) for asset in assets):
        return None
    try:
        with _full_xml_precision():
            text = str(spec.to_xml())
        return text if _models_close(mujoco.MjModel.from_xml_string(text), model) else None
    except (ValueError, RuntimeError):  # an element that XML cannot express
        return None


@contextlib.contextmanager
def _full_xml_precision() -> Iterator[None]:
    """Make MuJoCo write numbers with 17 digits instead of six; its Python package has no function for that."""
    try:
        found = next(Path(mujoco.__file__).parent.glob("*mujoco*.[sd][oly]*"))
        library = ctypes.CDLL(str(found))
        get, put = library._mjPRIVATE__get_xml_precision, library._mjPRIVATE__set_xml_precision
    except (StopIteration, OSError, AttributeError):  # fall back to six digits
        yield
        return
    before = get()
    put(17)
    try:
        yield
    finally:
        put(before)


def _models_close(read: mujoco.MjModel, model: mujoco.MjModel) -> bool:
    """Return whether a model, read back from XML, equals the original within the precision of XML."""
    for one, other in ((read, model), (read.opt, model.opt)):
        for name in dir(model if other is model else model.opt):
            value = getattr(other, name, None) if not name.startswith("_") else None
            if isinstance(value, float | int | np.ndarray) and np.asarray(value).dtype.kind in "fiub":
                found = getattr(one, name)
                if np.shape(found) != np.shape(value) or not np.allclose(found, value, **_TOLERANCE, equal_nan=True):
                    return False
    return True
