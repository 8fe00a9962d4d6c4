"""Arrays out of pickles that Python, NumPy and PyTorch really write, and nothing but an error out of the rest."""

import collections
import contextlib
import io
import os
import pickle
import pickletools
import struct

import numpy as np
import pytest
import torch
from dapg_pickles import SCALINGS, OldPolicy, list_pickle

from manicm_ms.demos import inert_pickle
from manicm_ms.demos.inert_pickle import Call, Global
from manicm_ms.errors import ExpertFileError

pytestmark = [
    pytest.mark.filterwarnings("ignore:TypedStorage is deprecated"),  # of this file's own use of them
    pytest.mark.filterwarnings("ignore:overflow encountered in cast"),  # of altered numbers
]
PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


def layers_of(model):
    """Weight and bias of each described layer of a described network, in order."""
    modules = inert_pickle.entries(inert_pickle.attributes(model)["_modules"])
    layers = inert_pickle.entries(inert_pickle.attributes(modules["fc_layers"])["_modules"])
    for layer in layers.values():
        parameters = inert_pickle.entries(inert_pickle.attributes(layer)["_parameters"])
        yield inert_pickle.tensor(parameters["weight"]), inert_pickle.tensor(parameters["bias"])


def read(value, protocol=2):
    return inert_pickle.tensor(inert_pickle.describe(pickle.dumps(value, protocol)))


@pytest.mark.parametrize("write", [pickle.dumps, list_pickle])
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_number_of_a_policy_s_network_is_read(write, protocol):
    policy = OldPolicy()
    content = write(policy, protocol)
    assert (b"_load_from_bytes" in content) == (write is pickle.dumps)
    described = inert_pickle.describe(content)
    assert described.function in (Global("dapg_pickles", "OldPolicy"), Global("copy_reg", "_reconstructor"))
    model = inert_pickle.attributes(described)["model"]
    found = list(layers_of(model))
    assert len(found) == 3
    for layer, (weight, bias) in zip(policy.model.fc_layers, found, strict=True):
        np.testing.assert_array_equal(weight, layer.weight.detach().numpy(), strict=True)
        np.testing.assert_array_equal(bias, layer.bias.detach().numpy(), strict=True)
    for name in SCALINGS:
        array = inert_pickle.tensor(inert_pickle.attributes(model)[name])
        np.testing.assert_array_equal(array, getattr(policy.model, name).numpy(), strict=True)
    kept = inert_pickle.attributes(model)["transformations"]
    np.testing.assert_array_equal(inert_pickle.tensor(kept["in_shift"]), policy.model.transformations["in_shift"])
    assert kept["in_scale"] is None


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f4", ">f8", "<i4", "<i8", ">i8"])
def test_numpy_arrays_of_either_order_and_endianness(protocol, dtype):
    numbers = np.random.default_rng(0).normal(0, 1000, (2, 3, 4)).astype(dtype)
    for array in (numbers, np.asfortranarray(numbers), numbers[:, ::2, 1:], numbers[0, 0, 0:1], numbers[:0]):
        if array.size == 0 and protocol < 3:
            continue  # an empty array's bytes are written as a call there, which nobody needs
        found = read(array, protocol)
        np.testing.assert_array_equal(found, array)
        assert found.dtype == np.dtype(dtype).newbyteorder("<")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_tensors_that_are_parts_of_a_storage(protocol):
    base = torch.arange(60, dtype=torch.float32).reshape(3, 4, 5)
    parts = [base, base[1], base[:, 1:3, ::2], base.permute(2, 0, 1), base[2, 3, 4], base[:, :0]]
    parts += [base[0, 0].expand(7, 5)]
    for part, described in zip(parts, inert_pickle.describe(pickle.dumps(parts, protocol)), strict=True):
        np.testing.assert_array_equal(inert_pickle.tensor(described), part.numpy(), strict=True)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64, torch.int32, torch.int64])
def test_kinds_of_numbers(dtype):
    values = torch.tensor([-3, 0, 2, 7]).to(dtype)
    np.testing.assert_array_equal(read(values), values.numpy(), strict=True)
    np.testing.assert_array_equal(
        inert_pickle.tensor(inert_pickle.describe(list_pickle(values, 2))), values.numpy(), strict=True
    )


def test_a_variable_of_pytorch_0_3_holds_its_tensor_as_argument_or_state():
    tensor = inert_pickle.describe(pickle.dumps(torch.arange(3.0), 2))
    variable = Call(Global("torch.autograd.variable", "Variable"), (tensor,), state=(True, False, {}))
    parameter = Call(Global("torch.nn.parameter", "Parameter"), (), state=(False, tensor))
    for described in (variable, parameter):
        assert inert_pickle.tensor(described).tolist() == [0, 1, 2]
    assert inert_pickle.tensor(Call(Global("torch", "Size"), ((3, 4),))) is None


def test_ordered_dictionaries_of_python_2_and_3():
    here = collections.OrderedDict([("b", 1), ("a", 2)])
    for protocol in PROTOCOLS:
        described = inert_pickle.describe(pickle.dumps(here, protocol))
        assert list(inert_pickle.entries(described).items()) == [("b", 1), ("a", 2)]
    # What Python 2.7 writes for it: pairs among the arguments.
    python_2 = b"ccollections\nOrderedDict\np0\n((lp1\n(lp2\nS'b'\np3\naI1\naa(lp4\nS'a'\np5\naI2\naatp6\nRp7\n."
    assert list(inert_pickle.entries(inert_pickle.describe(python_2)).items()) == [("b", 1), ("a", 2)]
    assert inert_pickle.entries(inert_pickle.describe(b"(dS'k'\nI1\ns.")) == {"k": 1}


class Everything:
    """Uses all that __reduce__ may return."""

    def __reduce__(self):
        return collections.OrderedDict, (), {"number": 4}, iter([1, 2]), iter([("k", (None, True, False, -7, 2.5))])


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_what_a_call_would_be_given_is_noted(protocol):
    described = inert_pickle.describe(pickle.dumps(Everything(), protocol))
    assert described.function == Global("collections", "OrderedDict")
    assert (described.args, described.state, described.elements) == ((), {"number": 4}, [1, 2])
    assert described.items == {"k": (None, True, False, -7, 2.5)}


# ---- nothing is executed --------------------------------------------------------------------------------------------


class Payload:
    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


def payloads(target):
    """Pickles that touch the file `target` when they are loaded."""
    touch = f"open({str(target)!r}, 'w').close()"
    calls = [(os.system, f"touch '{target}'"), (exec, touch), (eval, touch), (open, str(target), "w")]
    for call in calls:
        for protocol in PROTOCOLS:
            yield pickle.dumps(Payload(*call), protocol)
            yield pickle.dumps({"a": [Payload(*call)]}, protocol)
    shell = f"touch '{target}'".encode()
    yield b"(cos\nsystem\nS'" + shell.replace(b"'", b'"') + b"'\no."  # OBJ
    yield b"(S'" + shell.replace(b"'", b'"') + b"'\nios\nsystem\n."  # INST
    described = pickle.dumps(Payload(*calls[0]), 2)
    yield pickle.dumps(Payload(torch.storage._load_from_bytes, described), 2)


def test_a_malicious_pickle_is_described_and_does_nothing(tmp_path):
    target = tmp_path / "touched"
    for content in payloads(target):
        calls = {opcode.name for opcode, _, _ in pickletools.genops(content)} & {"REDUCE", "OBJ", "INST"}
        assert calls, "loaded, it would call something"
        described = inert_pickle.describe(content)
        inert_pickle.attributes(described), inert_pickle.entries(described)
        assert inert_pickle.tensor(described) is None
        assert not target.exists()
    described = inert_pickle.describe(pickle.dumps(Payload(os.system, "true"), 4))
    assert (described.function, described.args) == (Global("posix", "system"), ("true",))


def test_a_malicious_storage_is_refused_and_does_nothing(tmp_path):
    target = tmp_path / "touched"
    for content in payloads(target):
        storage = Payload(torch.storage._load_from_bytes, content)
        rebuilt = pickle.dumps(Payload(torch._utils._rebuild_tensor_v2, storage, 0, (1,), (1,), False, None), 2)
        with pytest.raises(ExpertFileError):
            inert_pickle.tensor(inert_pickle.describe(rebuilt))
        assert not target.exists()


# ---- what is refused ------------------------------------------------------------------------------------------------


def read_all(content):
    """Describe, and read all that may be an array below it; only ExpertFileError may come of it."""
    try:
        policy = inert_pickle.attributes(inert_pickle.describe(content))
        model = policy.get("model")
        list(layers_of(model))
        return [inert_pickle.tensor(inert_pickle.attributes(model).get(name)) for name in SCALINGS]
    except (ExpertFileError, KeyError):  # KeyError: this test's own, of a name that was altered
        return None


@pytest.mark.parametrize("write", [pickle.dumps, list_pickle])
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_cut_pickle_is_an_error_wherever_it_is_cut(write, protocol):
    content = write(OldPolicy((2, 2, 1)), protocol)
    assert read_all(content) is not None
    for end in range(0, len(content), 7):
        with pytest.raises(ExpertFileError):
            inert_pickle.describe(content[:end])


@pytest.mark.parametrize("write", [pickle.dumps, list_pickle])
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_altered_bytes_raise_no_other_error(write, protocol):
    content, rng = write(OldPolicy((2, 2, 1)), protocol), np.random.default_rng(protocol)
    refused = 0
    for _ in range(400):
        altered = bytearray(content)
        for _ in range(rng.integers(1, 4)):
            altered[rng.integers(len(altered))] = rng.integers(256)
        refused += read_all(bytes(altered)) is None
    assert refused > 20


def test_no_pickle_at_all():
    rng = np.random.default_rng(0)
    noise = [rng.bytes(int(n)) for n in rng.integers(1, 300, 300)]
    for content in [b"", b".", b"\x80", b"hello, world", b"<!DOCTYPE html>\n<html>", b"PK\x03\x04" + bytes(50)]:
        with pytest.raises(ExpertFileError):
            inert_pickle.describe(content)
    for content in noise:
        with contextlib.suppress(ExpertFileError):  # by chance, some two bytes are a pickle
            inert_pickle.describe(content)


def opcodes(*named):
    """A pickle of opcodes by their names, each with its encoded argument."""
    codes = {opcode.name: opcode.code.encode("latin-1") for opcode in pickletools.opcodes}
    return b"".join(codes[name] + rest for name, rest in named)


def test_opcodes_that_weights_do_not_need_are_named():
    buffers = []
    outside = pickle.dumps(np.arange(4.0), 5, buffer_callback=buffers.append)
    assert buffers
    with pytest.raises(ExpertFileError, match="opcode NEXT_BUFFER, which"):
        inert_pickle.describe(outside)
    with pytest.raises(ExpertFileError, match="opcode EXT1, which"):
        inert_pickle.describe(b"\x82\x01.")


@pytest.mark.parametrize(
    "content",
    [
        opcodes(("NONE", b""), ("TUPLE2", b""), ("STOP", b"")),  # too little on the stack
        opcodes(("NONE", b""), ("TUPLE", b""), ("STOP", b"")),  # no mark
        opcodes(("BINGET", b"\x05"), ("STOP", b"")),  # nothing there
        opcodes(("NONE", b""), ("EMPTY_LIST", b""), ("REDUCE", b""), ("STOP", b"")),  # no tuple
        opcodes(("EMPTY_DICT", b""), ("MARK", b""), ("NONE", b""), ("SETITEMS", b""), ("STOP", b"")),  # no pair
        opcodes(("BININT1", b"\x01"), ("NONE", b""), ("APPEND", b""), ("STOP", b"")),  # no list
        opcodes(("BINUNICODE", struct.pack("<I", 2**31) + b"ab"), ("STOP", b"")),  # no such length
        opcodes(("NONE", b""), *[("POP", b"")] * 2, ("STOP", b"")),
        opcodes(*[("NONE", b"")] * 1_000_002, ("STOP", b"")),  # no end to it
    ],
)
def test_opcodes_that_make_no_sense_are_an_error(content):
    with pytest.raises(ExpertFileError):
        inert_pickle.describe(content)


def test_deep_and_cyclic_descriptions_are_read_and_hold_nothing():
    loop = Call(Global("m", "f"), ())
    loop.state = (loop, [loop])
    assert inert_pickle.tensor(loop) is None
    deep = opcodes(("EMPTY_TUPLE", b""), *[("TUPLE1", b"")] * 200_000, ("STOP", b""))
    assert inert_pickle.tensor(inert_pickle.describe(deep)) is None
    as_key = opcodes(("EMPTY_DICT", b""), ("EMPTY_TUPLE", b""), *[("TUPLE1", b"")] * 200_000,
                     ("NONE", b""), ("SETITEM", b""), ("STOP", b""))  # fmt: skip
    assert len(inert_pickle.describe(as_key)) == 1, "hashing it would end the process"
    calls = Call(Global("m", "f"), ())
    for _ in range(5000):  # each holds the one before twice
        calls = Call(Global("m", "f"), (calls, calls))
    assert inert_pickle.tensor(calls) is None


def rebuilt(storage, *args):
    return Call(Global("torch._utils", "_rebuild_tensor_v2"), (storage, *args))


FLOATS = Call(Global("torch", "FloatStorage"), ([1.0, 2.0, 3.0],))


@pytest.mark.parametrize(
    "args",
    [
        (0, (4,), (1,)),
        (1, (3,), (1,)),
        (-1, (2,), (1,)),
        (0, (2,), (-1,)),
        (0, (2, 2), (1,)),
        (0, (10**9, 10**9), (0, 0)),
        (0, (2,), (2**70,)),
        (0, ("2",), (1,)),
        (0, None, None),
        ("0", (1,), (1,)),
        (0,),
        (),
    ],
)
def test_tensors_that_cannot_be_are_refused(args):
    assert inert_pickle.tensor(rebuilt(FLOATS, 0, (3,), (1,))).tolist() == [1, 2, 3]
    with pytest.raises(ExpertFileError):
        inert_pickle.tensor(rebuilt(FLOATS, *args))


@pytest.mark.parametrize(
    "storage",
    [
        None,
        Call(Global("torch", "FloatStorage"), ()),
        Call(Global("torch", "FloatStorage"), (3,)),
        Call(Global("torch", "FloatStorage"), ([1.0, "a"],)),
        Call(Global("torch", "FloatStorage"), ([[1.0], [2.0]],)),
        Call(Global("torch", "CharStorage"), ([1, 2],)),
    ],
)
def test_storages_of_another_kind_are_refused(storage):
    with pytest.raises(ExpertFileError, match="storage is written in a way"):
        inert_pickle.tensor(rebuilt(storage, 0, (1,), (1,)))


def legacy_bytes(**changes):
    """The legacy file of a storage of three numbers, written here by hand; what is changed makes it another."""
    magic = changes.get("magic", 0x1950A86A20F9469CFC6C)
    system = {"protocol_version": 1001, "little_endian": changes.get("little_endian", True), "type_sizes": {}}
    keys = changes.get("keys", ["1"])

    class ByKey(pickle.Pickler):
        def persistent_id(self, value):
            named = ("storage", torch.FloatStorage, "1", "cpu", 3, changes.get("view"))
            return named if value == "the storage" else None

    described = io.BytesIO()
    ByKey(described, 2).dump("the storage")
    head = b"".join([pickle.dumps(magic, 2), pickle.dumps(1001, 2), pickle.dumps(system, 2)])
    numbers = struct.pack("<Q", changes.get("count", 3)) + np.float32([1, 2, 3]).tobytes()
    return head + described.getvalue() + pickle.dumps(keys, 2) + numbers[: changes.get("end")]


def test_the_legacy_file_of_a_storage_by_its_own_description():
    storage = Call(Global("torch.storage", "_load_from_bytes"), (legacy_bytes(),))
    assert torch.load(io.BytesIO(legacy_bytes()), weights_only=True).tolist() == [1, 2, 3], "PyTorch agrees"
    assert inert_pickle.tensor(rebuilt(storage, 0, (3,), (1,))).tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    "changes",
    [
        {"magic": 3},
        {"little_endian": False},
        {"keys": ["1", "2"]},
        {"keys": 5},
        {"view": ("2", 1, 2)},
        {"count": 4},
        {"count": 2**63},
        {"end": 15},
        {"end": 3},
    ],
)
def test_other_legacy_files_are_refused(changes):
    storage = Call(Global("torch.storage", "_load_from_bytes"), (legacy_bytes(**changes),))
    with pytest.raises(ExpertFileError):
        inert_pickle.tensor(rebuilt(storage, 0, (1,), (1,)))


def test_arrays_of_other_things_are_refused():
    for dtype in ("O", "U1", "?", "c8", "f4,i4"):
        with pytest.raises(ExpertFileError, match="not one of plain numbers"):
            read(np.zeros(2, dtype), 2)
    transposed = np.zeros((2, 3, 4)).transpose(1, 0, 2)
    with pytest.raises(ExpertFileError, match="in an order"):
        read(transposed, 5)
