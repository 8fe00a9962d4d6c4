"""Reads tensors out of a pickle without executing it: nothing that it names is imported or called.

`pickle.load` runs whatever callables a file names. Here the standard library's `pickletools` only takes the file apart
into opcodes, and these build a description. What the file would import stays a name (`Global`), what it would call
stays a note of the call (`Call`); from the notes that PyTorch and NumPy leave for an array, `tensor` makes the array.

References: the opcodes' meaning is documented in CPython's `pickletools`; the legacy format of `torch.save` in
PyTorch's `torch/serialization.py` (`_legacy_load`).
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manicm_ms.errors import ExpertFileError

_STORAGE_TYPES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8", "IntStorage": "<i4",
}  # fmt: skip
_MOST_OPCODES = 1_000_000  # a policy of some thousand weights has far fewer


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
        try:
            for number, (opcode, value, _) in enumerate(pickletools.genops(stream)):
                if number > _MOST_OPCODES:
                    raise ExpertFileError(f"the pickle has more than {_MOST_OPCODES} opcodes: it is no policy's")
                if opcode.name == "STOP":
                    return self.stack.pop()
                self._apply(opcode.name, value)
        except ExpertFileError:
            raise
        except Exception as error:  # pickletools and the stack raise many kinds on what is no pickle
            raise ExpertFileError(f"this is no pickle that can be read ({type(error).__name__}: {error})") from error
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
        at = max(k for k, item in enumerate(self.stack) if isinstance(item, _Mark))
        above = self.stack[at + 1 :]
        del self.stack[at:]
        return above

    def drop(self, discarded: Any) -> None:
        """Take what was popped, and do nothing with it."""

    def tuple_of(self, count: int) -> None:
        """Replace the last `count` items by a tuple of them."""
        items = tuple(self.stack[-count:])
        del self.stack[-count:]
        self.stack.append(items)

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
        self.stack.append(Call(cls, tuple(args), items=dict(named)))

    def global_from_stack(self) -> None:
        """Replace a module and a name by what they name."""
        name, module = self.stack.pop(), self.stack.pop()
        self.stack.append(Global(str(module), str(name)))


def _called(function: Any, args: Any) -> Any:
    arguments = tuple(args)
    # How Python 3 writes bytes in the older protocols: text in latin-1.
    if function == Global("_codecs", "encode") and len(arguments) == 2 and isinstance(arguments[0], str):
        return arguments[0].encode("latin-1")
    return Call(function, arguments)


def _key(value: Any) -> Any:
    return value if isinstance(value, (str, bytes, int, float, bool, tuple, type(None))) else id(value)


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
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "FLOAT",
    "BINFLOAT",
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
    return {**{pair[0]: pair[1] for pair in pairs}, **description.items}


def tensor(description: Any) -> NDArray[Any] | None:
    """Return the array that a described tensor, parameter or NumPy array would be; None for anything else."""
    if not isinstance(description, Call):
        return None
    name = description.function.name if isinstance(description.function, Global) else ""
    if name.startswith("_rebuild_tensor"):
        storage, offset, size, stride = description.args[:4]
        return _strided(_storage(storage), int(offset), size, stride)
    if name == "_reconstruct" and isinstance(description.state, tuple):
        return _numpy(description.state)
    # A parameter or variable holds its tensor as first argument, or as part of its state.
    inner = [*description.args, *(description.state if isinstance(description.state, tuple) else ())]
    return next((array for item in inner if (array := tensor(item)) is not None), None)


def _strided(flat: NDArray[Any], offset: int, size: tuple[int, ...], stride: tuple[int, ...]) -> NDArray[Any]:
    if any(n < 0 for n in (*size, *stride)) or offset < 0 or len(size) != len(stride):
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
        if name in _STORAGE_TYPES and args and isinstance(args[0], (list, tuple)):  # PyTorch before 1.0: a list
            return np.array(args[0], _STORAGE_TYPES[name])
        if name == "_load_from_bytes" and args and isinstance(args[0], bytes):
            return _legacy_file(args[0])
        if name == "TypedStorage" and args:
            return _storage(args[0])
    raise ExpertFileError("a tensor's storage is written in a way that this reader does not know")


def _legacy_file(content: bytes) -> NDArray[Any]:
    """Return the entries of the one storage in a file of `torch.save`'s legacy format.

    Five pickles (magic number, protocol, sizes of integers, the object, keys of its storages), then for each key the
    number of entries as 8 bytes and the entries.
    """
    stream = BytesIO(content)
    pickles = _descriptions(stream)
    _, _, system, described, keys = (next(pickles) for _ in range(5))
    named = _find_persistent(described)
    if named is None or len(keys) != 1 or not entries(system).get("little_endian", True):
        raise ExpertFileError("a tensor's storage is not one little-endian array")
    kind = named.key[1].name if isinstance(named.key[1], Global) else ""
    if kind not in _STORAGE_TYPES:
        raise ExpertFileError(f"a tensor's storage is of the kind {kind!r}, which this reader does not know")
    count = int.from_bytes(stream.read(8), "little")
    dtype = np.dtype(_STORAGE_TYPES[kind])
    raw = stream.read(count * dtype.itemsize)
    if len(raw) != count * dtype.itemsize:
        raise ExpertFileError(f"a tensor's storage ends after {len(raw)} bytes of {count} entries")
    return np.frombuffer(raw, dtype)


def _find_persistent(description: Any) -> Persistent | None:
    if isinstance(description, Persistent):
        return description
    inner = description.args if isinstance(description, Call) else ()
    return next((found for item in inner if (found := _find_persistent(item)) is not None), None)


def _numpy(state: tuple[Any, ...]) -> NDArray[Any]:
    """Return the array of a NumPy array's pickled state: version, shape, dtype, Fortran order, bytes."""
    _, shape, dtype, fortran, raw = state
    code = dtype.args[0] if isinstance(dtype, Call) and dtype.args else ""
    if isinstance(raw, str):
        raw = raw.encode("latin-1")
    if code not in ("f4", "f8", "i4", "i8") or not isinstance(raw, bytes):
        raise ExpertFileError(f"an array of the type {code!r} is not one of plain numbers")
    return np.frombuffer(raw, f"<{code}").reshape(shape, order="F" if fortran else "C").copy()
