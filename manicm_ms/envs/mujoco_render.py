"""A renderer for MuJoCo that gives colour and depth in one pass, without shadows, within milliseconds on a CPU.

Run as a module, it renders one tiny picture and prints what rendered it.
"""

from __future__ import annotations

import atexit
import importlib
import sys
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from manicm_ms.errors import RenderDeviceError
from manicm_ms.machine import mujoco_gl

mujoco_gl.prepare_import()  # before mujoco is first imported

import mujoco  # noqa: E402

_PROBE = """
<mujoco><worldbody>
  <light pos="0 0 3"/><camera pos="0 0 1"/><geom type="box" size=".1 .1 .1" rgba="1 0 0 1"/>
</worldbody></mujoco>
"""
_PROBE_DEPTH_M = 0.9  # from the camera to the box's upper face
_SPARE_GEOMS = 1000  # beside the model's own: markers that the scene adds
_OFF = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX", "mjRND_FOG", "mjRND_HAZE")


class Picture(NamedTuple):
    """What a camera saw; row 0 is the upper one.

    Attributes:
        image: (H, W, 3) uint8.
        depth: (H, W) float32, metres along the optical axis; that of the far plane where nothing was hit.
        hit: (H, W) bool, where something was hit.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    hit: NDArray[np.bool_]


class LeanRenderer:
    """Renders one model from its fixed cameras, without shadows, reflections, sky or multisampling.

    Shadows and multisampling take 20 times as long as the rest on a CPU. The depth does not depend on them: it is bit
    for bit that of `mujoco.Renderer`.

    The GL context is made by the first `render`, in the process and thread that will use it, and made current before
    every one: contexts of other renderers may have been used in between.

    Args:
        model: its render quality is lowered.
        largest: (H, W) of the largest picture that will be asked for, pixels.
        solid: draw translucent geoms and sites solid, as `mujoco.Renderer` does for its depth images. OpenGL blends
            what is translucent into the colour and leaves it out of the depth.
    """

    def __init__(self, model: mujoco.MjModel, largest: tuple[int, int], solid: bool = True) -> None:
        self._model = model
        if solid:
            for rgba in (model.geom_rgba, model.mat_rgba, model.site_rgba):
                rgba[(rgba[:, 3] > 0) & (rgba[:, 3] < 1), 3] = 1
        self._buffer = max(model.vis.global_.offheight, largest[0]), max(model.vis.global_.offwidth, largest[1])
        model.vis.global_.offheight, model.vis.global_.offwidth = self._buffer
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._scene: Any = None
        self._gl: Any = None
        self._context: Any = None

    def render(self, data: mujoco.MjData, camera: int, size: tuple[int, int]) -> Picture:
        """Return what the model's camera number `camera` sees at `size` (H, W); needs up-to-date kinematics.

        Raises RenderDeviceError where this machine has no OpenGL.
        """
        if self._context is None:
            self._open()
        self._gl.make_current()
        height, width = size
        rect = mujoco.MjrRect(0, 0, width, height)
        self._camera.fixedcamid = camera
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        image, buffer = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        mujoco.mjr_render(rect, self._scene, self._context)
        mujoco.mjr_readPixels(image, buffer, rect, self._context)
        buffer = buffer[::-1]  # OpenGL's first row is the lowest
        return Picture(np.ascontiguousarray(image[::-1]), self._metres(buffer), buffer > 0)

    def _open(self) -> None:
        height, width = self._buffer
        self._gl = mujoco_gl.make_context(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        # Reversed depth spends the floats' precision where things are; 0 is the far plane.
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + self._model.nsite + _SPARE_GEOMS)
        for name in _OFF:
            self._scene.flags[getattr(mujoco.mjtRndFlag, name)] = False
        atexit.register(self.close)  # after EGL's own, so it runs before: else freeing meets a closed display

    def _metres(self, buffer: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the distance along the axis of a reversed depth buffer in [0, 1].

        With the matrix of OpenGL's glFrustum, in float32 as OpenGL keeps it, and mapped to reversed depth; as in
        `mujoco.Renderer.render`.
        """
        extent = self._model.stat.extent
        near = np.float32(self._model.vis.map.znear * extent)
        far = np.float32(self._model.vis.map.zfar * extent)
        scale = np.float32(-0.5) * (-(far + near) / (far - near)) - np.float32(0.5)
        offset = np.float32(-0.5) * (-(np.float32(2) * far * near) / (far - near))
        return (offset / (buffer.astype(np.float64) + scale)).astype(np.float32)

    def close(self) -> None:
        """Free the context; a second call does nothing."""
        if self._context is None:
            return
        atexit.unregister(self.close)
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        self._context = self._gl = self._scene = None


def trial() -> str:
    """Render a box from above, check its depth, and return what rendered it. Raises RenderDeviceError."""
    model = mujoco.MjModel.from_xml_string(_PROBE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = LeanRenderer(model, (8, 8))
    try:
        depth = float(renderer.render(data, 0, (8, 8)).depth[4, 4])
        gl = importlib.import_module("OpenGL.GL")  # not before mujoco, which tells PyOpenGL the platform
        name = gl.glGetString(gl.GL_RENDERER).decode()
    finally:
        renderer.close()
    if abs(depth - _PROBE_DEPTH_M) > 1e-4:
        raise RenderDeviceError(f"{name} rendered a depth of {depth:.4f} m instead of {_PROBE_DEPTH_M} m")
    return f"{name} through {mujoco_gl.prepare()}"


if __name__ == "__main__":
    try:
        print(trial())
    except RenderDeviceError as failure:
        sys.exit(str(failure))
