"""Reads tensors out of a pickle without executing it: nothing that it names is imported or called.

`pickle.load` runs whatever callables a file names. Here the standard library's `pickletools` only takes the file apart
into opcodes, and these build a description. What the file would import stays a name (`Global`), what it would call
stays a note of the call (`Call`); from the notes that PyTorch and NumPy leave for an array, `tensor` makes the array.

References: the opcodes' meaning is documented in CPython's `pickletools`; the legacy format of `torch.save` in
PyTorch's `torch/serialization.py` (`_legacy_load`).
"""

from __future__ import annotations

import math
import pickletools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manicm_ms.errors import ExpertFileError

_STORAGE_TYPES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8", "IntStorage": "<i4",
}  # fmt: skip
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_MOST_OPCODES = 1_000_000  # a policy of some thousand weights has far fewer
_MOST_NUMBERS = 10_000_000


@dataclass(frozen=True)
class Global:
    """A name that the pickle would import."""

    module: str
    name: str


@dataclass(eq=False)
class Call:
    """A call that the pickle would make, with what it would then do to the result.

    Attributes:
        function: what would be called.
        args: with what.
        state: what would be given to the result's __setstate__ or __dict__.
        items: what would be stored in it under keys.
        elements: what would be appended to it.
    """

    function: Any
    args: tuple[Any, ...]
    state: Any = None
    items: dict[Any, Any] = field(default_factory=dict)
    elements: list[Any] = field(default_factory=list)


@dataclass(frozen=True)
class Persistent:
    """A reference to something kept outside of the pickle."""

    key: Any


class _Mark:
    """Where a tuple, list or dictionary begins on the stack."""


@contextmanager
def _malformed_is_told() -> Iterator[None]:
    """Turn the many kinds of errors that nonsense raises, here and in pickletools, into ExpertFileError."""
    try:
        yield
    except ExpertFileError:
        raise
    except Exception as error:
        raise ExpertFileError(f"this is no pickle that can be read ({type(error).__name__}: {error})") from error


def describe(content: bytes) -> Any:
    """Return what the first pickle in `content` describes: plain values, `Global`, `Call` and `Persistent`.

    Raises ExpertFileError where it is no pickle, or uses an opcode that data of this kind does not need.
    """
    return next(_descriptions(BytesIO(content)))


def _descriptions(stream: BytesIO) -> Iterator[Any]:
    """Yield what the pickles that stand one after another in `stream` describe; it then stands behind the last one."""
    while True:
        yield _Machine().run(stream)


class _Machine:
    """The pickle machine with the calls taken out."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, stream: BytesIO) -> Any:
        """Return what the pickle that begins here describes; the stream then stands behind it."""
        with _malformed_is_told():
            for number, (opcode, value, _) in enumerate(pickletools.genops(stream)):
                if number > _MOST_OPCODES:
                    raise ExpertFileError(f"the pickle has more than {_MOST_OPCODES} opcodes: it is no policy's")
                if opcode.name == "STOP":
                    return self.stack.pop()
                self._apply(opcode.name, value)
        raise ExpertFileError("the pickle has no end: the file is cut short")

    def _apply(self, name: str, value: Any) -> None:
        if name in _IGNORED:
            return
        if name in _PUSHES_ITS_ARGUMENT:
            self.stack.append(value)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name]())
        elif name in ("BINPUT", "LONG_BINPUT", "PUT"):
            self.memo[value] = self.stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = self.stack[-1]
        elif name in ("BINGET", "LONG_BINGET", "GET"):
            self.stack.append(self.memo[value])
        elif name in _ACTIONS:
            _ACTIONS[name](self, value)
        else:
            raise ExpertFileError(f"the pickle uses the opcode {name}, which a policy's weights do not need")

    def pop_to_mark(self) -> list[Any]:
        """Return what stands above the last mark, and remove both."""
        at = next(k for k in reversed(range(len(self.stack))) if isinstance(self.stack[k], _Mark))
        above = self.stack[at + 1 :]
        del self.stack[at:]
        return above

    def drop(self, discarded: Any) -> None:
        """Take what was popped, and do nothing with it."""

    def tuple_of(self, count: int) -> None:
        """Replace the last `count` items by a tuple of them."""
        self.stack.append(tuple(reversed([self.stack.pop() for _ in range(count)])))

    def call(self, value: Any) -> None:
        """Replace a callable and its arguments by a note of the call."""
        args, function = self.stack.pop(), self.stack.pop()
        self.stack.append(_called(function, args))

    def build(self, value: Any) -> None:
        """Note a state for the object below it."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, Call):
            target.state = state

    def set_items(self, pairs: list[Any]) -> None:
        """Store keys and values in the dictionary below."""
        target = self.stack[-1]
        entries = target.items if isinstance(target, Call) else target
        entries.update({_key(k): v for k, v in zip(pairs[::2], pairs[1::2], strict=True)})

    def append(self, elements: list[Any]) -> None:
        """Append to the list below."""
        target = self.stack[-1]
        (target.elements if isinstance(target, Call) else target).extend(elements)

    def new_object(self, keywords: bool) -> None:
        """Note a call of a class's __new__."""
        named = self.stack.pop() if keywords else {}
        args, cls = self.stack.pop(), self.stack.pop()
        self.stack.append(Call(cls, _arguments(args), items=dict(named)))

    def global_from_stack(self) -> None:
        """Replace a module and a name by what they name."""
        name, module = self.stack.pop(), self.stack.pop()
        self.stack.append(Global(str(module), str(name)))


def _arguments(args: Any) -> tuple[Any, ...]:
    if not isinstance(args, tuple):
        raise ExpertFileError("the pickle calls something with arguments that are no tuple")
    return args


def _called(function: Any, args: Any) -> Any:
    arguments = _arguments(args)
    # How Python 3 writes bytes in the older protocols: text in latin-1.
    if function == Global("_codecs", "encode") and len(arguments) == 2 and isinstance(arguments[0], str):
        return arguments[0].encode("latin-1")
    return Call(function, arguments)


def _key(value: Any) -> Any:
    """Return what stands for `value` as a key: itself where it is plain, else something that nobody asks for."""
    return value if isinstance(value, (str, bytes, int, float, type(None))) else object()


def _global(machine: _Machine, value: str) -> None:
    module, _, name = value.partition(" ")
    machine.stack.append(Global(module, name))


def _inst(machine: _Machine, value: str) -> None:
    args = machine.pop_to_mark()
    module, _, name = value.partition(" ")
    machine.stack.append(Call(Global(module, name), tuple(args)))


def _obj(machine: _Machine, value: Any) -> None:
    cls, *args = machine.pop_to_mark()
    machine.stack.append(Call(cls, tuple(args)))


def _dict(machine: _Machine, value: Any) -> None:
    pairs = machine.pop_to_mark()
    machine.stack.append({_key(k): v for k, v in zip(pairs[::2], pairs[1::2], strict=True)})


def _set_item(machine: _Machine, value: Any) -> None:
    pair = machine.stack[-2:]
    del machine.stack[-2:]
    machine.set_items(pair)


_IGNORED = {"PROTO", "FRAME"}
_PUSHES_ITS_ARGUMENT = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "STRING", "BINSTRING", "SHORT_BINSTRING",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8",
    "FLOAT", "BINFLOAT",
}  # fmt: skip
_CONSTANTS: Mapping[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_TUPLE": tuple,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
    "EMPTY_SET": list,
    "MARK": _Mark,
}
_ACTIONS: Mapping[str, Callable[[_Machine, Any], None]] = {
    "POP": lambda m, v: m.drop(m.stack.pop()),
    "POP_MARK": lambda m, v: m.drop(m.pop_to_mark()),
    "DUP": lambda m, v: m.stack.append(m.stack[-1]),
    "TUPLE": lambda m, v: m.stack.append(tuple(m.pop_to_mark())),
    "TUPLE1": lambda m, v: m.tuple_of(1),
    "TUPLE2": lambda m, v: m.tuple_of(2),
    "TUPLE3": lambda m, v: m.tuple_of(3),
    "LIST": lambda m, v: m.stack.append(m.pop_to_mark()),
    "DICT": _dict,
    "APPEND": lambda m, v: m.append([m.stack.pop()]),
    "APPENDS": lambda m, v: m.append(m.pop_to_mark()),
    "ADDITEMS": lambda m, v: m.append(m.pop_to_mark()),
    "SETITEM": _set_item,
    "SETITEMS": lambda m, v: m.set_items(m.pop_to_mark()),
    "GLOBAL": _global,
    "STACK_GLOBAL": lambda m, v: m.global_from_stack(),
    "REDUCE": _Machine.call,
    "BUILD": _Machine.build,
    "NEWOBJ": lambda m, v: m.new_object(keywords=False),
    "NEWOBJ_EX": lambda m, v: m.new_object(keywords=True),
    "INST": _inst,
    "OBJ": _obj,
    "PERSID": lambda m, v: m.stack.append(Persistent(v)),
    "BINPERSID": lambda m, v: m.stack.append(Persistent(m.stack.pop())),
}


def attributes(description: Any) -> dict[str, Any]:
    """Return the attributes that a described object would have; none where it would not be an object."""
    state = getattr(description, "state", None)
    return state if isinstance(state, dict) else {}


def entries(description: Any) -> dict[Any, Any]:
    """Return the entries of a described dictionary, plain or ordered, in their order."""
    if isinstance(description, dict):
        return description
    if not isinstance(description, Call):
        return {}
    # OrderedDict: pairs among the arguments (Python 2), or items set after an empty call (Python 3).
    pairs = description.args[0] if description.args and isinstance(description.args[0], list) else []
    with _malformed_is_told():
        return {_key(key): value for key, value in pairs} | description.items


def tensor(description: Any) -> NDArray[Any] | None:
    """Return the array that a described tensor, parameter or NumPy array would be; None for anything else.

    Raises ExpertFileError where an array is described that cannot be, or in a way that this reader does not know.
    """
    waiting, seen = [description], set()
    while waiting:
        item = waiting.pop()
        if not isinstance(item, Call) or id(item) in seen:
            continue
        seen.add(id(item))
        with _malformed_is_told():
            if (array := _array(item)) is not None:
                return array
        # A parameter or variable holds its tensor as first argument, or as part of its state.
        waiting += reversed([*item.args, *(item.state if isinstance(item.state, tuple) else ())])
    return None


def _array(call: Call) -> NDArray[Any] | None:
    """Return the array that the call itself would return, if that is one."""
    name = call.function.name if isinstance(call.function, Global) else ""
    if name.startswith("_rebuild_tensor"):
        storage, offset, size, stride = call.args[:4]
        return _strided(_storage(storage), offset, size, stride)
    if name == "_reconstruct" and isinstance(call.state, tuple):
        _, shape, dtype, fortran, raw = call.state
        return _numpy(raw, dtype, shape, "F" if fortran else "C")
    if name == "_frombuffer":  # protocol 5
        raw, dtype, shape, order = call.args[:4]
        return _numpy(raw, dtype, shape, order)
    return None


def _strided(flat: NDArray[Any], offset: int, size: tuple[int, ...], stride: tuple[int, ...]) -> NDArray[Any]:
    if min((offset, *size, *stride)) < 0 or len(size) != len(stride) or math.prod(size) > _MOST_NUMBERS:
        raise ExpertFileError(f"a tensor of size {size} and stride {stride} at {offset} cannot be")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 not in size and last >= len(flat):
        raise ExpertFileError(f"a tensor reads entry {last} of a storage that has {len(flat)}")
    view = np.lib.stride_tricks.as_strided(flat[offset:], size, tuple(s * flat.itemsize for s in stride))
    return view.copy()


def _storage(description: Any) -> NDArray[Any]:
    """Return the entries of a described torch storage."""
    if isinstance(description, Call) and isinstance(description.function, Global):
        name, args = description.function.name, description.args
        content = args[0] if args else None
        if name in _STORAGE_TYPES and isinstance(content, list) and all(isinstance(n, (int, float)) for n in content):
            return np.array(content, _STORAGE_TYPES[name])  # PyTorch before 1.0
        if name == "_load_from_bytes" and isinstance(content, bytes):
            return _legacy_file(content)
    raise ExpertFileError("a tensor's storage is written in a way that this reader does not know")


def _legacy_file(content: bytes) -> NDArray[Any]:
    """Return the entries of the one storage in a file of `torch.save`'s legacy format.

    Five pickles (magic number, protocol, sizes of integers, the object, keys of its storages), then for each key the
    number of entries as 8 bytes and the entries.
    """
    stream = BytesIO(content)
    pickles = _descriptions(stream)
    magic, _, system, described, keys = (next(pickles) for _ in range(5))
    whole = isinstance(described, Persistent) and not any(described.key[5:])  # the sixth tells of a part of a storage
    if magic != _LEGACY_MAGIC or not whole or len(keys) != 1 or not entries(system).get("little_endian", True):
        raise ExpertFileError("a tensor's storage is not one little-endian array")
    kind = described.key[1].name if isinstance(described.key[1], Global) else ""
    if kind not in _STORAGE_TYPES:
        raise ExpertFileError(f"a tensor's storage is of the kind {kind!r}, which this reader does not know")
    count = int.from_bytes(stream.read(8), "little")
    dtype = np.dtype(_STORAGE_TYPES[kind])
    raw = stream.read(count * dtype.itemsize)
    if len(raw) != count * dtype.itemsize:
        raise ExpertFileError(f"a tensor's storage ends after {len(raw)} bytes of {count} entries")
    return np.frombuffer(raw, dtype)


def _numpy(raw: Any, dtype: Any, shape: tuple[int, ...], order: Any) -> NDArray[Any]:
    """Return the array of a NumPy array's pickled parts: bytes, described dtype, shape, order of the numbers."""
    code = dtype.args[0] if isinstance(dtype, Call) and dtype.args else ""
    byte_order = dtype.state[1] if isinstance(dtype, Call) and isinstance(dtype.state, tuple) else ""
    raw = raw.encode("latin-1") if isinstance(raw, str) else raw  # Python 2
    if code not in ("f4", "f8", "i4", "i8") or byte_order not in ("<", ">") or not isinstance(raw, (bytes, bytearray)):
        raise ExpertFileError("an array is not one of plain numbers")
    if order not in ("C", "F"):
        raise ExpertFileError("an array's numbers are in an order that this reader does not know")
    return np.frombuffer(raw, f"{byte_order}{code}").reshape(shape, order=order).astype(f"<{code}")
