import pytest
import torch

from manicm_ms.demos.stats import field_stats
from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.policies.normalizer import MIN_RANGE, Normalizer


@pytest.fixture
def data():
    g = torch.Generator().manual_seed(0)
    low, span = torch.tensor([-3.0, 0.5, 700.0, 2.0]), torch.tensor([6.0, 0.01, 50.0, 0.0])
    return low + span * torch.rand(400, 7, 4, generator=g)


def fitted(data):
    normalizer = Normalizer({"x": data.shape[-1]})
    normalizer.fit({"x": field_stats(data.numpy())})
    return normalizer


def test_range_becomes_minus_one_to_one(data):
    y = fitted(data).normalize("x", data)
    torch.testing.assert_close(y.amin((0, 1)), torch.tensor([-1.0, -1.0, -1.0, 0.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(y.amax((0, 1)), torch.tensor([1.0, 1.0, 1.0, 0.0]), atol=1e-4, rtol=0)


def test_is_affine_beyond_the_fitted_range(data):
    normalizer, g = fitted(data), torch.Generator().manual_seed(1)
    a, b = 10 * torch.randn(2, 50, 4, generator=g)
    middle = normalizer.normalize("x", (a + b) / 2)
    mean = (normalizer.normalize("x", a) + normalizer.normalize("x", b)) / 2
    torch.testing.assert_close(middle, mean, rtol=1e-4, atol=1e-3)
    assert normalizer.normalize("x", a).abs().max() > 1  # nothing is clipped


def test_inverse_returns_the_value(data):
    normalizer = fitted(data)
    torch.testing.assert_close(normalizer.unnormalize("x", normalizer.normalize("x", data)), data, rtol=1e-6, atol=1e-6)


def test_a_channel_below_the_smallest_range_is_only_shifted():
    narrow = torch.tensor([[5.0, 1.0], [5.0 + 0.5 * MIN_RANGE, 1.0 + 2 * MIN_RANGE]])
    y = fitted(narrow[:, None]).normalize("x", narrow)
    assert y[:, 0].abs().max() <= MIN_RANGE
    torch.testing.assert_close(y[:, 1], torch.tensor([-1.0, 1.0]), atol=1e-2, rtol=0)


def test_a_channel_below_the_least_range_keeps_its_proportion():
    values = torch.tensor([[5.0, 1.0, 2.0], [5.002, 3.0, 2.0]])
    normalizer = Normalizer({"x": 3, "y": 3})
    stats = field_stats(values[:, None].numpy())
    normalizer.fit({"x": stats, "y": stats}, {"x": 0.02})
    wide, constant = torch.tensor([-1.0, 1.0]), torch.zeros(2)
    y = normalizer.normalize("x", values).T
    torch.testing.assert_close(y, torch.stack([0.1 * wide, wide, constant]), atol=1e-3, rtol=0)
    torch.testing.assert_close(normalizer.unnormalize("x", y.T), values, rtol=1e-5, atol=1e-5)
    stretched = normalizer.normalize("y", values).T  # the field that is not named follows DP3's rule
    torch.testing.assert_close(stretched, torch.stack([wide, wide, constant]), atol=1e-2, rtol=0)


def test_state_is_in_buffers_not_in_parameters(data):
    normalizer = fitted(data)
    assert list(normalizer.parameters()) == []
    fresh = Normalizer({"x": 4})
    fresh.load_state_dict(normalizer.state_dict())
    torch.testing.assert_close(fresh.normalize("x", data), normalizer.normalize("x", data), rtol=0, atol=0)


def test_unfitted_maps_to_itself(data):
    torch.testing.assert_close(Normalizer({"x": 4}).normalize("x", data), data)


def test_wrong_statistics_are_refused(data):
    with pytest.raises(SpecMismatchError, match="lack 'x'"):
        Normalizer({"x": 4}).fit({"y": field_stats(data.numpy())})
    with pytest.raises(SpecMismatchError, match="4 channels and the policy 3"):
        Normalizer({"x": 3}).fit({"x": field_stats(data.numpy())})
    with pytest.raises(ConfigError, match="no field 'z'"):
        fitted(data).normalize("z", data)
