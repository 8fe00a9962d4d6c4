"""What a benchmark is asked to do, and where everything of it lies."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manicm_ms.benchmark.methods import DEFAULT_TEACHER, Method, parse_methods
from manicm_ms.demos.layout import OBS_OF_FIELD, OPTIONAL_FIELDS
from manicm_ms.errors import ConfigError
from manicm_ms.seeds import require_seed
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS
from manicm_ms.training.settings import preset_identity

if TYPE_CHECKING:
    from manicm_ms.envs.simulator import EnvEntry
    from manicm_ms.spec import EnvSpec

EVALUATION_SEEDS_BEYOND = 1_000_000
"""The evaluations during training play seeds this far beyond the first fresh one."""
HIGHEST = 5
"""Evaluations during training of which the paper reports the mean."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A grid of tasks, methods and training seeds. Plain values: it travels to other processes and machines as JSON.

    Attributes:
        env_ids: tasks.
        methods: names; see `parse_methods`.
        seeds: of the trainings.
        preset: of teacher and student.
        out: folder of all that is made.
        data: folder of the stores, SUITE/TASK.zarr; what is missing is collected.
        demos: demonstrations to learn from.
        demo_seed: first seed of the demonstrations.
        colors: with coloured clouds.
        obs_preset: as in `make_vec`.
        episodes: held-out seeds that each trained policy plays.
        eval_seed: the first of them.
        evaluations: evaluations during training, for the paper's mean of the five highest; 0 leaves it out.
        evaluation_episodes: episodes of each.
        num_envs: environments that play at once in a job.
        device: torch device of trainings and policies.
        to_the_end: play on after a success that is certain, so that success at the last step is known.
    """

    env_ids: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    preset: str
    out: Path
    data: Path
    demos: int = 10
    demo_seed: int = 0
    colors: bool = False
    obs_preset: str = "manicm_ms"
    episodes: int = 50
    eval_seed: int = 100_000
    evaluations: int = 0
    evaluation_episodes: int = 20
    num_envs: int = 2
    device: str = "cpu"
    to_the_end: bool = False

    def __post_init__(self) -> None:
        if not self.env_ids or not self.seeds:
            raise ConfigError("a benchmark needs at least one task and one seed")
        if len(set(self.seeds)) < len(self.seeds) or len(set(self.env_ids)) < len(self.env_ids):
            raise ConfigError("name each task and each seed once")
        for seed in (*self.seeds, self.demo_seed, self.eval_seed):
            require_seed(seed)
        if min(self.demos, self.episodes, self.evaluation_episodes, self.num_envs) < 1 or self.evaluations < 0:
            raise ConfigError(
                "demos, episodes, evaluation_episodes and num_envs must be at least 1, evaluations at least 0"
            )
        trained = [preset for method in self.parsed_methods if (preset := method.preset(self.preset)) is not None]
        presets = (TEACHER_PRESETS.get(self.preset), STUDENT_PRESETS.get(self.preset), *trained)
        steps = [preset.steps for preset in presets]
        most = min((s for s in steps if s is not None), default=self.evaluations)
        if self.evaluations and not HIGHEST <= self.evaluations <= most:
            raise ConfigError(
                f"evaluations must be 0, or from {HIGHEST} (of which the mean is taken) to {most} (steps of the preset "
                f"{self.preset}), got {self.evaluations}"
            )

    def require_unseen(self, demonstrated: Sequence[int]) -> None:
        """Raise ConfigError where a seed that a policy is to be evaluated on is among those of its demonstrations."""
        held_out = {s for seeds in self._held_out_seeds for s in seeds}
        if shared := held_out & set(demonstrated):
            raise ConfigError(
                f"seed {min(shared)} is that of a demonstration and would evaluate the policies as well: choose "
                "--eval-seed and --demo-seed apart"
            )

    def require_seeds_of(self, entry: EnvEntry) -> None:
        """Raise ConfigError where a seed that is to be played lies beyond those that the environment takes."""
        last = max(s for seeds in self._held_out_seeds for s in (seeds[0], seeds[-1]))
        if last >= entry.seed_limit:
            raise ConfigError(
                f"seeds of {entry.spec.env_id} end at {entry.seed_limit - 1}, and the fresh ones with those of the "
                f"evaluations run to {last}: choose a smaller --eval-seed"
            )

    @property
    def _held_out_seeds(self) -> list[range]:
        return [self.fresh_seeds, *(self.evaluation_seeds(k) for k in range(self.evaluations))]

    @property
    def parsed_methods(self) -> tuple[Method, ...]:
        """The methods themselves."""
        return parse_methods(self.methods)

    @property
    def fresh_seeds(self) -> range:
        """Seeds that every policy is evaluated on, never seen in training."""
        return range(self.eval_seed, self.eval_seed + self.episodes)

    def evaluation_seeds(self, number: int) -> range:
        """Return the seeds of evaluation `number` during training, counted from 0; no two evaluations share one."""
        first = self.eval_seed + EVALUATION_SEEDS_BEYOND + number * self.evaluation_episodes
        return range(first, first + self.evaluation_episodes)

    def extras(self, spec: EnvSpec) -> tuple[str, ...]:
        """Return the optional fields of demonstrations that the methods learn from in the environment of `spec`."""
        read = {key for method in self.parsed_methods for key in method.reads(self.preset, spec)}
        return tuple(field for field in OPTIONAL_FIELDS if OBS_OF_FIELD[field] in read)

    def folder(self, env_id: str, seed: int | None = None, method: Method | None = None) -> Path:
        """Return where what belongs to a task, one of its seeds, or one method with that seed lies."""
        parts = [env_id, *([] if seed is None else [f"seed{seed}"]), *([] if method is None else [method.folder])]
        return self.out.joinpath(*parts)

    def checkpoint(self, env_id: str, seed: int, method: Method) -> Path:
        """Return the checkpoint folder that a method plays with: its own, or that of what it is made from."""
        return self.folder(env_id, seed, method.owner) / "checkpoint"

    @property
    def identity(self) -> dict[str, Any]:
        """What the results depend on beside task, method and seed: one folder holds one of these."""
        recipes = {
            "teacher": preset_identity(TEACHER_PRESETS.get(self.preset), DEFAULT_TEACHER),
            "student": preset_identity(STUDENT_PRESETS.get(self.preset)),
        }
        named = ("preset", "demos", "demo_seed", "colors", "obs_preset", "episodes", "eval_seed", "evaluations",
                 "evaluation_episodes", "device")  # fmt: skip
        return {
            **{name: getattr(self, name) for name in named},
            **({"to_the_end": True} if self.to_the_end else {}),  # folders of earlier versions lack it
            "data": str(self.data.resolve()),
            "recipes": recipes,
        }

    def to_json(self) -> str:
        """Return all of it as text; `from_json` is its inverse."""
        return json.dumps(asdict(self) | {"out": str(self.out.resolve()), "data": str(self.data.resolve())})

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """Build a plan from what `to_json` returned."""
        values: Mapping[str, Any] = json.loads(text)
        lists = {k: tuple(v) for k, v in values.items() if isinstance(v, list)}
        return cls(**{**values, **lists, "out": Path(values["out"]), "data": Path(values["data"])})


def parse_envs(text: str) -> tuple[str, ...]:
    """Return the environments that a comma-separated list of ids and tags names, each once, in its order.

    Raises UnknownNameError for one that is neither.
    """
    from manicm_ms.envs.simulator import ENVS

    found: dict[str, None] = {}
    for word in filter(None, (w.strip() for w in text.split(","))):
        names = ENVS.names(word)
        if not names:
            ENVS.get(word)
            names = (word,)
        found.update(dict.fromkeys(names))
    return tuple(found)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the integers of a comma-separated list; raise ConfigError where it holds something else."""
    words = [w.strip() for w in text.split(",") if w.strip()]
    if not words or not all(w.isdecimal() for w in words):
        raise ConfigError(f"--seeds takes whole numbers separated by commas, as in 0,1,2; got {text!r}")
    return tuple(int(w) for w in words)


def split_names(text: str) -> Sequence[str]:
    """Return the names of a comma-separated list; commas within brackets belong to a name.

    Raises ConfigError where a bracket has no partner.
    """
    outside = re.sub(r"\[[^\[\]]*\]", "", text)
    if "[" in outside or "]" in outside:
        raise ConfigError(f"a bracket of {text!r} has no partner: write NAME[KEY=VALUE]")
    words = re.findall(r"(?:[^,\[\]]|\[[^\[\]]*\])+", text)
    return tuple(w.strip() for w in words if w.strip())
