"""`manicm-ms train` and `distill`: the fields of the named preset are options, its values their defaults."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from manicm_ms.cli.counts import Seed
from manicm_ms.cli.options import this_command
from manicm_ms.errors import ConfigError, ManicmWarning
from manicm_ms.policies.configuration import Nested, at, lookup_or_none, merged, parse_overrides, read_yaml
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.optim import FitConfig
from manicm_ms.training.presets import STUDENT_PRESETS, StudentPreset, TeacherPreset, preset_for
from manicm_ms.training.settings import FLAGS, flag_values

DEFAULT_PRESET, DEFAULT_METHOD = "quick", "simple_dp3"
_FORMER_FLAGS = {"--mu": "--ema-decay", "--skip": "--solver-stride"}
F = TypeVar("F", bound=FitConfig)


@dataclass(frozen=True, kw_only=True)
class TrainFlags(FitConfig):
    """Options of a training: fields of the preset, and short names of keys of the policy's configuration.

    Attributes:
        ema_power: of the averaged weights, which are the policy in the end where the method averages.
        ema_max_decay: never keep more than this of the old average.
        precision: of the products in training; auto takes 16 bits where the device multiplies them.
        n_obs_steps: To, frames read (chunk.n_obs_steps).
        horizon: Tp, actions predicted (chunk.horizon).
        n_action_steps: Ta, actions executed (chunk.n_action_steps).
        prediction_type: what a diffusion network predicts: "sample" (x0) or "epsilon" (noise) (head.prediction_type).
        cloud_frame: "base" leaves the cloud where it is and scales it to [-1, 1]; "tcp" takes it relative to the tool
            centre point, in units of `cloud_scale`: 20 of 50 episodes more on Meta-World's pick-place. "auto" is tcp
            where agent_pos holds that point, else base, as for Adroit's hands (inputs.cloud_frame.frame).
        cloud_scale: metres that become 1 with `cloud_frame` tcp (inputs.cloud_frame.scale).
        points: points read of each cloud, in training and when acting; None uses all (inputs.points.max_points).
        acting_points: which ones when acting: "prefix" (clouds are stored in farthest-point order, so a prefix is a
            coarser cloud) or "random" (drawn anew for each decision, from its noise) (inputs.points.acting).
        training_points: which ones in each step of training: "random" or "prefix" (inputs.points.training).
        min_state_range: least range of a channel of agent_pos in its unit: a channel that moves less in the
            demonstrations is not stretched to [-1, 1]; 0 stretches it, as DP3 does (normalizer.min_state_range).
        down_dims: channels of the U-Net's stages (backbone.down_dims).
    """

    ema_power: float = 0.75
    ema_max_decay: float = 0.9999
    precision: str = "auto"
    n_obs_steps: int | None = None
    horizon: int | None = None
    n_action_steps: int | None = None
    prediction_type: str | None = None
    cloud_frame: str | None = None
    cloud_scale: float | None = None
    points: int | None = None
    acting_points: str | None = None
    training_points: str | None = None
    min_state_range: float | None = None
    down_dims: tuple[int, ...] | None = None

    @classmethod
    def of(cls, method: str, preset: TeacherPreset) -> TrainFlags:
        """Return the options whose values are what a training with `preset` uses."""
        return cls(**_own_fields(preset), **flag_values(method, preset))

    def preset(self, default: TrainFlags, start: TeacherPreset) -> TeacherPreset:
        """Return `start` with what these options say, the keys among them where they differ from `default`."""
        changes: Nested = {}
        for flag, path in FLAGS.items():
            if (value := getattr(self, flag)) != getattr(default, flag):
                changes = merged(changes, at(path, value))
        own = {k: v for k in _own_fields(start) if (v := getattr(self, k)) != getattr(default, k)}
        return replace(start, **own).with_changes(changes)


def _own_fields(preset: TeacherPreset) -> dict[str, Any]:
    return {k: v for k, v in asdict(preset).items() if k not in ("size", "changes")}


def train_command(arguments: Sequence[str]) -> Callable[..., None]:
    """Return the command `train` with the method, preset and file that `arguments` name."""
    method = next((word for word in arguments if word in METHODS.names()), DEFAULT_METHOD)
    start = preset_for(method, _asked(arguments, "--preset") or DEFAULT_PRESET)
    if (file := _asked(arguments, "--config")) is not None:
        start = start.with_changes(read_yaml(Path(file)))
    default = TrainFlags.of(method, start)

    def train(
        policy: tyro.conf.Positional[str],
        data: tuple[Path, ...],
        out: Path,
        options: Annotated[TrainFlags, tyro.conf.arg(name="")] = default,
        preset: str = DEFAULT_PRESET,
        config: Path | None = None,
        set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
        device: str = "auto",
        seed: Seed = 0,
    ) -> None:
        """Train a policy on demonstrations; the same command goes on after Ctrl-C or a kill.

        Args:
            policy: a method; `manicm-ms list policies` shows them.
            data: store of demonstrations; several of the same task are read as one.
            out: checkpoint folder to write; state and logs go beside it, to OUT.train.
            options: the preset's fields, each of which can be overridden.
            preset: size, steps and optimiser to start from; `manicm-ms list presets` shows them.
            config: YAML file with keys of the configuration, as a checkpoint's config.json has them.
            set: a key of the configuration, as in head.num_inference_steps=4 or backbone.down_dims=64,128; may be
                repeated.
            device: torch device; auto takes an accelerator where there is one.
            seed: of weights, batches and noise.
        """
        from manicm_ms.training.demonstrations import store_paths
        from manicm_ms.training.train import objective_of
        from manicm_ms.training.train import train as train_policy

        objective_of(policy)
        chosen = options.preset(default, start).with_changes(parse_overrides(set))
        for store in store_paths(data):
            _check_points(policy, chosen, start, store)
        train_policy(policy, data, out, chosen, device=device, seed=seed, command=this_command())

    return train


def distill_command(arguments: Sequence[str]) -> Callable[..., None]:
    """Return the command `distill` with the preset and file that `arguments` name."""
    default = STUDENT_PRESETS.get(_asked(arguments, "--preset") or DEFAULT_PRESET)
    if (file := _asked(arguments, "--config")) is not None:
        default = default.with_changes(read_yaml(Path(file)))

    def distill(
        teacher: Path,
        data: tuple[Path, ...],
        out: Path,
        options: Annotated[StudentPreset, tyro.conf.arg(name="")] = default,
        preset: str = DEFAULT_PRESET,
        config: Path | None = None,
        set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
        device: str = "auto",
        seed: Seed = 0,
        allow_other_task: bool = False,
    ) -> None:
        """Distil a teacher into a one-step ManiCM student; the same command goes on after Ctrl-C or a kill.

        Args:
            teacher: checkpoint folder of the teacher.
            data: the store, or stores, that the teacher was trained on.
            out: checkpoint folder to write; state and logs go beside it, to OUT.train.
            options: the preset's fields, each of which can be overridden.
            preset: steps and optimiser to start from; `manicm-ms list presets` shows them.
            config: YAML file with the section training: fields of the preset.
            set: a field of the preset, as in training.nfe=4; may be repeated.
            device: torch device; auto takes an accelerator where there is one.
            seed: of batches and noise.
            allow_other_task: take demonstrations of another task than the teacher's, which is refused otherwise.
        """
        from manicm_ms.training.distill import distill as distill_student

        distill_student(
            teacher, data, out, options.with_changes(parse_overrides(set)), device=device, seed=seed,
            allow_other_task=allow_other_task, command=this_command(),
        )  # fmt: skip

    return distill


def present_flags(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with options that have another name now under that one, each said in a line."""
    found = []
    for word in arguments:
        name, equals, value = word.partition("=")
        if name in _FORMER_FLAGS:
            warnings.warn(
                f"{name} is {_FORMER_FLAGS[name]} now; the former name goes with the next release", ManicmWarning,
                stacklevel=2,
            )  # fmt: skip
            word = f"{_FORMER_FLAGS[name]}{equals}{value}"
        found.append(word)
    return found


def _check_points(method: str, chosen: TeacherPreset, start: TeacherPreset, data: Path) -> None:
    """Raise ConfigError where more points are asked for than the clouds of the store have.

    A preset's own number is no such request: of smaller clouds all points are read, which a warning says.
    """
    from manicm_ms.demos.store import DemoStore

    asked, own = (_points(preset.configuration(method)) for preset in (chosen, start))
    with DemoStore.open(data) as store:
        stored = store.spec.obs.num_points
    if asked is None or asked <= stored:
        return
    if asked != own:
        raise ConfigError(
            f"--points {asked} exceeds the {stored} points of each cloud in {data}: give {stored} or less"
        )
    warnings.warn(
        f"the clouds in {data} have {stored} points: all are read, where the preset names {asked}",
        ManicmWarning,
        stacklevel=2,
    )


def _points(config: Mapping[str, Any]) -> int | None:
    return lookup_or_none(config, FLAGS["points"])


def _asked(arguments: Sequence[str], option: str) -> str | None:
    """Return the value of an option that must be known before parsing, because the defaults depend on it."""
    for k, word in enumerate(arguments):
        if word == option and k + 1 < len(arguments):
            return arguments[k + 1]
        if word.startswith(f"{option}="):
            return word.removeprefix(f"{option}=")
    return None
