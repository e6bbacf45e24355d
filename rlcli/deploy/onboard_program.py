"""What `export --verify` leaves beside a policy: the model that it was trained on, and a program that runs it there."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from rlcli.deploy.numpy_export import literal
from rlcli.errors import UsageError
from rlcli.runs.atomic_io import disk_error, write_atomic

PROGRAM = "run_policy.py"
MODEL = "model.xml"
_MARK = "<!-- written by rlcli export -->\n"
"""The first line of a model, by which it is known as one that may be replaced."""
_TEMPLATE = Path(__file__).parent / "deployed" / PROGRAM
_OPEN_ONNX = """        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        self.about = json.loads(session.get_modelmeta().custom_metadata_map["rlcli"])
        self.policy = lambda x: dict(zip([o.name for o in session.get_outputs()], session.run(None, x), strict=True))
"""
_OPEN = {
    "onnx": _OPEN_ONNX,
    "numpy": """        space = runpy.run_path(str(file))
        self.about, self.policy = space["METADATA"], space["run"]
""",
    "torch": """        program = torch.export.load(str(file), extra_files=(extra := {"rlcli": ""})).module()
        names, self.about = ("obs", "h_in", "c_in"), json.loads(extra["rlcli"])
        tensors = lambda x: [torch.from_numpy(x[name]) for name in names if name in x]  # noqa: E731
        self.policy = lambda x: {name: value.detach().numpy() for name, value in program(*tensors(x)).items()}
""",
}
_USUAL = "import json\nimport sys\nfrom pathlib import Path\n\nimport mujoco\nimport numpy as np\n"
_IMPORTS = {
    "onnx": f"{_USUAL}import onnxruntime\n",
    "numpy": _USUAL.replace("json", "runpy"),
    "torch": f"{_USUAL}import torch\n",
}
_NEEDS = {"onnx": "numpy, mujoco, onnxruntime", "numpy": "numpy and mujoco", "torch": "numpy, mujoco and torch"}
_ALIKE = {"rtol": 1e-4, "atol": 1e-5}
"""How far a model may be from one that was read from its text, which may have six digits."""


def program(policy: Path, model: Path, format_: str) -> str:
    """The program that runs a policy file on a model file, both beside it."""
    text = _TEMPLATE.read_text(encoding="utf-8")
    text = text.replace(_NEEDS["onnx"], _NEEDS[format_]).replace(_IMPORTS["onnx"], _IMPORTS[format_])
    text = text.replace(_OPEN["onnx"], _OPEN[format_]).replace('"policy.onnx"', literal(policy.name))
    text = text.replace('"model.xml"', literal(model.name))
    return text if model.suffix == ".xml" else text.replace("from_xml_path", "from_binary_path")


def require_room(policy: Path) -> None:
    """What is written beside a policy file takes no other file's place.

    Raises:
        UsageError: if the policy has the program's name, or a model stands there that is somebody's own.
    """
    if policy.name == PROGRAM:
        raise UsageError(f"{PROGRAM} is the program that --verify writes beside the policy", hint="another --output")
    own = policy.with_name(MODEL)
    try:
        with own.open("rb") as file:
            ours = file.read(len(_MARK)) == _MARK.encode()
    except FileNotFoundError:
        return
    except OSError:  # a folder, or not to be read
        ours = False
    if not ours:
        raise UsageError(
            f"{own} stands where --verify writes the model, and is not one that export has written",
            hint="an --output in a folder of its own",
        )


def write_program(folder: Path, text: str) -> bool:
    """Write the program, unless another stands there, which may be somebody's work; whether it is there now.

    Raises:
        MachineError: if the disk refuses.
    """
    file = folder / PROGRAM
    try:
        if file.exists() or file.is_symlink():
            return file.is_file() and file.read_text(encoding="utf-8", errors="replace") == text
        write_atomic(file, text)
    except OSError as error:
        raise disk_error(folder, error) from error
    return True


def write_model(spec: mujoco.MjSpec, model: mujoco.MjModel, folder: Path) -> Path:
    """Write a model as text where the text says all of it, else compiled, for this version of MuJoCo.

    Raises:
        MachineError: if the disk refuses.
    """
    text = _as_text(spec, model)
    file = folder / (MODEL if text is not None else "model.mjb")
    write_atomic(file, _MARK + text if text is not None else _as_bytes(model))
    return file


def open_model(file: Path) -> mujoco.MjModel:
    """A model that was written here."""
    read = mujoco.MjModel.from_xml_path if file.suffix == ".xml" else mujoco.MjModel.from_binary_path
    return read(str(file))


def _as_bytes(model: mujoco.MjModel) -> bytes:
    """A compiled model as MuJoCo reads it from a file."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def _as_text(spec: mujoco.MjSpec, model: mujoco.MjModel) -> str | None:
    assets = [*spec.meshes, *spec.hfields, *spec.textures, *spec.skins]
    if any(getattr(asset, "file", "") or any(getattr(asset, "cubefiles", [])) for asset in assets):
        return None
    try:
        with _all_digits():
            text = str(spec.to_xml())
        return text if _alike(mujoco.MjModel.from_xml_string(text), model) else None
    except (ValueError, RuntimeError):  # something that has no text
        return None


@contextlib.contextmanager
def _all_digits() -> Iterator[None]:
    """MuJoCo writes six digits of a number unless told otherwise, by a function that has no name in Python."""
    try:
        found = next(Path(mujoco.__file__).parent.glob("*mujoco*.[sd][oly]*"))
        library = ctypes.CDLL(str(found))
        get, put = library._mjPRIVATE__get_xml_precision, library._mjPRIVATE__set_xml_precision
    except (StopIteration, OSError, AttributeError):  # six have to do
        yield
        return
    before = get()
    put(17)
    try:
        yield
    finally:
        put(before)


def _alike(read: mujoco.MjModel, model: mujoco.MjModel) -> bool:
    """Whether two models are the same but for the digits of their numbers."""
    for one, other in ((read, model), (read.opt, model.opt)):
        for name in dir(model if other is model else model.opt):
            value = getattr(other, name, None) if not name.startswith("_") else None
            if isinstance(value, float | int | np.ndarray) and np.asarray(value).dtype.kind in "fiub":
                found = getattr(one, name)
                if np.shape(found) != np.shape(value) or not np.allclose(found, value, **_ALIKE, equal_nan=True):
                    return False
    return True
