"""Check the pickle in a .pt file before torch reads the file.

The operations of the pickle are simulated, not executed; operations that could run code are refused.
"""

import pickletools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from rlcli.errors import CheckpointError, one_line

MAX_BYTES = 4 * 2**20
"""Size limit of a pickle [bytes], and of the number of values in a pickle; a value counts at each reference to it."""
_MAX_DEPTH = 100
_MAX_KEY = 2**31
"""Integers from this size on are refused as dictionary keys: a file could have many keys with the same hash."""
_FUNCTIONS = {"torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter"}
_ORDERED_DICT = "collections OrderedDict"
_DTYPES = ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Byte", "Bool")
_ALLOWED = {_ORDERED_DICT, *_FUNCTIONS, *(f"torch {dtype}Storage" for dtype in _DTYPES)}
"""Global names that the pickle in a .pt file may contain; a file with another name is refused."""
_REFUSED_OPCODES = {"STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4", "PERSID"}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
SAVE_HINT = (
    "save it again in Python: torch.save({'model_state_dict': policy.state_dict()}, 'model.pt') for RSL-RL,"
    " model.save('model.zip') for Stable-Baselines3"
)


@dataclass(slots=True, eq=False)
class _Value:
    """Value that a pickle would create, with only the properties that decide whether later operations are safe."""

    kind: str = "other"
    """`tuple`, `list`, `dict`, `other`, or a name of `_ALLOWED`."""
    is_key: bool = False
    """Whether the value may be a key of a dictionary."""
    depth: int = 0
    """Number of levels of nested containers."""
    size: int = 1
    """Number of values in the value, itself included."""
    stored: bool = False
    """Whether a container holds the value. The value must not grow any more: the container's `size` would be wrong."""


@dataclass(slots=True)
class _Simulation:
    """Stack and memo of a pickle whose operations are simulated in the order in which torch executes them."""

    stack: list[_Value] = field(default_factory=list)
    below: list[list[_Value]] = field(default_factory=list)
    """Stacks that were set aside when a MARK operation started a new one; the newest is last."""
    memo: dict[int, _Value] = field(default_factory=dict)

    def apply(self, opcode: str, argument: Any) -> None:
        """Simulate one operation.

        Raises:
            _RefusedError: if the operation could run code, or could make torch or rlcli hang or crash.
            IndexError, KeyError: if the pickle is corrupt.
        """
        stack = self.stack
        match opcode:
            case "GLOBAL" if argument in _ALLOWED:
                stack.append(_Value(argument))
            case "GLOBAL":
                raise _RefusedError(
                    f"refers to '{argument[:80]}'; only tensors, numbers, text, lists and dictionaries are allowed"
                )
            case "BINUNICODE" | "SHORT_BINSTRING":
                stack.append(_Value(is_key=True))
            case "BININT" | "BININT1" | "BININT2" | "LONG1":
                stack.append(_Value(is_key=abs(argument) < _MAX_KEY))
            case "BINFLOAT" | "NONE" | "NEWTRUE" | "NEWFALSE":
                stack.append(_Value())
            case "EMPTY_LIST" | "EMPTY_DICT":
                stack.append(_Value(opcode[6:].lower(), depth=1))
            case "EMPTY_TUPLE" | "TUPLE1" | "TUPLE2" | "TUPLE3":
                self._tuple([stack.pop() for _ in range(_TUPLES[opcode])])
            case "TUPLE":
                self._tuple(self._since_mark())
            case "MARK":
                self.below.append(stack)
                self.stack = []
            case "APPEND":
                self._add("list", [stack.pop()])
            case "APPENDS":
                self._add("list", self._since_mark())
            case "SETITEM":
                value, key = stack.pop(), stack.pop()
                self._set([key, value])
            case "SETITEMS":
                self._set(self._since_mark())
            case "BUILD":
                self._build(stack.pop())
            case "REDUCE":
                arguments, function = stack.pop(), stack.pop()
                stack.append(_result(function.kind, arguments))
            case "BINPERSID":  # BINPERSID makes a storage: torch uses an item of this tuple as the key of a dictionary
                if stack.pop().depth > 1:
                    raise _RefusedError("has a tensor whose storage has a name that is not text")
                stack.append(_Value())
            case "BINPUT" | "LONG_BINPUT":
                self.memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(self.memo[argument])
            case "PROTO" | "STOP":
                pass
            case _:
                what = "creates objects" if opcode in _REFUSED_OPCODES else f"has the operation {opcode}"
                raise _RefusedError(f"{what}; only tensors, numbers, text, lists and dictionaries are allowed")

    def _since_mark(self) -> list[_Value]:
        items = self.stack
        self.stack = self.below.pop()
        return items

    def _tuple(self, items: list[_Value]) -> None:
        self.stack.append(_Value("tuple", depth=1))
        self._add("tuple", items)

    def _set(self, items: list[_Value]) -> None:
        if not all(key.is_key for key in items[::2]):
            raise _RefusedError(f"has a dictionary key that is neither text nor a whole number below {_MAX_KEY:,}")
        self._add("dict", items)

    def _build(self, state: _Value) -> None:
        if state.kind != "dict":
            raise _RefusedError(
                "sets attributes of an object; only tensors, numbers, text, lists and dictionaries are allowed"
            )
        self._add("dict", [state])

    def _add(self, kind: str, items: Iterable[_Value]) -> None:
        """Put items into the container on the top of the stack."""
        outer = self.stack[-1]
        for item in items:
            item.stored = True
            outer.depth = max(outer.depth, item.depth + 1)
            outer.size += item.size
        if outer.kind != kind or outer.stored:
            raise _RefusedError(
                "changes a value that is not a list or dictionary, or that is already part of another value"
            )
        if outer.depth > _MAX_DEPTH:
            raise _RefusedError(f"has values nested deeper than {_MAX_DEPTH} levels")
        if outer.size > MAX_BYTES:
            raise _RefusedError(f"has over {MAX_BYTES:,} objects, each counted as often as it is referred to")


def _result(function: str, arguments: _Value) -> _Value:
    """Return the simulated result of a call in a pickle.

    Raises:
        _RefusedError: if the call does anything but rebuild a tensor or make an empty OrderedDict.
    """
    if function in _FUNCTIONS:
        return _Value()
    if function != _ORDERED_DICT or (arguments.kind, arguments.size) != ("tuple", 1):
        raise _RefusedError("calls a function that does not create a tensor")
    return _Value("dict", depth=1)


class _RefusedError(Exception):
    """Error for a refused pickle; the message continues a sentence that begins with the name of the file."""


def require_tensors_only(description: bytes, where: str) -> None:
    """Check that a pickle creates only tensors and plain data, without deep nesting and without keys that hash slowly.

    Args:
        description: the pickle, which is not executed.
        where: name of its file in messages.

    Raises:
        CheckpointError: for the first operation that is refused, or if the pickle is corrupt.
    """
    simulation = _Simulation()
    try:
        for opcode, argument, _ in pickletools.genops(description):
            simulation.apply(opcode.name, argument)
    except _RefusedError as refused:
        raise CheckpointError(f"{where} {refused}", hint=SAVE_HINT) from None
    except Exception as error:
        raise CheckpointError(f"{where} is corrupt: {one_line(error)}; save the file again") from None
