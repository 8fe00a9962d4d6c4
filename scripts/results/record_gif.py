"""Record an expert's episodes through the wide camera as one looping GIF.

`python scripts/results/record_gif.py --env ur3e/slide-block --seeds 3 5 --out docs/images/slide_block.gif`
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.envs.vector import VecEnv
from manicm_ms.spec import AGENT_POS, STATE

EVERY = 2  # control steps a frame: 10 frames a second at 20 Hz
HOLD_FRAMES = 8  # of the last picture of an episode
COLORS = 64


@dataclass(frozen=True)
class Options:
    """What to record.

    Attributes:
        env: environment id.
        seeds: one episode each, one after the other.
        style: the expert's style.
        out: the GIF.
        size: width and height, pixels.
    """

    env: str = "ur3e/slide-block"
    seeds: tuple[int, ...] = (3, 8)
    style: str = "two-sided"
    out: Path = Path("docs/images/slide_block.gif")
    size: tuple[int, int] = (400, 300)


def episode(env: VecEnv, seed: int, style: str) -> list[np.ndarray]:
    """Return the frames (H, W, 3) uint8 of the expert's episode."""
    expert = EXPERTS.get(env.env_spec.env_id)(env.env_spec, 1, env.device, style)
    obs, _ = env.reset(seed=[seed])
    expert.reset(obs[STATE], [seed], torch.ones(1, dtype=torch.bool))
    frames, steps, ended = [], 0, False
    while not ended:
        if steps % EVERY == 0:
            frames.append(env.render_video_frames()[0].numpy())
        obs, _, terminated, truncated, _ = env.step(expert.act(obs[STATE]))
        steps, ended = steps + 1, bool(terminated | truncated)
    return frames + [env.render_video_frames()[0].numpy()] * HOLD_FRAMES


def main(options: Options) -> None:
    """Record and write the GIF."""
    env = make_vec(options.env, 1, backend="cpu", obs=(AGENT_POS, STATE), video=True)
    try:
        frames = [frame for seed in options.seeds for frame in episode(env, seed, options.style)]
    finally:
        env.close()
    pictures = [Image.fromarray(f).resize(options.size, Image.Resampling.LANCZOS) for f in frames]
    palette = pictures[0].quantize(COLORS)  # one palette for all, so that the background does not flicker
    pictures = [p.quantize(COLORS, palette=palette, dither=Image.Dither.NONE) for p in pictures]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    milliseconds = round(1000 * EVERY / env.env_spec.action.control_hz)
    pictures[0].save(options.out, save_all=True, append_images=pictures[1:], duration=milliseconds, loop=0)


if __name__ == "__main__":
    main(tyro.cli(Options))
