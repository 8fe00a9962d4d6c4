"""`manicm-ms inspect`: the summary of a store, its problems, and a page that shows its episodes in 3D."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.summary import Summary, summarize
from manicm_ms.errors import StoreError
from manicm_ms.paths import write_text

_MOST_EPISODES, _MOST_FRAMES = 6, 60  # in a page, about 200 kB an episode
_STRIP_FRAMES = 8


def inspect(store: Path, html: Path | None = None, as_json: bool = False) -> int:
    """Print what a store holds; return the exit status, 1 where something is wrong with it.

    Args:
        store: the store.
        html: write a self-contained page to this file: summary, clouds to turn, picture strips.
        as_json: print the fields of `Summary` as JSON instead of tables.

    Raises StoreError where there is no store at all.
    """
    found = summarize(Path(store))
    console = Console(highlight=False)
    if as_json:
        print(json.dumps(found.to_dict(), indent=2, allow_nan=False))
    else:
        _print_summary(console, found)
    if html is not None:
        write_page(Path(store), found, Path(html))
        if not as_json:
            console.print(f"page written to {html}", soft_wrap=True)
    return 1 if found.problems else 0


def write_page(store: Path, found: Summary, html: Path) -> None:
    """Write the page of a store that was looked through; of a damaged one it shows what can still be read."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("manicm_ms.demos"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    episodes, strips = _readable_episodes(store, found)
    page = environment.get_template("inspect.html.j2").render(
        summary=found, facts=_facts(found), episodes=episodes, strips=strips
    )
    write_text(html, page)


def pack_clouds(clouds: np.ndarray) -> dict[str, Any]:
    """Quantise clouds (L, P, C), metres, for the page: xyz to 16 bits of their range, rgb to 8.

    Returns JSON values: frames, points, low and span of x, y, z (metres), `xyz` and `rgb` (or None)
    as base64. A point is low + span * value / 65535.
    """
    xyz = clouds[..., :3]
    low = xyz.min(axis=(0, 1))
    span = np.maximum(xyz.max(axis=(0, 1)) - low, 1e-9)
    codes = np.round((xyz - low) / span * 65535).astype("<u2")
    rgb = None
    if clouds.shape[-1] == 6:
        rgb = _base64(np.round(clouds[..., 3:].clip(0, 1) * 255).astype("u1").tobytes())
    return {
        "frames": len(clouds),
        "points": clouds.shape[1],
        "low": [float(v) for v in low],
        "span": [float(v) for v in span],
        "xyz": _base64(codes.tobytes()),
        "rgb": rgb,
    }


def _readable_episodes(store: Path, found: Summary) -> tuple[list[dict[str, Any]], list[dict[str, str]]]:
    """Return the packed episodes for the viewer, and a picture strip of each."""
    episodes: list[dict[str, Any]] = []
    strips: list[dict[str, str]] = []
    try:
        reader = DemoStore.open(store)
    except StoreError:
        return episodes, strips
    with reader:
        chosen = np.unique(np.linspace(0, len(reader) - 1, min(_MOST_EPISODES, len(reader))).astype(int))
        for k in chosen:
            try:
                episode = reader.episode(int(k))
            except StoreError:  # the summary has named it
                continue
            frames = _spread(len(episode), _MOST_FRAMES)
            clouds = np.nan_to_num(episode.point_cloud[frames], nan=0.0, posinf=0.0, neginf=0.0)
            label = f"episode {k}, seed {episode.seed}, {len(episode)} steps"
            packed = pack_clouds(clouds)
            packed |= {"label": label, "steps": [int(f) for f in frames], "hz": reader.spec.action.control_hz}
            episodes.append(packed)
            shown = _spread(len(episode), _STRIP_FRAMES)
            picture = _image_strip(episode.image[shown]) if episode.image is not None else _cloud_strip(clouds, frames)
            strips.append({"label": label, "png": picture})
    return episodes, strips


def _spread(length: int, most: int) -> np.ndarray:
    """Return at most `most` frame numbers, evenly spread from the first to the last."""
    return np.unique(np.round(np.linspace(0, length - 1, min(most, length))).astype(int))


def _cloud_strip(clouds: np.ndarray, steps: np.ndarray) -> str:
    """Return pictures of clouds (L, P, C) side by side, as a base64 PNG."""
    from matplotlib.figure import Figure

    shown = _spread(len(clouds), _STRIP_FRAMES)
    figure = Figure(figsize=(1.9 * len(shown), 2.1), dpi=100)
    low, high = clouds[..., :3].min(axis=(0, 1)), clouds[..., :3].max(axis=(0, 1))
    for place, k in enumerate(shown):
        axes = figure.add_subplot(1, len(shown), place + 1, projection="3d")
        if clouds.shape[-1] == 6:
            coloring: dict[str, Any] = {"c": clouds[k, :, 3:].clip(0, 1)}
        else:
            coloring = {"c": clouds[k, :, 2], "cmap": "viridis", "vmin": low[2], "vmax": high[2]}
        axes.scatter(*clouds[k, :, :3].T, s=2, **coloring)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(np.maximum(high - low, 1e-3), zoom=1.5)
        axes.view_init(elev=25, azim=-60)
        axes.set_axis_off()
        axes.set_title(f"step {steps[k]}", fontsize=8)
    figure.subplots_adjust(0, 0, 1, 0.92, 0, 0)
    return _png(figure)


def _image_strip(images: np.ndarray) -> str:
    """Return camera images (L, H, W, 3) uint8 side by side, as a base64 PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.9 * len(images), 1.9), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(np.concatenate(list(images), axis=1))
    axes.set_axis_off()
    return _png(figure)


def _png(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return _base64(buffer.getvalue())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _facts(found: Summary) -> list[tuple[str, str]]:
    """Return the summary as (name, value) rows, for the terminal and the page."""
    lengths = found.lengths
    rows = [
        ("environment", found.env_id or "unknown"),
        ("episodes", f"{found.episodes} kept of {found.attempts} tried, {sum(found.success)} solved"),
        ("seeds", f"{min(found.seeds)} to {max(found.seeds)}" if found.seeds else "none"),
    ]
    if lengths:
        spread = f"{min(lengths)} to {max(lengths)}, median {np.median(lengths):g}"
        rows.append(("lengths", f"{spread} control steps; {found.frames} frames in all"))
    rows.append(("expert", f"{found.expert or 'unknown'}, style {found.style or 'unknown'}"))
    rows.append(("stored", ", ".join(f"{name} {form}" for name, form in found.fields.items())))
    rows.append(("size", f"{found.bytes_on_disk / 1e6:.1f} MB"))
    if "command" in found.provenance:
        rows.append(("command", str(found.provenance["command"])))
    versions = found.provenance.get("versions")
    if isinstance(versions, dict):
        rows.append(("versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    return rows


def _print_summary(console: Console, found: Summary) -> None:
    table = Table(title=found.path, show_header=False, title_justify="left")
    for name, value in _facts(found):
        table.add_row(name, value)
    console.print(table)
    ranges = Table("field", "channel", "least", "greatest", title="ranges", title_justify="left")
    for field, channels in found.ranges.items():
        for channel, (low, high) in channels.items():
            ranges.add_row(field, channel, f"{low:.4f}", f"{high:.4f}")
    console.print(ranges)
    for problem in found.problems:
        console.print("[bold red]problem:[/] ", end="")
        console.print(problem, markup=False, soft_wrap=True)
    for remark in found.remarks:
        console.print("[bold yellow]remark:[/] ", end="")
        console.print(remark, markup=False, soft_wrap=True)
    if not found.problems:
        console.print("no problem found")
