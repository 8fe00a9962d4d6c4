"""Videos of evaluated episodes: recorded actions are played again from the same seed and filmed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import imageio_ffmpeg
import numpy as np
import torch
from rich.console import Console

from manicm_ms.evaluation.play import EnvMaker
from manicm_ms.evaluation.protocol import EvaluatedPolicy, Protocol, slug
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.progress import progress_bars

if TYPE_CHECKING:
    from manicm_ms.envs.vector import VecEnv

_HOLD_SECONDS = 0.6
"""How long the last frame stands still, so that the outcome can be seen."""


_KINDS = ((True, True), (True, False), (False, True), (False, False))
"""Outcomes of a pair: (first succeeds, second succeeds)."""


class Take(NamedTuple):
    """One episode to film, and where to write it."""

    episode: EpisodeResult
    path: Path


def choose_seeds(first: Sequence[EpisodeResult], second: Sequence[EpisodeResult], count: int) -> list[int]:
    """Return up to `count` seeds that show every kind of outcome of the pair.

    Kinds (both succeed, one alone, the other alone, neither) take turns, the earliest seed of each
    first; crashed episodes are left out, they cannot be played again.
    """
    kinds: dict[tuple[bool, bool], list[int]] = {kind: [] for kind in _KINDS}
    for a, b in zip(first, second, strict=True):
        if a.crashed is None and b.crashed is None:
            kinds[a.success, b.success].append(a.seed)
    depth = max((len(seeds) for seeds in kinds.values()), default=0)
    turns = [seeds[i] for i in range(depth) for seeds in kinds.values() if i < len(seeds)]
    return turns[:count]


def film(vec_env: VecEnv, takes: Sequence[Take], fps: float) -> Iterator[tuple[Take, bool]]:
    """Play each take's recorded actions from its seed and write an h264 video of the wide camera.

    The actions are replayed as recorded, so a video shows the evaluated episode itself, whatever batch
    the policy decided in then.

    Args:
        vec_env: an env without a chunk, of any number of rows.
        takes: episodes with their actions.
        fps: frames (control steps) per second.

    Yields:
        Each take with whether the replay succeeded, which differs from the record only where the
        simulation does not repeat itself.
    """
    pending = iter(takes)
    while group := list(islice(pending, vec_env.num_envs)):
        yield from zip(group, _film_group(vec_env, group, fps), strict=True)


def _film_group(vec_env: VecEnv, group: Sequence[Take], fps: float) -> list[bool]:
    n, dim = vec_env.num_envs, vec_env.env_spec.action.dim
    outcome = "success_once" if vec_env.env_spec.success_rule == "any" else "success"
    plans = [take.episode.actions.reshape(-1, dim) for take in group]  # each (L, Da)
    seeds = [group[min(i, len(group) - 1)].episode.seed for i in range(n)]  # spare rows repeat the last
    vec_env.reset(seed=seeds, options={"reset_mask": np.ones(n, dtype=bool)})
    alive, success = [len(plan) > 0 for plan in plans], [False] * len(group)
    with ExitStack() as stack:
        frames = _frames(vec_env)
        writers = [stack.enter_context(Mp4Writer(take.path, frames.shape[1:3], fps)) for take in group]
        for writer, frame in zip(writers, frames, strict=False):
            writer.add(frame)
        for step in range(max(map(len, plans))):
            actions = np.zeros((n, dim), np.float32)
            for i, plan in enumerate(plans):
                actions[i] = plan[step] if step < len(plan) else 0.0
            _, _, terminated, truncated, info = vec_env.step(torch.from_numpy(actions).to(vec_env.device))
            frames = _frames(vec_env)
            for i, writer in enumerate(writers):
                if alive[i]:
                    writer.add(frames[i])
                    success[i] = bool(info[outcome][i])
                    alive[i] = step + 1 < len(plans[i]) and not bool(terminated[i] | truncated[i])
            if not any(alive):
                break
        for writer in writers:
            writer.hold(round(_HOLD_SECONDS * fps))
    return success


def _frames(vec_env: VecEnv) -> np.ndarray:
    return torch.as_tensor(vec_env.render_video_frames()).cpu().numpy()  # (N, H, W, 3) uint8


def film_pair(
    policies: Sequence[EvaluatedPolicy],
    protocol: Protocol,
    envs: EnvMaker,
    out: Path,
    episodes: Mapping[str, Sequence[EpisodeResult]],
    fps: float,
    console: Console,
) -> list[dict[str, Any]]:
    """Film the first and the last policy on the same seeds; return what was filmed.

    Args:
        policies: teacher first, student last; one alone is filmed alone.
        protocol: how many seeds, and under which preset: the first.
        envs: makes the vector env.
        out: folder of the evaluation; videos that it holds are not made again.
        episodes: policy -> results in the order of the seeds.
        fps: frames (control steps) per second.
        console: for progress, and for a line where filming fails: a report without pictures is better than none.

    Returns:
        A dictionary with seed, policy, success and file (relative to `out`) for each video that is there.
    """
    cast = [policies[0], policies[-1]] if len(policies) > 1 else [policies[0]]
    seeds = choose_seeds(episodes[cast[0].name], episodes[cast[-1].name], protocol.videos)
    scenes = [(seed, evaluated) for seed in seeds for evaluated in cast]
    by_seed = {c.name: {e.seed: e for e in episodes[c.name]} for c in cast}
    entries, takes = [], []
    for seed, evaluated in scenes:
        file = f"videos/{slug(evaluated.name)}-{seed}.mp4"
        episode = by_seed[evaluated.name][seed]
        entries.append({"seed": seed, "policy": evaluated.name, "success": episode.success, "file": file})
        if not (out / file).exists():
            takes.append(Take(episode, out / file))
    if not takes:
        return entries
    try:
        with progress_bars(console, "{task.fields[successes]}") as progress:
            bar = progress.add_task("videos", total=len(takes), successes="")
            vec_env = envs.for_film(min(protocol.num_envs, len(takes)), protocol.realism[0])
            try:
                for take, success in film(vec_env, takes, fps):
                    progress.update(bar, advance=1)
                    if success != take.episode.success:  # a simulation that does not repeat itself
                        take.path.unlink()
            finally:
                vec_env.close()
    except Exception as error:  # whatever the renderer raised
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        console.print(f"not all videos were made: {reason}", style="yellow", markup=False, soft_wrap=True)
    return [entry for entry in entries if (out / str(entry["file"])).exists()]


class Mp4Writer:
    """Writes RGB frames (H, W, 3) uint8 to an mp4 file that appears only when it is whole.

    Args:
        path: the file.
        size: (H, W), pixels; odd sizes lose their last row or column, which h264 cannot hold.
        fps: frames per second.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self._part = path, path.with_name(f".part-{path.name}")
        self._height, self._width = size[0] // 2 * 2, size[1] // 2 * 2
        self._last: np.ndarray | None = None
        self._writer = imageio_ffmpeg.write_frames(
            str(self._part),
            (self._width, self._height),
            fps=fps,
            codec="libx264",
            macro_block_size=2,
            output_params=["-crf", "27", "-preset", "medium", "-movflags", "+faststart", "-threads", "1"],
            ffmpeg_log_level="error",
        )
        self._writer.send(None)

    def add(self, frame: np.ndarray) -> None:
        """Append a frame."""
        self._last = np.ascontiguousarray(frame[: self._height, : self._width])
        self._writer.send(self._last)

    def hold(self, count: int) -> None:
        """Repeat the last frame `count` times."""
        for _ in range(count):
            self._writer.send(self._last)

    def __enter__(self) -> Mp4Writer:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        self._writer.close()
        if kind is None:
            self._part.replace(self.path)
        else:
            self._part.unlink(missing_ok=True)
