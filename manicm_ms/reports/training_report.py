"""The report on a training: curves, configuration, where its data come from, evaluations, how to make it again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.evaluation.plots import Line, Panel, curves_plot
from manicm_ms.evaluation.report import template
from manicm_ms.paths import write_text
from manicm_ms.policies.parameter_counts import TOTAL
from manicm_ms.reports.evaluations import Evaluation, evaluations_of, named_evaluation
from manicm_ms.training.commands import collection_commands, flat, training_command
from manicm_ms.training.history import History, read_history
from manicm_ms.wording import counted

_MOST_ROWS = 12  # of the log, in numbers
_NOT_KNOWN = "not recorded"
_DIGITS = 5


class Section(NamedTuple):
    """A part of the report.

    Attributes:
        title: its heading.
        headers: of its table.
        rows: of its table; on the page they stand behind the figure, where there is one.
        notes: sentences below.
        figure: SVG, "" for none.
        code: command lines.
    """

    title: str
    headers: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    notes: Sequence[str] = ()
    figure: str = ""
    code: Sequence[str] = ()


def report_training(out: Path, evaluations: Sequence[Path] = (), folder: Path | None = None) -> Path:
    """Write report.html and report.md on the training of checkpoint folder `out`; return the page.

    Args:
        out: checkpoint folder of `train` or `distill`; of a run under way, where the checkpoint will be.
        evaluations: folders of finished evaluations in which the checkpoint, or one kept on the way, was played.
        folder: where the two files go; by default `<out>.report`.

    Raises:
        CheckpointError: there is no such training, or it is damaged.
        ConfigError: an evaluation is not there, or holds no checkpoint of this training.
    """
    history = read_history(Path(out))
    found = [named_evaluation(path, history.checkpoints) for path in evaluations]
    target = Path(folder) if folder is not None else history.out.with_name(f"{history.out.name}.report")
    context = report_context(history, found)
    package = "manicm_ms.reports"
    write_text(target / "report.md", template("training.md.j2", autoescape=False, package=package).render(context))
    write_text(target / "report.html", template("training.html.j2", autoescape=True, package=package).render(context))
    return target / "report.html"


def report_context(history: History, evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """Return what the templates show."""
    described, made = history.description, history.provenance
    env_id = described.get("env_spec", {}).get("env_id", _NOT_KNOWN)
    sections = [
        _curves(history), _over_time(history, evaluations), *map(_evaluated, evaluations), _parameters(history),
        _configuration(history), _data(made.get("data", {})), _teacher(made), _circumstances(history),
        _reproduce(history, evaluations),
    ]  # fmt: skip
    return {
        "title": f"{described['policy']} for {env_id}",
        "lead": f"{history.out}. {how_far(history)}",
        "role": made.get("kind", "policy"),
        "tiles": list(_tiles(history)),
        "sections": [section for section in sections if section is not None],
    }


def how_far(history: History) -> str:
    """Return in one sentence whether the training is finished, and how far it is where it is not."""
    if history.step is None:
        return "Finished; after how many steps is not recorded."
    if history.finished:
        return f"Finished: {counted(history.step, 'step')}."
    if history.total_steps is None:
        return f"Not finished: {counted(history.step, 'step')} logged so far."
    share = 100 * history.step / history.total_steps
    return f"Not finished: {history.step} of {history.total_steps} steps logged so far ({share:.0f} %)."


def _tiles(history: History) -> Iterator[tuple[str, str, str]]:
    made, log = history.provenance, history.log
    loss = log[-1]["loss"] if log else made.get("final_loss")
    yield (
        "steps",
        _NOT_KNOWN if history.step is None else str(history.step),
        f"of {history.total_steps}" if history.total_steps else "",
    )
    yield "last loss", _NOT_KNOWN if loss is None else f"{loss:.3g}", "mean of the last logged steps"
    if history.parameters:
        nfe = "" if history.nfe is None else counted(history.nfe, "network evaluation") + " a decision"
        yield "parameters", _millions(history.parameters[TOTAL]), nfe
    seconds = log[-1].get("seconds") if log else made.get("seconds")
    where = " ".join(str(made[key]) for key in ("device", "precision") if key in made)
    yield "time", _NOT_KNOWN if seconds is None else _duration(seconds), where


def _curves(history: History) -> Section:
    title = "Loss and learning rate"
    if not history.log:
        why = (
            "There is no log: the training folder is not beside this checkpoint."
            if history.log is None
            else "Nothing is logged yet."
        )
        return Section(title, notes=[why])
    log = history.log
    steps = [line["step"] for line in log]
    losses = Line(steps, [line["loss"] for line in log])
    rates = Line(steps, [line["learning_rate"] for line in log])
    panels = [Panel("loss", {"loss": losses}, log=min(losses.values) > 0), Panel("learning rate", {"rate": rates})]
    chosen = [log[round(k * (len(log) - 1) / (_MOST_ROWS - 1))] for k in range(_MOST_ROWS)]
    shown = {line["step"]: line for line in chosen}.values()
    rows = [[f"{n['step']}", f"{n['loss']:.4g}", f"{n['learning_rate']:.3g}", _duration(n["seconds"])] for n in shown]
    lowest = min(log, key=lambda line: line["loss"])
    notes = [
        f"{counted(len(log), 'line')} of the log, each the mean of the steps since the one before; the lowest is "
        f"{lowest['loss']:.4g} at step {lowest['step']}."
    ]
    figure = curves_plot(panels, "Loss and learning rate over the steps of the training")
    return Section(title, ("step", "loss", "learning rate", "time"), rows, notes, figure)


def _over_time(history: History, evaluations: Sequence[Evaluation]) -> Section | None:
    points = sorted({*evaluations_of(history.out), *(point for e in evaluations for point in e.points)})
    if len(points) < 2:
        return None
    rates = [100 * p.successes / p.n for p in points]
    intervals = [(100 * low, 100 * high) for low, high in (rate_interval(p.successes, p.n) for p in points)]
    line = Line([p.step for p in points], rates, intervals)
    rows = [
        [str(p.step), f"{p.successes}/{p.n}", f"{rate:.1f} %", f"{low:.0f} to {high:.0f} %"]
        for p, rate, (low, high) in zip(points, rates, intervals, strict=True)
    ]
    return Section(
        "Success over the training", ("step", "successes", "rate", "95 % interval"), rows,
        ["Checkpoints kept on the way, each played on seeds of its own; the band is Clopper-Pearson's 95 % interval."],
        curves_plot([Panel("success rate, %", {"success": line})], "Success rate over the steps of the training"),
    )  # fmt: skip


def _evaluated(evaluation: Evaluation) -> Section:
    return Section(
        f"Evaluation {evaluation.path}", evaluation.headers, evaluation.rows,
        [evaluation.title, *evaluation.sentences],
    )  # fmt: skip


def _parameters(history: History) -> Section | None:
    if not history.parameters:
        return None
    rows = [[part, f"{count:,}"] for part, count in history.parameters.items()]
    return Section("Parameters", ("part", "weights"), rows)


def _configuration(history: History) -> Section:
    described = history.description
    chunk = {f"chunk.{key}": value for key, value in described.get("chunk", {}).items()}
    preset = dict(history.provenance.get("preset", {}))
    changes = flat(preset.pop("changes", {}))
    values = {**chunk, **flat(described["config"]), **{f"training.{key}": value for key, value in preset.items()}}
    notes = [f"Changed from the preset: {', '.join(changes)}."] if changes else []
    return Section("Configuration", ("key", "value"), [[key, _shown(v)] for key, v in values.items()], notes)


def _data(data: Mapping[str, Any]) -> Section:
    """Return where the demonstrations come from, a column a store."""
    stores = data.get("stores", [data])
    made = [store.get("collection") or {} for store in stores]
    entries: dict[str, list[Any]] = {
        key: [store.get(key) for store in stores] for key in ("path", "env_id", "episodes", "frames", "windows")
    }
    entries["seeds"] = [_seeds(store.get("demo_seeds")) for store in stores]
    entries["sha256"] = [store.get("sha256") for store in stores]
    for key in ("expert", "style", "realism", "obs_preset", "point_channels", "command"):
        entries[key] = [collection.get(key) for collection in made]
    rows = [[key, *map(_shown, values)] for key, values in entries.items() if any(v is not None for v in values)]
    heads = ["store"] if len(stores) == 1 else [f"store {k}" for k in range(1, len(stores) + 1)]
    notes = [f"Hash of all stores together: {data['sha256']}."] if len(stores) > 1 else []
    return Section("Demonstrations", ("", *heads), rows, notes)


def _teacher(made: Mapping[str, Any]) -> Section | None:
    teacher = made.get("teacher")
    if not isinstance(teacher, Mapping):
        return None
    origin = teacher.get("provenance", {})
    entries = {
        "checkpoint": teacher.get("path"), "SHA-256 of its weights": teacher.get("sha256"),
        **{key: origin.get(key) for key in ("steps", "final_loss", "seconds", "seed", "precision", "command")},
        "demonstrations": origin.get("data", {}).get("path"),
    }  # fmt: skip
    return Section("Teacher", ("", "value"), [[key, _shown(value)] for key, value in entries.items()])


def _circumstances(history: History) -> Section:
    made = history.provenance
    entries = {key: made.get(key) for key in ("kind", "seed", "device", "precision", "seconds", "run")}
    rows = [[key, _shown(value)] for key, value in (entries | dict(history.packages)).items() if value is not None]
    return Section("Device, precision, versions", ("", "value"), rows)


def _reproduce(history: History, evaluations: Sequence[Evaluation]) -> Section:
    made, teacher = history.provenance, history.provenance.get("teacher") or {}
    origin = teacher.get("provenance", {})
    lines = [*collection_commands(origin.get("data", {})), *collection_commands(made.get("data", {}))]
    lines += [origin["command"]] if origin.get("command") else []
    own, given = training_command(history), str(made.get("command", ""))
    lines += [own] if own else []
    lines += [evaluation.command for evaluation in evaluations]
    code = list(dict.fromkeys(lines))
    notes = [f"It was made by `{given}`."] if given and given != own else []
    if not code:
        notes.append("The commands were not written down.")
    return Section("Reproduce", notes=notes, code=code)


def _seeds(seeds: Sequence[int] | None) -> str | None:
    """Return seeds as ranges."""
    if not seeds:
        return None
    ranges: list[list[int]] = []
    for seed in seeds:
        if ranges and seed == ranges[-1][1] + 1:
            ranges[-1][1] = seed
        else:
            ranges.append([seed, seed])
    return ", ".join(str(low) if low == high else f"{low} to {high}" for low, high in ranges)


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(_shown, value))
    return f"{value:.{_DIGITS}g}" if isinstance(value, float) else str(value)


def _millions(count: int) -> str:
    return f"{count / 1e6:.2f} M" if count >= 1e5 else f"{count:,}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
