"""Show what the model of the D435i does to a scene: clean and noisy depth, and the clouds of both.

`python scripts/results/depth_picture.py --env ur3e/slide-block --out docs/images/d435i_depth.png`
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
import tyro
from torch import Tensor

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.maniskill import workspace_of
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.sensing.camera_files import default_camera
from manicm_ms.sensing.depth_cloud import depth_to_cloud
from manicm_ms.sensing.stereo_depth import StereoDepth
from manicm_ms.spec import DEPTH, IMAGE, STATE

matplotlib.use("Agg")
import matplotlib.pyplot as plt

NUM_POINTS = 512


@dataclass(frozen=True)
class Options:
    """What to show.

    Attributes:
        env: environment id.
        seed: of the episode and of the noise.
        step: control steps that the expert plays before.
        out: the picture.
    """

    env: str = "ur3e/slide-block"
    seed: int = 3
    step: int = 45
    out: Path = Path("docs/images/d435i_depth.png")


def scene(env_id: str, seed: int, step: int, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return exact depth (1, h, w) m and image (1, h, w, 3) uint8 after `step` steps of the expert's episode."""
    env = make_vec(env_id, 1, backend="cpu", obs=(DEPTH, IMAGE, STATE), image_size=size)
    try:
        expert = EXPERTS.get(env_id)(env.env_spec, 1, env.device, None)
        obs, _ = env.reset(seed=[seed])
        expert.reset(obs[STATE], [seed], torch.ones(1, dtype=torch.bool))
        for _ in range(step):
            obs, *_ = env.step(expert.act(obs[STATE]))
        return obs[DEPTH], obs[IMAGE]
    finally:
        env.close()


def show_depth(axes: Any, depth: Tensor, title: str, near: float, far: float) -> None:
    """Draw depth (h, w) m; pixels without a reading are black."""
    colors = plt.get_cmap("turbo_r").copy()
    colors.set_bad("black")
    picture = axes.imshow(
        np.ma.masked_equal(depth.numpy(), 0), cmap=colors, vmin=near, vmax=far, interpolation="nearest"
    )
    axes.set_title(title)
    axes.set_axis_off()
    plt.colorbar(picture, ax=axes, fraction=0.046, label="depth, m")


def show_cloud(axes: Any, cloud: Tensor, title: str) -> None:
    """Draw a cloud (P, 3) m from the side, along the base frame's x."""
    points = cloud.numpy()
    axes.scatter(points[:, 1], points[:, 2], s=6, c=points[:, 0], cmap="viridis", vmin=0.2, vmax=0.45)
    axes.set(title=title, xlabel="y, m", ylabel="z, m", xlim=(-0.25, 0.25), ylim=(-0.01, 0.16), aspect="equal")


def main(options: Options) -> None:
    """Render, apply the model, draw."""
    camera, workspace = default_camera(), workspace_of(options.env)
    clean, image = scene(options.env, options.seed, options.step, (camera.crop.height, camera.crop.width))
    intensity = image.float().mean(dim=-1) / 255
    noisy = StereoDepth().apply(clean, camera, [options.seed], [options.step], intensity=intensity)
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), gridspec_kw={"height_ratios": (2.2, 1)}, layout="constrained")
    near, far = clean[clean > 0].min().item(), min(1.0, clean.max().item())
    lost = ((noisy == 0) & (clean > 0)).float().mean().item()
    for column, (depth, name) in enumerate(((clean, "exact"), (noisy, f"D435i model: {lost:.1%} lost"))):
        show_depth(axes[0, column], depth[0], name, near, far)
        cloud = depth_to_cloud(depth, camera, workspace, NUM_POINTS)[0]
        show_cloud(axes[1, column], cloud, f"its cloud of {NUM_POINTS} points")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=80)
    print(f"{options.out}: {lost:.1%} of the readings are lost")


if __name__ == "__main__":
    main(tyro.cli(Options))
