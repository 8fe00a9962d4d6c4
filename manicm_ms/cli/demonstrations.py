"""`manicm-ms collect`, `experts`, `inspect` and `convert`: the commands about demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from manicm_ms.cli.counts import AtLeast, Count, OptionalCount, Seed
from manicm_ms.cli.options import Backend
from manicm_ms.errors import ConfigError
from manicm_ms.spec import VOXEL_SIZE


def collect_command(
    env_id: tyro.conf.Positional[str | None] = None,
    out: Path | None = None,
    tag: str | None = None,
    episodes: Count = 10,
    num_envs: OptionalCount = None,
    seed: Seed = 0,
    style: str | None = None,
    backend: Backend = "auto",
    colors: bool = False,
    extras: tuple[str, ...] = (),
    voxel_size: Count = VOXEL_SIZE,
    tail_steps: Annotated[int | None, AtLeast(0)] = None,
    realism: str = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
) -> None:
    """Collect demonstrations of a task's expert into a store, in parallel; the same command goes on after a kill.

    Args:
        env_id: environment id; or name a tag.
        out: the store, a folder, by default data/ENV_ID.zarr; with --tag the folder of the stores, by default data.
        tag: collect in every environment that carries this tag, one after another.
        episodes: solved episodes wanted.
        num_envs: environments that play at once; by default one a core. The data does not depend on it.
        seed: first seed; seeds count up from it.
        style: style of the expert, its default one if not given.
        backend: where to simulate.
        colors: store rgb beside xyz.
        extras: optional fields to store: image, depth, privileged_state, voxel_grid.
        voxel_size: cells along each side of a voxel grid; 64 is the published number.
        tail_steps: control steps kept after the first success; by default the task's own number.
        realism: clean, d435i or d435i+dr: camera errors and physical values drawn for each episode.
        camera: YAML file of the cell's depth camera, as 'manicm-ms calibrate' writes it.
        obs_preset: manicm_ms, or dp3 for clouds as the public DP3 wrapper makes them.
    """
    from manicm_ms.cli.collecting import collect_one, collect_tagged
    from manicm_ms.envs.backends import default_num_envs

    options = {
        "num_envs": num_envs or default_num_envs(), "seed": seed, "style": style, "backend": backend,
        "colors": colors, "extras": extras, "voxel_size": voxel_size, "tail_steps": tail_steps, "realism": realism,
        "camera": camera, "obs_preset": obs_preset,
    }  # fmt: skip
    if (env_id is None) == (tag is None):
        raise ConfigError("name one environment id, or --tag and a tag ('manicm-ms list envs' shows both)")
    if env_id is not None:
        collect_one(env_id, out, episodes, options)
    else:
        collect_tagged(str(tag), out, episodes, options)


def experts_command(
    action: tyro.conf.Positional[Literal["fetch", "list"]],
    names: tyro.conf.Positional[tuple[str, ...]] = (),
    from_: Annotated[Path | None, tyro.conf.arg(name="from")] = None,
) -> None:
    """Get the weights of published experts from their public source, checked by SHA-256, or list those there are.

    Args:
        action: what to do.
        names: of experts, as in adroit/door; all of them by default.
        from_: a folder that holds door.npz and so on with their LICENSE, instead of the public source.
    """
    from manicm_ms.cli.collecting import experts

    experts(action, names, from_)


def inspect_command(
    store: tyro.conf.Positional[Path],
    html: Path | None = None,
    json: bool = False,
) -> int:
    """Summarise a store of demonstrations and name its problems; exit status 1 where there are any.

    Args:
        store: the store.
        html: where to write a page with a turnable point cloud; by default beside the store.
        json: print the summary as JSON and write no page.
    """
    from manicm_ms.demos.inspect import inspect

    page = None if json else html or store.with_suffix(".html")
    return inspect(store, html=page, as_json=json)


def convert_command(
    store: tyro.conf.Positional[Path],
    out: Path,
    to: str | None = None,
    from_: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    task: str | None = None,
    env: str | None = None,
    num_points: OptionalCount = None,
    colors: bool = False,
    frame: str | None = None,
    control_hz: float | None = None,
    cloud_scale: float | None = None,
    depth_scale: float | None = None,
    action_scale: tuple[float, ...] = (),
) -> None:
    """Convert a store for other tools (--to maniskill, lerobot, minari), or theirs into one (--from dp3).

    Args:
        store: what to convert.
        out: the folder to make.
        to: format to write.
        from_: format to read; --out is then a store of ours.
        task: with --to, the task in words, for formats that carry instructions.
        env: with --from, the environment that the data is of; without it the specs are made of the shapes.
        num_points: with --from, points kept of each cloud.
        colors: with --from, keep rgb beside xyz.
        frame: with --from and no --env, frame of the clouds: world (if not given) or robot_base.
        control_hz: with --from and no --env, actions per second; 10 if not given.
        cloud_scale: with --from, metres of a unit of the clouds: 0.001 for millimetres.
        depth_scale: with --from, metres of a unit of the depth images.
        action_scale: with --from, what actions are divided by to lie in [-1, 1]: one number, or one an entry.
    """
    from manicm_ms.cli.converting import convert_or_import

    reading = {
        "env": env, "num_points": num_points, "colors": colors or None, "frame": frame, "control_hz": control_hz,
        "cloud_scale": cloud_scale, "depth_scale": depth_scale, "action_scale": action_scale or None,
    }  # fmt: skip
    convert_or_import(store, out, to, from_, {"task": task}, reading)
