"""The lean renderer against MuJoCo's own, against rays, and beside other contexts."""

from importlib.util import find_spec

import numpy as np
import pytest

if find_spec("mujoco") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.envs.mujoco_render import LeanRenderer, mujoco
from manicm_ms.errors import RenderDeviceError
from manicm_ms.machine import mujoco_gl

SCENE = """
<mujoco>
  <visual><global offwidth="200" offheight="150"/></visual>
  <worldbody>
    <light pos="0 0 3" dir="0 0 -1" castshadow="true"/>
    <camera name="side" pos="0 -2 1.2" xyaxes="1 0 0 0 0.5 0.8"/>
    <camera name="top" pos="0 0 2" xyaxes="0 1 0 -1 0 0"/>
    <geom type="plane" size="3 3 .1" rgba=".5 .5 .5 1"/>
    <body pos=".2 .1 .3"><freejoint/><geom type="box" size=".2 .1 .3" euler="20 10 30" rgba="1 0 0 1"/></body>
    <body pos="-.4 0 .3"><geom type="sphere" size=".2" rgba="0 1 0 .3"/></body>
    <site name="goal" pos="0 -.5 .3" size=".05" rgba="0 0 1 .5"/>
  </worldbody>
</mujoco>
"""


def scene():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def mujoco_depth(size, camera):
    """What `mujoco.Renderer` gives at its defaults, on a model of its own."""
    model, data = scene()
    with mujoco.Renderer(model, *size) as renderer:
        renderer.enable_depth_rendering()
        renderer.update_scene(data, camera)
        return renderer.render().copy()


@pytest.fixture
def lean():
    model, data = scene()
    renderer = LeanRenderer(model, (84, 84))
    yield renderer, data
    renderer.close()


@pytest.mark.parametrize("size", [(84, 84), (150, 200)])
@pytest.mark.parametrize("camera", ["side", "top"])
def test_depth_is_that_of_mujoco_s_renderer_bit_for_bit(lean, size, camera):
    renderer, data = lean
    picture = renderer.render(data, ("side", "top").index(camera), size)
    expected = mujoco_depth(size, camera)
    assert np.array_equal(picture.depth, expected)
    assert picture.image.shape == (*size, 3)
    assert picture.hit.mean() > 0.5


def test_depth_is_that_of_rays(lean):
    renderer, data = lean
    model, _ = scene()
    depth = renderer.render(data, 0, (40, 40)).depth
    focal = 20 / np.tan(np.deg2rad(model.cam_fovy[0]) / 2)
    rotation, eye = data.cam_xmat[0].reshape(3, 3), data.cam_xpos[0]
    checked, geom, flat = 0, np.zeros(1, np.int32), (0, 1)  # the sphere is drawn as a polyhedron
    for v in range(0, 40, 3):
        for u in range(0, 40, 3):
            ray = rotation @ np.array([(u + 0.5 - 20) / focal, -(v + 0.5 - 20) / focal, -1.0])
            hit = mujoco.mj_ray(model, data, eye, ray / np.linalg.norm(ray), None, 1, -1, geom)
            if geom[0] in flat and abs(hit / np.linalg.norm(ray) - depth[v, u]) < 0.05:  # else a silhouette, the site
                assert hit / np.linalg.norm(ray) == pytest.approx(depth[v, u], abs=1e-5)
                checked += 1
    assert checked > 100


def test_row_0_is_the_upper_one_and_colours_fit(lean):
    renderer, data = lean
    image = renderer.render(data, 1, (84, 84)).image.astype(int)
    # The top camera's x axis is the world's y and its y axis is the world's -x: the green sphere at x = -0.4 is above.
    green = np.argwhere((image[..., 1] - image[..., 0] > 60) & (image[..., 1] - image[..., 2] > 60))
    assert len(green) > 20
    assert green[:, 0].mean() < 38
    assert abs(green[:, 1].mean() - 41.5) < 3


def test_translucent_things_are_left_out_of_depth_unless_drawn_solid():
    depths = {}
    for solid in (True, False):
        model, data = scene()
        renderer = LeanRenderer(model, (84, 84), solid)
        depths[solid] = renderer.render(data, 1, (84, 84)).depth
        renderer.close()
    nearer = depths[False] - depths[True]
    assert nearer.min() == 0
    assert nearer.max() == pytest.approx(0.5, abs=0.02), "the sphere's top, 0.5 m above the floor"


def test_nothing_hit_is_told():
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera pos='0 0 1'/></worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = LeanRenderer(model, (8, 8))
    assert not renderer.render(data, 0, (8, 8)).hit.any()
    renderer.close()


def test_contexts_take_turns_and_closing_twice_is_harmless(lean):
    renderer, data = lean
    before = renderer.render(data, 0, (84, 84))
    model, other_data = scene()
    other = LeanRenderer(model, (84, 84))
    other.render(other_data, 1, (84, 84))
    again = renderer.render(data, 0, (84, 84))
    other.close()
    after = renderer.render(data, 0, (84, 84))
    other.close()
    for picture in (again, after):
        assert np.array_equal(picture.depth, before.depth)
        assert np.array_equal(picture.image, before.image)


def test_no_context_before_the_first_picture(monkeypatch):
    made = []
    make = mujoco_gl.make_context
    monkeypatch.setattr(mujoco_gl, "make_context", lambda *size: made.append(size) or make(*size))
    model, data = scene()
    renderer = LeanRenderer(model, (300, 84))
    assert made == []
    renderer.render(data, 0, (84, 84))
    renderer.render(data, 0, (300, 84))
    assert made == [(200, 300)], "one context, as large as the largest picture and the model's own buffer"
    renderer.close()


# ---- the choice of OpenGL -------------------------------------------------------------------------------------------


def test_the_users_choice_stays(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "Disabled")
    assert mujoco_gl.prepare() == "disabled"
    with pytest.raises(RenderDeviceError, match=r"no OpenGL to render with.*make setup"):
        mujoco_gl.make_context(8, 8)


def test_an_unknown_choice_lists_those_that_exist(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(RenderDeviceError, match="MUJOCO_GL=vulkan is none of egl, osmesa, glfw, disabled"):
        mujoco_gl.prepare()


@pytest.mark.parametrize(("egl", "osmesa", "choice"), [(1, 1, "egl"), (0, 1, "osmesa"), (0, 0, "disabled")])
def test_egl_comes_first_then_osmesa(monkeypatch, egl, osmesa, choice):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setenv("MANICM_MS_MUJOCO_GL", "system")
    monkeypatch.setattr(mujoco_gl, "_egl_works", lambda: bool(egl))
    monkeypatch.setattr(mujoco_gl, "_library", lambda *names: "OSMesa" in names[0] and bool(osmesa))
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)  # mujoco's import has set it here
    assert mujoco_gl.prepare() == choice


def test_a_named_library_that_is_missing_is_told(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("MANICM_MS_MUJOCO_GL", "system")
    monkeypatch.setattr(mujoco_gl, "_library", lambda *names: None)
    with pytest.raises(RenderDeviceError, match=r"MUJOCO_GL=osmesa, but libOSMesa\.so\.8 is not here"):
        mujoco_gl.prepare()


def test_the_trial_picture(monkeypatch):
    works = mujoco_gl.probe()
    assert works.works, works.reason
    assert "through" in works.device
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    broken = mujoco_gl.probe()
    assert not broken.works
    assert "no OpenGL" in broken.reason
