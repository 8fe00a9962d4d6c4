"""The jobs of a benchmark: collect, train, evaluate. Each resumes, runs once, and leaves one result file when done.

::

    out/benchmark.json                                   what all results here depend on
    out/metaworld/reach/collect.json
    out/metaworld/reach/seed0/simple_dp3/checkpoint/     and checkpoint.train/
    out/metaworld/reach/seed0/simple_dp3/train.json
    out/metaworld/reach/seed0/simple_dp3/judge.json      episodes on held-out seeds, evaluations during training
    out/metaworld/reach/seed0/simple_dp3/judge.lock      held by the process that works on it
    out/metaworld/reach/seed0/simple_dp3/judge.failed.json   only where it failed; the next run tries again
"""

from __future__ import annotations

import json
import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from manicm_ms.benchmark.methods import Method, Training
from manicm_ms.benchmark.plan import Plan
from manicm_ms.demos.collect import collect
from manicm_ms.demos.layout import OPTIONAL_FIELDS, store_path
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.env_request import EnvRequest
from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.machine import machine
from manicm_ms.evaluation.play import env_maker
from manicm_ms.evaluation.policies import checkpoint_digest
from manicm_ms.evaluation.protocol import CLEAN
from manicm_ms.evaluation.records import EpisodeLog
from manicm_ms.evaluation.rollout import EpisodeResult, RestartableEnv, rollout
from manicm_ms.machine.devices import torch_threads
from manicm_ms.paths import write_json
from manicm_ms.policies.checkpoint import read_manifest
from manicm_ms.training.run_folder import snapshot_folders


@dataclass(frozen=True)
class Job(ABC):
    """A piece of work with a name, whose result is one JSON file."""

    plan: Plan

    @property
    @abstractmethod
    def stem(self) -> Path:
        """Path of its files, without their endings."""

    @property
    @abstractmethod
    def needs(self) -> tuple[Job, ...]:
        """Jobs that must be done before."""

    @abstractmethod
    def work(self, console: Console) -> dict[str, Any]:
        """Do what is not yet done, and return the result, JSON values."""

    @property
    def name(self) -> str:
        """Its place in the grid, for people and as a key."""
        return self.stem.relative_to(self.plan.out).as_posix()

    @property
    def result_file(self) -> Path:
        """Exists once the job is done."""
        return self.stem.with_suffix(".json")

    @property
    def failure_file(self) -> Path:
        """Exists where the last try failed."""
        return self.stem.with_suffix(".failed.json")

    @property
    def begun_file(self) -> Path:
        """Exists while a process works on it, and after one died at it: how many have begun since an orderly end."""
        return self.stem.with_suffix(".begun.json")

    @property
    def lock_file(self) -> Path:
        """Locked by the process that works on it."""
        return self.stem.with_suffix(".lock")

    def is_done(self) -> bool:
        """Return whether its result is there."""
        return self.result_file.is_file()

    def result(self) -> dict[str, Any]:
        """Return the result of a job that is done."""
        found: dict[str, Any] = json.loads(self.result_file.read_text(encoding="utf-8"))
        return found

    def complete(self, console: Console, place: str) -> None:
        """Do the work and write the result; after this returns the job is done.

        Args:
            console: where progress goes.
            place: who does it, for the record.
        """
        began = time.perf_counter()
        result = self.work(console)
        seconds = round(time.perf_counter() - began, 1)
        write_json(self.result_file, {"job": self.name, "place": place, "seconds": seconds, **result})
        self.failure_file.unlink(missing_ok=True)


@dataclass(frozen=True)
class CollectJob(Job):
    """Collects the demonstrations of a task, where the store does not hold enough."""

    env_id: str

    @property
    def stem(self) -> Path:
        """See `Job.stem`."""
        return self.plan.folder(self.env_id) / "collect"

    @property
    def needs(self) -> tuple[Job, ...]:
        """None."""
        return ()

    def work(self, console: Console) -> dict[str, Any]:
        """See `Job.work`."""
        plan = self.plan
        path = store_path(plan.data, self.env_id)
        done = collect(
            self.env_id, plan.demos, path, num_envs=plan.num_envs, seed=plan.demo_seed, colors=plan.colors,
            obs_preset=plan.obs_preset, console=console, **self._extras(path),
        )  # fmt: skip
        with DemoStore.open(path) as store:
            _require_demos(store, plan)
            plan.require_unseen(store.seeds.tolist())
            return {"attempts": done.attempts, "episodes": done.episodes, "mean_length": float(store.lengths.mean())}

    def _extras(self, path: Path) -> dict[str, Any]:
        """Return what `collect` is asked for so that the methods find what they read; a store may hold more."""
        needed = self.plan.extras(EnvRequest(self.env_id).entry.spec)
        if not path.is_dir() or not any(path.iterdir()):
            return {"extras": needed}
        with DemoStore.open(path) as store:
            has = tuple(field for field in OPTIONAL_FIELDS if field in store.fields)
            size = {"voxel_size": store.spec.obs.voxel_size} if "voxel_grid" in has else {}
        return {"extras": has, **size} if set(needed) <= set(has) else {"extras": needed}


@dataclass(frozen=True)
class TrainJob(Job):
    """Trains or distils one method with one seed."""

    env_id: str
    seed: int
    method: Method

    @property
    def stem(self) -> Path:
        """See `Job.stem`."""
        return self.plan.folder(self.env_id, self.seed, self.method) / "train"

    @property
    def needs(self) -> tuple[Job, ...]:
        """The demonstrations, and the checkpoint that it is made from."""
        source = self.method.made_from
        collected = CollectJob(self.plan, self.env_id)
        return (collected, *([] if source is None else [TrainJob(self.plan, self.env_id, self.seed, source)]))

    def work(self, console: Console) -> dict[str, Any]:
        """See `Job.work`."""
        plan, source = self.plan, self.method.made_from
        with DemoStore.open(store_path(plan.data, self.env_id)) as store:
            _require_demos(store, plan)  # again: another command may have extended it since
        checkpoint = plan.checkpoint(self.env_id, self.seed, self.method)
        training = Training(
            store_path(plan.data, self.env_id), plan.preset, self.seed, plan.device, plan.evaluations, console,
            command=f"manicm-ms benchmark, job {self.name}",
        )  # fmt: skip
        made_from = None if source is None else plan.checkpoint(self.env_id, self.seed, source)
        self.method.train(checkpoint, made_from, training)
        made = read_manifest(checkpoint)["provenance"]
        return {name: made[name] for name in ("steps", "final_loss", "precision")} | {
            "training_seconds": made["seconds"]
        }


@dataclass(frozen=True)
class EvaluateJob(Job):
    """Plays one method with one seed: the held-out seeds, and the evaluations during its training."""

    env_id: str
    seed: int
    method: Method

    @property
    def stem(self) -> Path:
        """See `Job.stem`."""
        return self.plan.folder(self.env_id, self.seed, self.method) / "judge"

    @property
    def needs(self) -> tuple[Job, ...]:
        """The checkpoint that it plays with."""
        return (TrainJob(self.plan, self.env_id, self.seed, self.method.owner),)

    def work(self, console: Console) -> dict[str, Any]:
        """See `Job.work`."""
        plan, checkpoint = self.plan, self.plan.checkpoint(self.env_id, self.seed, self.method)
        policy = self.method.load(checkpoint, plan.device)
        envs = env_maker(EnvRequest(env_id=self.env_id, obs_preset=plan.obs_preset))
        with closing(RestartableEnv(lambda: envs.for_policy(policy, plan.num_envs, CLEAN))) as env:
            fresh = self._play("fresh", checkpoint, policy, plan.fresh_seeds, env, console)
            evaluations = self._evaluate_snapshots(checkpoint, env, console)
        return {
            "nfe": policy.nfe,
            "parameters": sum(p.numel() for p in policy.parameters()),
            "checkpoint_sha256": checkpoint_digest(str(checkpoint)),
            "machine": machine(),
            "episodes": [e.summary() for e in fresh],
            "evaluations": evaluations,
        }

    def complete(self, console: Console, place: str) -> None:
        """Do the work and write the result; then remove the snapshots that it was the only one to need."""
        super().complete(console, place)
        if self.method.trains:
            checkpoint = self.plan.checkpoint(self.env_id, self.seed, self.method)
            for folder in snapshot_folders(checkpoint).values():
                shutil.rmtree(folder, ignore_errors=True)

    def _evaluate_snapshots(self, checkpoint: Path, env: RestartableEnv, console: Console) -> list[dict[str, Any]]:
        if not self.method.trains or not self.plan.evaluations:
            return []
        folders = snapshot_folders(checkpoint)
        if len(folders) != self.plan.evaluations:
            raise ConfigError(
                f"{checkpoint} kept {len(folders)} checkpoints on the way and {self.plan.evaluations} are to be "
                f"evaluated: delete the folder {self.stem.parent} and it is trained again, or choose another --out"
            )
        results = []
        for number, (step, folder) in enumerate(folders.items()):
            policy = self.method.load(folder, self.plan.device)
            seeds = self.plan.evaluation_seeds(number)
            episodes = self._play(f"step{step:08d}", folder, policy, seeds, env, console)
            won = sum(e.success for e in episodes)
            results.append({"step": step, "n": len(episodes), "successes": won})
        return results

    def _play(
        self, title: str, checkpoint: Path, policy: Any, seeds: Sequence[int], env: RestartableEnv, console: Console
    ) -> list[EpisodeResult]:
        """Play the seeds that are not on disk yet; return all results in their order.

        What is on disk counts for these very weights only: its file is named after them.
        """
        weights = checkpoint_digest(str(checkpoint))[:12]
        with EpisodeLog(self.stem.parent / "episodes" / f"{title}-{weights}.jsonl") as log:
            missing = [s for s in seeds if s not in log]
            with torch_threads(1):
                rollout(env, policy, missing, on_episode=log.append, to_the_end=self.plan.to_the_end)
            results = [log[s] for s in seeds]
        console.print(f"{self.name} {title}: {sum(e.success for e in results)} of {len(results)}", highlight=False)
        return results


def _require_demos(store: DemoStore, plan: Plan) -> None:
    """Raise ConfigError unless the store holds exactly the demonstrations that are to be learnt from."""
    if len(store) != plan.demos:
        raise ConfigError(
            f"{store.path} holds {len(store)} demonstrations and {plan.demos} are to be learnt from: "
            "name another --data"
        )


def all_jobs(plan: Plan) -> tuple[Job, ...]:
    """Return every job of the grid, each after those that it needs, and nearer to a finished task first."""
    found: dict[str, Job] = {}

    def add(job: Job) -> None:
        for need in job.needs:
            add(need)
        found.setdefault(job.name, job)

    for seed in plan.seeds:
        for env_id in plan.env_ids:
            for method in plan.parsed_methods:
                add(EvaluateJob(plan, env_id, seed, method))
    return tuple(found.values())
