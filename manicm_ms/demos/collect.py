"""Collecting: an expert plays seeds in parallel and the episodes it solves are kept, in the order of their seeds.

What is kept depends on the environment, the expert and the first seed alone: seeds are tried in
order, an episode is kept where its own seed was solved, and episodes are committed in the order of
their seeds, so neither the number of environments nor an interruption changes the data.
"""

from __future__ import annotations

import reprlib
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from manicm_ms.demos.experts import EXPERTS, Expert
from manicm_ms.demos.store import OPTIONAL_FIELDS, DemoStore, Episode, frame_shapes
from manicm_ms.envs.simulator import ENVS, DemoRule
from manicm_ms.envs.vec_env import VecEnv, make_vec
from manicm_ms.errors import ConfigError, ManicmError, OutputExistsError, StoreError
from manicm_ms.paths import require_free_space
from manicm_ms.progress import progress_bars
from manicm_ms.provenance import package_versions
from manicm_ms.seeds import require_seed
from manicm_ms.sensing.camera_model import CameraModel, read_camera
from manicm_ms.sensing.realism import Realism, RealismSample, realism_name, resolve_realism
from manicm_ms.spec import ACTION, AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE, EnvSpec

_OBS_OF_FIELD = {
    "point_cloud": POINT_CLOUD,
    "agent_pos": AGENT_POS,
    "image": IMAGE,
    "depth": DEPTH,
    "privileged_state": STATE,
}
# Beyond these failures an expert is broken, not unlucky.
_FAILURES_PER_EPISODE, _FAILURES_FREE = 10, 50
_IDENTITY = (
    "env_id", "seed", "expert", "style", "tail_steps", "fields", "point_channels", "backend", "realism",
    "realism_ranges", "camera", "success_steps", "obs_preset",
)  # fmt: skip
_UNRECORDED: Mapping[str, Any] = {
    "realism": "clean", "realism_ranges": None, "camera": None, "success_steps": 1, "obs_preset": "manicm_ms",
}  # fmt: skip
"""What stores mean that were made before they recorded it."""
_BRIEF = reprlib.Repr()
_BRIEF.maxstring = 100  # names stay whole, a camera's matrix does not


@dataclass(frozen=True)
class Attempt:
    """One seed that was played to its end.

    Attributes:
        seed: seed of the environment's reset.
        episode: the demonstration, or None where the task was not solved.
        reason: why there is none, in a few words; empty where there is one.
    """

    seed: int
    episode: Episode | None
    reason: str = ""


@dataclass
class _Row:
    """What one row of the environment is playing."""

    seed: int
    frames: dict[str, list[np.ndarray]] = field(default_factory=dict)
    solved_at: int | None = None  # steps played when success was first reported
    success_steps: int = 0


class Collector:
    """Plays seed after seed with an expert on all rows of a vector environment.

    Args:
        env: vector environment whose observations hold `point_cloud`, `agent_pos`, `state` and
            what `extras` needs; finished rows stay as they are until they are reset.
        expert: plays all rows from `state`.
        rule: which episodes are kept, and where they are cut if the task goes on after its success.
        extras: optional fields of `Episode` to record, from `OPTIONAL_FIELDS`.
        conditions: returns what is drawn for the episode of a seed beside its scene, to be recorded with it.
    """

    def __init__(
        self,
        env: VecEnv,
        expert: Expert,
        *,
        rule: DemoRule = DemoRule(),  # noqa: B008 (it is frozen)
        extras: Iterable[str] = (),
        conditions: Callable[[int], RealismSample] = lambda seed: {},
    ) -> None:
        if rule.tail_steps < 0:
            raise ConfigError(f"tail_steps must not be negative, got {rule.tail_steps}")
        self.env, self.expert, self.rule, self.conditions = env, expert, rule, conditions
        self.spec = env.env_spec
        self.fields = ("point_cloud", "agent_pos", *extras)
        self._obs: Mapping[str, Any] = {}
        self._rows: list[_Row | None] = [None] * env.num_envs
        self._seeds = [0] * env.num_envs
        self._next_seed = 0
        self._begun: int | None = None  # first seed of a `begin` that no attempts followed yet

    def begin(self, first_seed: int) -> None:
        """Reset all rows to first_seed, first_seed + 1, ..., which shows whether the simulator runs at all.

        `attempts` from the same seed goes on from here, and does this itself where it was not done.
        """
        self._next_seed = self._begun = first_seed
        self._start(np.ones(self.env.num_envs, bool))

    def attempts(self, first_seed: int, wanted: int) -> Iterator[Attempt]:
        """Yield the attempts at first_seed, first_seed + 1, ... in this order, until `wanted` are solved."""
        done: dict[int, Attempt] = {}
        if self._begun != first_seed:
            self.begin(first_seed)
        self._begun, turn = None, first_seed
        while wanted > 0:
            for attempt in self._step():
                done[attempt.seed] = attempt
            while wanted > 0 and turn in done:
                attempt = done.pop(turn)
                turn += 1
                wanted -= attempt.episode is not None
                yield attempt
            hopes = sum(a.episode is not None for a in done.values()) + sum(r is not None for r in self._rows)
            self._start(self._idle_rows(wanted - hopes))

    def _idle_rows(self, count: int) -> np.ndarray:
        """Return a mask (N,) of the first `count` rows that play nothing.

        A row is left idle where those at work suffice if they succeed: it would only slow them.
        """
        mask = np.zeros(len(self._rows), bool)
        idle = [i for i, row in enumerate(self._rows) if row is None]
        mask[idle[: max(count, 0)]] = True
        return mask

    def _start(self, mask: np.ndarray) -> None:
        """Begin the next seeds in the rows of `mask` (N,) bool."""
        if not mask.any():
            return
        for i in np.flatnonzero(mask):
            self._seeds[i] = self._next_seed
            self._rows[i] = _Row(self._next_seed)
            self._next_seed += 1
        self._obs, _ = self.env.reset(seed=list(self._seeds), options={"reset_mask": mask})
        state = self._obs[STATE]
        self.expert.reset(state, list(self._seeds), torch.as_tensor(mask, device=state.device))

    def _step(self) -> list[Attempt]:
        """Play one control step in all rows; return the attempts that ended with it."""
        actions = self.expert.act(self._obs[STATE]).clamp(-1.0, 1.0)
        self._record(actions)
        self._obs, _, terminated, truncated, info = self.env.step(actions)
        over, success = _numpy(terminated) | _numpy(truncated), _numpy(info["success"])
        errors = info.get("error", [None] * len(self._rows))
        counted = info.get("success_steps")  # where an environment step is shorter than a control step
        ended = []
        for i, row in enumerate(self._rows):
            if row is None:
                continue
            steps = len(row.frames[ACTION])
            if success[i] and row.solved_at is None:
                row.solved_at = steps
            row.success_steps = row.success_steps + bool(success[i]) if counted is None else int(counted[i])
            if over[i] or self._tail_played(row, steps) or errors[i] or steps >= self.spec.max_episode_steps:
                ended.append(self._finish(row, bool(success[i]), errors[i]))
                self._rows[i] = None
        return ended

    def _tail_played(self, row: _Row, steps: int) -> bool:
        """Return whether a row has shown all that is kept; one that lacks successful steps may still get them."""
        if row.solved_at is None or row.success_steps < self.rule.success_steps:
            return False
        return steps - row.solved_at >= self.rule.tail_steps

    def _record(self, actions: torch.Tensor) -> None:
        """Keep what each playing row sees and does."""
        frame = {name: _numpy(self._obs[_OBS_OF_FIELD[name]]) for name in self.fields}
        frame[ACTION] = _numpy(actions)
        for i, row in enumerate(self._rows):
            if row is not None:
                for name, values in frame.items():
                    # A copy: the environment may write its next observation into the same memory.
                    row.frames.setdefault(name, []).append(values[i].copy())

    def _finish(self, row: _Row, success_now: bool, error: str | None) -> Attempt:
        solved = success_now if self.spec.success_rule == "last" else row.solved_at is not None
        if error:
            return Attempt(row.seed, None, f"the episode crashed: {error}")
        if not solved:
            return Attempt(row.seed, None, f"not solved in {len(row.frames[ACTION])} steps")
        if row.success_steps < self.rule.success_steps:
            few = f"{row.success_steps} successful steps, of which {self.rule.success_steps} are wanted"
            return Attempt(row.seed, None, few)
        arrays = {name: np.stack(values) for name, values in row.frames.items()}
        if bad := [name for name, a in arrays.items() if a.dtype.kind == "f" and not np.isfinite(a).all()]:
            return Attempt(row.seed, None, f"NaN or infinity in {', '.join(bad)}")
        drawn = self.conditions(row.seed)
        return Attempt(row.seed, Episode(**arrays, seed=row.seed, success=True, realism=drawn))


@dataclass(frozen=True)
class Collected:
    """What a collection came to.

    Attributes:
        path: the store.
        episodes: episodes in it.
        attempts: seeds tried for them, those of earlier runs of the same command included.
        added: episodes that this run added.
    """

    path: Path
    episodes: int
    attempts: int
    added: int


@dataclass(frozen=True)
class _Plan:
    """What a collection asks for, whether into a store or into memory; see `collect`.

    Raises ConfigError where a number is out of range or an extra is not known, UnknownNameError for the id.
    """

    env_id: str
    num_envs: int
    seed: int
    style: str | None
    backend: str
    colors: bool
    extras: tuple[str, ...]
    tail_steps: int | None
    realism: Realism
    camera: CameraModel | None
    obs_preset: str

    def __post_init__(self) -> None:
        if self.num_envs < 1:
            raise ConfigError(f"num_envs must be at least 1, got {self.num_envs}")
        require_seed(self.seed)
        if unknown := set(self.extras) - set(OPTIONAL_FIELDS):
            raise ConfigError(f"extras {sorted(unknown)} are not known: choose from {', '.join(OPTIONAL_FIELDS)}")
        ENVS.get(self.env_id)  # knows former names too
        EXPERTS.get(self.env_id)

    @property
    def rule(self) -> DemoRule:
        """The task's own rule, with the tail that was asked for instead of its own."""
        own = ENVS.get(self.env_id).demos
        return own if self.tail_steps is None else replace(own, tail_steps=self.tail_steps)

    def asked(self) -> dict[str, Any]:
        """Return what is known of `_IDENTITY` before the environment and the expert are made."""
        return {
            "env_id": self.env_id,
            "seed": self.seed,
            "tail_steps": self.rule.tail_steps,
            "success_steps": self.rule.success_steps,
            "obs_preset": self.obs_preset,
            "fields": ["point_cloud", "agent_pos", ACTION, *(f for f in OPTIONAL_FIELDS if f in self.extras)],
            "point_channels": 6 if self.colors else 3,
            "realism": realism_name(self.realism),
            "realism_ranges": None if self.realism.is_clean else self.realism.to_dict(),
            "camera": None if self.camera is None else self.camera.to_dict(),
        }

    @contextmanager
    def collector(self) -> Iterator[Collector]:
        """Make environment and expert; yield what plays, and close the environment after it."""
        keys = dict.fromkeys([POINT_CLOUD, AGENT_POS, STATE, *(_OBS_OF_FIELD[f] for f in self.extras)])
        env = make_vec(
            self.env_id, num_envs=self.num_envs, backend=self.backend, obs=tuple(keys), colors=self.colors,
            realism=self.realism, camera=self.camera, obs_preset=self.obs_preset,
        )  # fmt: skip
        try:
            expert = EXPERTS.get(self.env_id)(env.env_spec, self.num_envs, env.device, self.style)
            conditions = partial(ENVS.get(self.env_id).conditions, self.realism)
            yield Collector(env, expert, rule=self.rule, extras=self.extras, conditions=conditions)
        finally:
            env.close()


def collect(
    env_id: str,
    episodes: int,
    out: Path,
    *,
    num_envs: int = 1,
    seed: int = 0,
    style: str | None = None,
    backend: str = "auto",
    colors: bool = False,
    extras: Iterable[str] = (),
    tail_steps: int | None = None,
    realism: str | Realism = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
    console: Console | None = None,
) -> Collected:
    """Collect demonstrations of the registered expert of `env_id` into a store, with a progress bar.

    A store that this call began earlier, and did not finish, is continued; one with enough episodes
    is left as it is; one with fewer is extended.

    Args:
        env_id: for example "ur3e/slide-block".
        episodes: solved episodes that the store is to hold.
        out: the store, made if need be.
        num_envs: environments that play at once; the data does not depend on it.
        seed: seeds tried are seed, seed + 1, ...
        style: the expert's style, its default one if None.
        backend: "cpu", "gpu" or "auto", as in `make_vec`.
        colors: store rgb beside xyz.
        extras: optional fields of `Episode` to store, from `OPTIONAL_FIELDS`.
        tail_steps: control steps kept after the first success where the task goes on after it; None: the task's own.
        realism: preset or ranges, as in `make_vec`; what it draws is stored with every episode.
        camera: YAML file of the cell's depth camera, as in `make_vec`.
        obs_preset: as in `make_vec`.
        console: where progress is shown; standard output by default.

    Raises StoreError where `out` holds other data or has a writer already, NoSpaceError, CameraError,
    UnknownNameError for the id, the style or the preset, ManicmError where the expert fails far too often.
    """
    model = None if camera is None else read_camera(camera)
    plan = _Plan(
        env_id, num_envs, seed, style, backend, colors, tuple(extras), tail_steps, resolve_realism(realism), model,
        obs_preset,
    )  # fmt: skip
    _require_some(episodes)
    out = Path(out)
    if out.is_file():
        raise OutputExistsError(f"{out} is a file: choose a folder for --out")
    exists = out.exists() and not (out.is_dir() and not any(out.iterdir()))
    if exists and (finished := _finished(out, episodes, plan)):
        return finished
    with ExitStack() as stack:
        # The lock is taken before the environment is made, so that a second writer is refused at once.
        store = stack.enter_context(DemoStore.open(out, "a")) if exists else None
        collector = stack.enter_context(plan.collector())
        expert, env = collector.expert, collector.env
        asked = plan.asked() | {"expert": expert.name, "style": expert.style, "backend": env.backend}
        command = _command(asked, episodes, plan.extras, colors, camera)
        if store is None:
            collector.begin(seed)  # a simulator that does not run leaves no empty store behind
            provenance = asked | {"command": command, "versions": package_versions()}
            store = stack.enter_context(_create(out, env.env_spec, provenance, episodes, collector.conditions(seed)))
        _require_same_origin(store, asked, env.env_spec)
        with _progress_bar(env_id, episodes, len(store), console) as report:
            added = fill(store, collector, episodes, seed, report)
        store.note(command=command)
        return Collected(out, len(store), store.attempts, added)


def collect_episodes(
    env_id: str,
    episodes: int,
    *,
    num_envs: int = 1,
    seed: int = 0,
    style: str | None = None,
    backend: str = "auto",
    colors: bool = False,
    extras: Iterable[str] = (),
    tail_steps: int | None = None,
    realism: str | Realism = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
) -> list[Episode]:
    """Collect demonstrations into memory: the episodes that `collect` stores for the same arguments.

    Raises ConfigError, UnknownNameError, ManicmError as `collect`. An interruption loses them: for many, use `collect`.
    """
    model = None if camera is None else read_camera(camera)
    plan = _Plan(
        env_id, num_envs, seed, style, backend, colors, tuple(extras), tail_steps, resolve_realism(realism), model,
        obs_preset,
    )  # fmt: skip
    _require_some(episodes)
    kept: list[Episode] = []
    with plan.collector() as collector, _progress_bar(env_id, episodes, 0) as report:
        for tried, attempt in enumerate(collector.attempts(seed, episodes), start=1):
            if attempt.episode is not None:
                kept.append(attempt.episode)
            report(len(kept), tried)
            _require_hope(attempt, len(kept), tried, episodes, " are dropped")
    return kept


def fill(
    store: DemoStore,
    collector: Collector,
    episodes: int,
    first_seed: int,
    report: Callable[[int, int], None] = lambda kept, attempts: None,
) -> int:
    """Append solved episodes to `store` until it holds `episodes`; return how many were added.

    Args:
        store: open for appending; what it holds must come from the same seeds and expert.
        collector: plays the seeds that are still to be tried.
        episodes: number of episodes that the store is to hold.
        first_seed: seed of the very first attempt.
        report: called with (episodes kept, attempts) after each attempt.

    Raises ManicmError where far more attempts fail than a working expert's would.
    """
    kept = before = len(store)
    tried = attempts_so_far(store, first_seed)
    if kept >= episodes:
        return 0
    for attempt in collector.attempts(first_seed + tried, episodes - kept):
        tried += 1
        if attempt.episode is not None:
            store.append(attempt.episode)
            kept += 1
        # After the commit, so that a kill between the two can only make this number too small.
        store.note(attempts=tried)
        report(kept, tried)
        _require_hope(attempt, kept, tried, episodes, f" are kept in {store.path}")
    return kept - before


def _require_hope(attempt: Attempt, kept: int, tried: int, wanted: int, fate: str) -> None:
    """Raise ManicmError where far more attempts failed than a working expert's would; `fate` of the solved ones."""
    if tried - kept > _FAILURES_PER_EPISODE * wanted + _FAILURES_FREE:
        raise ManicmError(
            f"{tried - kept} of {tried} attempts failed (seed {attempt.seed}: {attempt.reason}): gave up; the "
            f"{kept} solved episodes{fate}. Try another style or mend the expert of the task"
        )


def _require_some(episodes: int) -> None:
    """Raise ConfigError where no episode is asked for."""
    if episodes < 1:
        raise ConfigError(f"episodes must be at least 1, got {episodes}")


def attempts_so_far(store: DemoStore, first_seed: int) -> int:
    """Return how many seeds from `first_seed` on need not be tried again.

    The number noted in the store may lag behind its last episode by one, after a kill.
    """
    seeds = store.seeds
    last = int(seeds[-1]) - first_seed + 1 if len(seeds) else 0
    return max(store.attempts, last)


def _finished(out: Path, episodes: int, plan: _Plan) -> Collected | None:
    """Return what `out` holds where that is all that is asked for, without starting an environment.

    Raises StoreError where it is no store, or holds other data than is asked for.
    """
    asked = plan.asked()
    with DemoStore.open(out) as store:
        if store.provenance.get("env_id") == asked["env_id"]:  # else the expert would not fit the specs
            expert = EXPERTS.get(plan.env_id)(store.spec, 1, torch.device("cpu"), plan.style)
            asked |= {"expert": expert.name, "style": expert.style}
        if plan.backend != "auto":
            asked |= {"backend": plan.backend}
        _require_same_origin(store, asked)
        if len(store) < episodes:
            return None
        kept, tried = len(store), attempts_so_far(store, asked["seed"])
        noted = store.attempts
    if noted < tried:  # the run that committed the last episode was killed before it noted the attempt
        with DemoStore.open(out, "a") as store:
            store.note(attempts=tried)
    return Collected(out, kept, tried, 0)


def _create(out: Path, spec: EnvSpec, provenance: Mapping[str, Any], episodes: int, drawn: Iterable[str]) -> DemoStore:
    shapes = frame_shapes(spec)
    frame_bytes = sum(int(np.prod(shapes[f][0])) * shapes[f][1].itemsize for f in provenance["fields"])
    # A solved episode takes about half the steps that it may take.
    require_free_space(out, frame_bytes * episodes * spec.max_episode_steps // 2)
    extras = [f for f in provenance["fields"] if f in OPTIONAL_FIELDS]
    return DemoStore.create(out, spec, provenance, extras=extras, realism=drawn)


def _require_same_origin(store: DemoStore, asked: Mapping[str, Any], spec: EnvSpec | None = None) -> None:
    """Raise StoreError where the store's data came about otherwise than is asked for now."""
    has = {**_UNRECORDED, **store.provenance}
    for key in _IDENTITY:
        if key in asked and has.get(key) != asked[key]:
            key, theirs, ours = _first_difference(key, has.get(key), asked[key])
            raise StoreError(
                f"{store.path} holds demonstrations with {key} {_BRIEF.repr(theirs)} where {_BRIEF.repr(ours)} is "
                "asked for: choose another --out, or the same options as before to go on"
            )
    if spec is not None and store.spec != spec:
        raise StoreError(
            f"{store.path} was collected with other specs of {spec.env_id} than it has now: choose another --out"
        )


def _first_difference(name: str, theirs: Any, ours: Any) -> tuple[str, Any, Any]:
    """Return name and both values of the first entry that differs, within mappings as that of a camera."""
    if not (isinstance(theirs, Mapping) and isinstance(ours, Mapping)):
        return name, theirs, ours
    key = next(key for key in sorted({*theirs, *ours}) if theirs.get(key) != ours.get(key))
    return _first_difference(f"{name}.{key}", theirs.get(key), ours.get(key))


def _command(
    asked: Mapping[str, Any], episodes: int, extras: tuple[str, ...], colors: bool, camera: Path | None
) -> str:
    """Return the command that makes the same data (the number of environments has no part in it)."""
    words = ["manicm-ms", "collect", asked["env_id"], "--episodes", episodes, "--seed", asked["seed"]]
    words += ["--style", asked["style"], "--backend", asked["backend"]]
    tail = asked["tail_steps"]
    words += ["--tail-steps", tail] if tail != ENVS.get(asked["env_id"]).demos.tail_steps else []
    words += ["--colors"] if colors else []
    words += ["--obs-preset", asked["obs_preset"]] if asked["obs_preset"] != "manicm_ms" else []
    words += ["--realism", asked["realism"]] if asked["realism"] != "clean" else []
    words += ["--camera", camera] if camera is not None else []
    words += ["--extras", *extras] if extras else []
    return shlex.join(str(w) for w in words)


@contextmanager
def _progress_bar(
    env_id: str, episodes: int, kept: int, console: Console | None = None
) -> Iterator[Callable[[int, int], None]]:
    """Show the episodes kept and how many were tried for them; yield what reports both numbers."""
    with progress_bars(console or Console(), "kept{task.fields[tried]}") as shown:
        bar = shown.add_task(f"collect {env_id}", total=episodes, completed=kept, tried="")

        def report(kept: int, attempts: int) -> None:
            shown.update(bar, completed=kept, tried=f", {attempts} tried")

        yield report


def _numpy(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
