"""The mean network of a DAPG policy, out of a pickle of any protocol and era; other pickles are refused."""

import pickle

import numpy as np
import pytest
import torch
from dapg_pickles import SCALINGS, OldPolicy, list_pickle
from manicm_ms.tasks.adroit import read_dapg

from manicm_ms.errors import ExpertFileError

pytestmark = [
    pytest.mark.filterwarnings("ignore:TypedStorage is deprecated"),  # of the pickles' own making
    pytest.mark.filterwarnings("ignore:overflow encountered"),  # of altered numbers
    pytest.mark.filterwarnings("ignore:invalid value encountered"),
]


@pytest.mark.parametrize("write", [pickle.dumps, list_pickle])
@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_the_network_that_acts_is_read_bit_for_bit(write, protocol):
    policy = OldPolicy((6, 5, 4, 3))
    arrays = read_dapg(write(policy, protocol))
    assert sorted(arrays) == sorted(["n_layers", *SCALINGS, *(f"{kind}{k}" for kind in "wb" for k in range(3))])
    assert arrays["n_layers"] == 3
    expected = {name: getattr(policy.model, name) for name in SCALINGS}
    for k, layer in enumerate(policy.model.fc_layers):
        expected |= {f"w{k}": layer.weight, f"b{k}": layer.bias}
    for name, tensor in expected.items():
        np.testing.assert_array_equal(arrays[name], tensor.detach().numpy(), strict=True)


def test_scalings_that_were_never_set_change_nothing():
    policy = OldPolicy((6, 5, 3))
    policy.model.in_shift = None
    del policy.model.out_scale
    arrays = read_dapg(pickle.dumps(policy))
    assert arrays["in_shift"].tolist() == [0] * 6
    assert arrays["out_scale"].tolist() == [1] * 3


def changed(**attributes):
    policy = OldPolicy((6, 5, 3))
    for name, value in attributes.items():
        setattr(policy.model, name, value)
    return policy


@pytest.mark.parametrize(
    ("policy", "told"),
    [
        ({"model": 3}, "holds no policy of DAPG"),
        (torch.zeros(3), "holds no policy of DAPG"),
        (changed(fc_layers=torch.nn.ModuleList()), "no linear layers"),
        (changed(fc_layers=torch.nn.ModuleList([torch.nn.Linear(6, 5), torch.nn.Linear(4, 3)])), "layer 1"),
        (changed(fc_layers=torch.nn.ModuleList([torch.nn.Conv1d(2, 2, 2)])), "layer 0"),
        (changed(in_shift=torch.zeros(5)), "in_shift of the pickled policy has 5 entries instead of 6"),
        (changed(out_scale=np.ones(2)), "out_scale of the pickled policy has 2 entries instead of 3"),
    ],
)
def test_what_is_no_such_policy_is_refused(policy, told):
    with pytest.raises(ExpertFileError, match=told):
        read_dapg(pickle.dumps(policy))


def test_modules_that_hold_each_other_have_an_end():
    policy = OldPolicy((6, 5, 3))
    content = pickle.dumps(policy)
    policy.model._modules["itself"] = policy.model
    again = read_dapg(pickle.dumps(policy))
    for name, array in read_dapg(content).items():
        np.testing.assert_array_equal(again[name], array)


@pytest.mark.parametrize("write", [pickle.dumps, list_pickle])
@pytest.mark.parametrize("protocol", [0, 2, 3])
def test_damage_is_an_error_of_one_kind(write, protocol):
    content, rng = write(OldPolicy((2, 2, 1)), protocol), np.random.default_rng(protocol)
    for end in range(0, len(content), 101):
        with pytest.raises(ExpertFileError):
            read_dapg(content[:end])
    read = 0
    for _ in range(400):
        altered = bytearray(content)
        altered[rng.integers(len(altered))] ^= 1 << rng.integers(8)
        try:
            arrays = read_dapg(bytes(altered))
        except ExpertFileError:
            continue
        read += 1
        inputs = arrays["in_shift"]
        for k in range(int(arrays["n_layers"])):
            inputs = arrays[f"w{k}"] @ inputs + arrays[f"b{k}"]  # what is read fits together
        assert inputs.shape == arrays["out_scale"].shape
    assert 0 < read < 400
