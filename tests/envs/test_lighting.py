"""Relighting against planes and spheres whose shading is known in closed form."""

import numpy as np
import pytest
import torch

from manicm_ms.envs.lighting import AMBIENT, GAMMA, Lamp, normals, relight, tint


def plane(normal, distance=0.6, size=32, focal=40.0):
    """Return positions (1, H, W, 3) of a plane n . p = -distance |n| before an OpenGL camera."""
    v, u = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    rays = torch.stack([(u - size / 2) / focal, -(v - size / 2) / focal, -torch.ones_like(u)], dim=-1)
    n = torch.nn.functional.normalize(torch.tensor(normal), dim=0)
    return (rays * (-distance / (rays @ n))[..., None])[None], n


def headlit(albedo, position, n):
    """Return what the cloud shader paints: base colour under a lamp at the camera."""
    facing = (torch.nn.functional.normalize(position, dim=-1) @ n).abs()[..., None]
    shade = torch.tensor(albedo) * (AMBIENT + (1 - AMBIENT) * facing)
    return (shade.clamp(0, 1) ** (1 / GAMMA) * 255).round().to(torch.uint8)


def lamp(direction, ambient, color):
    direction = torch.nn.functional.normalize(torch.tensor([direction]), dim=1)
    return Lamp(direction, torch.tensor([ambient]), torch.tensor([color]))


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, 0.2, 1.0), (-0.6, 0.5, 0.7)])
def test_normals_of_a_plane(normal):
    position, n = plane(normal)
    torch.testing.assert_close(normals(position), n.expand_as(position), atol=2e-4, rtol=0)


def test_nothing_hit_has_a_normal_too():
    assert torch.equal(normals(torch.zeros(1, 4, 4, 3)), torch.tensor([0.0, 0.0, 1.0]).expand(1, 4, 4, 3))


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.8, 0.3, 0.5), (-1.0, 0.0, 0.2)])
def test_a_plane_is_lit_by_lamberts_law(direction):
    albedo, ambient, color = (0.5, 0.3, 0.2), 0.3, (0.7, 0.6, 0.4)
    position, n = plane((0.3, 0.2, 1.0))
    given = lamp(direction, ambient, color)
    cosine = float((given.direction[0] @ n).clamp_min(0))
    expected = (torch.tensor(albedo) * (ambient + torch.tensor(color) * cosine)) ** (1 / GAMMA) * 255
    lit = relight(headlit(albedo, position, n), position, given)
    assert (lit.float() - expected).abs().max() <= 2  # two roundings to 8 bits


def test_rows_have_their_own_light():
    position, n = plane((0.1, 0.0, 1.0))
    color = headlit((0.5, 0.5, 0.5), position, n).repeat(2, 1, 1, 1)
    both = Lamp(
        torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), torch.tensor([0.2, 0.6]), torch.tensor([[0.8] * 3] * 2)
    )
    lit = relight(color, position.repeat(2, 1, 1, 1), both)
    for k in range(2):
        alone = Lamp(*(part[k : k + 1] for part in both))
        assert torch.equal(lit[k : k + 1], relight(color[k : k + 1], position, alone))
    assert not torch.equal(lit[0], lit[1])


def test_tint_is_a_black_bodys():
    colors = tint(np.array([6500.0, 2700.0, 4000.0]))
    np.testing.assert_allclose(colors[0], 1.0)  # white is the light that pictures are balanced for
    red, green, blue = colors.T
    assert red[1] > red[2] > 1 > blue[2] > blue[1]
    np.testing.assert_allclose(green, 1.0)
    # Wien's approximation, within a few percent of Planck at these wavelengths: ln(R/G) is linear in 1/T.
    wien = 1.438777e-2 * (1 / 2700 - 1 / 6500) * (1 / 549e-9 - 1 / 611e-9)
    assert np.log(red[1]) == pytest.approx(wien, rel=0.05)
