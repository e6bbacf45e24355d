"""Read model files of torch (.pt) and Stable-Baselines3 (.zip) safely, for `rlcli import`.

The files may be untrusted: only tensors and plain data are unpickled.
"""

import io
import re
import stat
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from rlcli.errors import CheckpointError, one_line
from rlcli.machine.memory import available_memory
from rlcli.runs import pickle_check
from rlcli.runs.safe_io import read_file

_MAX_BYTES = 4 * 2**30
"""Largest size of a file, and of all members of a zip together [bytes]."""
_MAX_RATIO = 100
_MAX_MEMBERS = 20_000
VEC_NORMALIZE_HINT = (
    "a pickle can run code, so rlcli opens none; if you trust the file, convert it in Python:"
    " v = pickle.load(open('vecnormalize.pkl', 'rb')).obs_rms; safetensors.numpy.save_file("
    "{'mean': v.mean, 'var': v.var}, 'normalizer.safetensors'), then --normalizer normalizer.safetensors"
)


def read_archive_file(file: Path) -> bytes:
    """Return the content of a file; links are followed.

    Raises:
        CheckpointError: if there is no such file, or the file is larger than 4 GiB or a quarter of the memory.
    """
    limit = min(_MAX_BYTES, available_memory() // 4)
    return read_file(file.resolve(), limit, missing=f"there is no file {file}; check the path")


def read_member(file: Path, name: str) -> bytes:
    """Return the content of the member `name` of a zip file. All members of the file are checked first.

    Raises:
        CheckpointError: if the file is not a zip, is too large, has unsafe members, or lacks the member.
    """
    data = read_archive_file(file)
    if data[:1] == b"\x80":
        raise CheckpointError(
            f"{file} is a pickle, which rlcli does not open; give the .zip file of a model of Stable-Baselines3",
            hint="write it in Python: model.save('model.zip')",
        )
    archive = _archive(data, str(file))
    if name not in archive.namelist():
        raise CheckpointError(f"{file} has no {name}; save the model with Stable-Baselines3")
    return _content(archive, name, str(file))


def _archive(data: bytes, where: str) -> zipfile.ZipFile:
    """Open a zip file, and check that all members are plain files with safe names and not too large.

    `where` names the file in messages.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        members = archive.infolist()
    except Exception as error:  # zipfile raises many types of errors for malformed numbers
        raise CheckpointError(f"{where} is not a valid zip file: {one_line(error)}; save the file again") from None
    if len(members) > _MAX_MEMBERS:
        raise CheckpointError(
            f"{where} has {len(members)} members; at most {_MAX_MEMBERS} are allowed; save the file again"
        )
    seen: set[str] = set()
    for member in members:
        name = member.filename
        parts = re.split(r"[/\\]", name)
        outside = name != member.orig_filename or ".." in parts or name[:1] in ("/", "\\", "") or ":" in name
        refused = {
            "its path leads out of the file": outside,
            "it appears twice": name.casefold() in seen,
            "the member is a link": stat.S_ISLNK(member.external_attr >> 16),
            "it is encrypted": member.flag_bits & 1,
            "its compression is not supported": member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED),
            f"it is more than {_MAX_RATIO} times larger unpacked": member.file_size
            > _MAX_RATIO * max(member.compress_size, 1),
        }
        for reason, applies in refused.items():
            if applies:
                message = f"{where} has a member {name[:60]!r} that is refused: {reason}; save the file again"
                raise CheckpointError(message)
        seen.add(name.casefold())
    total, limit = sum(member.file_size for member in members), min(_MAX_BYTES, available_memory() // 4)
    if total > limit:
        message = (
            f"{where} unpacks to {total:,} bytes; at most {limit:,} are read (4 GiB, or a quarter of the free memory)"
        )
        raise CheckpointError(message, hint="free memory, or give a smaller policy")
    return archive


def _content(archive: zipfile.ZipFile, name: str, where: str) -> bytes:
    try:
        size = archive.getinfo(name).file_size
        with archive.open(name) as member:
            data = member.read(size + 1)
    except Exception as error:
        raise CheckpointError(f"{where}: {name} is corrupt: {one_line(error)}; save the file again") from None
    if len(data) != size:
        raise CheckpointError(f"{where}: {name} is corrupt: {len(data)} of {size} bytes; save the file again")
    return data


def read_tensors(data: bytes, where: str) -> Mapping[str, Any]:
    """Load nested dictionaries of tensors and numbers from a .pt file; a pickle with other types is refused.

    Args:
        data: content of the file.
        where: name of the file in messages.

    Raises:
        CheckpointError: if the file is not a torch file, is corrupt, or has other types.
    """
    if data[:4] != b"PK\x03\x04":
        kind = "a plain pickle or a file of torch before 1.6" if data[:1] == b"\x80" else "not a torch file"
        raise CheckpointError(
            f"{where} is {kind}, which rlcli does not open; give a .pt file of torch 1.6 or newer with only tensors",
            hint=pickle_check.SAVE_HINT,
        )
    archive = _archive(data, where)
    described = [name for name in archive.namelist() if name.rpartition("/")[2] == "data.pkl"]
    if len(described) != 1 or archive.getinfo(described[0]).file_size > pickle_check.MAX_BYTES:
        raise CheckpointError(
            f"{where} is not a torch file: its data.pkl is missing or too large; save the file again with torch.save"
        )
    pickle_check.require_tensors_only(_content(archive, described[0], where), where)
    try:
        with warnings.catch_warnings(action="ignore"):
            saved = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception:  # torch's own message advises to unpickle the file without any check
        message = f"{where} is corrupt, or has more than tensors, numbers and text"
        raise CheckpointError(message, hint=pickle_check.SAVE_HINT) from None
    if not isinstance(saved, Mapping):
        raise CheckpointError(f"{where} is not a mapping of names to tensors", hint=pickle_check.SAVE_HINT)
    return saved
