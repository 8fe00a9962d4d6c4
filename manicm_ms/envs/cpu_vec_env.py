"""`CpuVecEnv`: rows in worker processes, one simulator each."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from manicm_ms.envs.main_script import NO_GUARD_STATUS, main_script, no_guard, require_importable_main
from manicm_ms.envs.requests import Seeds
from manicm_ms.envs.simulator import EnvEntry, SimulatorConfig
from manicm_ms.envs.vector import Info, Obs, VecEnv
from manicm_ms.envs.worker import FACTS, RowEnv, package_folders
from manicm_ms.envs.worker_pool import WorkerPool
from manicm_ms.errors import BackendError, ManicmError
from manicm_ms.spec import ChunkSpec, EnvSpec

_REAP_S = 0.2  # how long a worker's end may take to show after its pipe broke
_DEAD_WORKER = (EOFError, BrokenPipeError, ConnectionResetError)


class CpuVecEnv(VecEnv):
    """Rows in worker processes, one simulator each, observations through shared memory."""

    backend = "cpu"

    def __init__(
        self, entry: EnvEntry, spec: EnvSpec, num_envs: int, config: SimulatorConfig, chunk: ChunkSpec | None
    ) -> None:
        super().__init__(entry, spec, num_envs, config, chunk)
        self.device = torch.device("cpu")
        require_importable_main()
        make = functools.partial(RowEnv, spec.env_id, entry.module, config, chunk, package_folders(entry.module))
        try:
            self._workers = WorkerPool(make, num_envs, [__name__, entry.module, *entry.preload])
        except _DEAD_WORKER as error:
            raise BackendError(
                f"the worker processes of {spec.env_id} could not be started, the server that forks them has ended: "
                "run it again; 'manicm-ms doctor' tells whether the machine can simulate and render"
            ) from error
        self._facts: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._failure: str | None = None  # why no call can succeed any more

    def reset(self, *, seed: Seeds = None, options: dict[str, Any] | None = None) -> tuple[Obs, Info]:
        """See `VecEnv.reset`."""
        mask, seeds = self._begin(seed, options)
        obs, info = self._guarded(self._workers.reset, seed=seeds, options={"reset_mask": mask})
        self._every_row_started = True
        return self._tensors(obs), self._merged(info, mask)

    def step(self, actions: ArrayLike | Tensor) -> tuple[Obs, Tensor, Tensor, Tensor, Info]:
        """See `VecEnv.step`."""
        self._require_started("a step")
        checked = self._check_actions(actions).numpy()
        obs, reward, terminated, truncated, info = self._guarded(self._workers.step, checked)
        flags = torch.from_numpy(terminated.copy()), torch.from_numpy(truncated.copy())
        everyone = np.ones(self.num_envs, dtype=bool)
        return self._tensors(obs), torch.from_numpy(reward.astype(np.float32)), *flags, self._merged(info, everyone)

    def render_video_frames(self) -> Tensor:
        """See `VecEnv.render_video_frames`."""
        self._require_video()
        return torch.from_numpy(np.stack(self._guarded(self._workers.call, "render")))

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the worker processes."""
        broken = self._failure is not None or not all(process.is_alive() for process in self._workers.processes)
        self._workers.close(terminate=broken)

    def _guarded(self, call: Any, *args: Any, **kwargs: Any) -> Any:
        self._require_sound()
        try:
            with _quiet_gymnasium():
                return call(*args, **kwargs)
        except _DEAD_WORKER as error:
            if NO_GUARD_STATUS in self._exit_codes().values():
                self._failure = "worker processes could not import the script"
                raise no_guard(main_script()) from None
            self._failure = f"{self._dead_workers()} of {self.env_spec.env_id} died"
            raise self._backend_error() from error
        except Exception as error:  # a worker that raised has ended
            self._failure = f"a worker process of {self.env_spec.env_id} failed ({_last_line(error)})"
            if isinstance(error, ManicmError):
                raise
            raise self._backend_error() from error
        except BaseException:  # Ctrl-C: answers may be under way that nobody will read
            self._failure = f"a call of {self.env_spec.env_id} was interrupted"
            raise

    def _require_sound(self) -> None:
        if self._failure is not None:
            raise self._backend_error()

    def _backend_error(self) -> BackendError:
        return BackendError(
            f"{self._failure}: close this environment and make it anew; "
            "'manicm-ms doctor' tells whether the machine can simulate and render"
        )

    def _dead_workers(self) -> str:
        codes = self._exit_codes()
        return f"worker processes {list(codes)} (exit codes {list(codes.values())})"

    def _exit_codes(self) -> dict[int, int | None]:
        """Return row -> exit code of the workers that have ended."""
        for process in self._workers.processes:
            process.join(_REAP_S)
        return {k: process.exitcode for k, process in enumerate(self._workers.processes) if not process.is_alive()}

    def _tensors(self, obs: dict[str, np.ndarray]) -> Obs:
        return {key: torch.from_numpy(values.copy()) for key, values in obs.items()}  # the workers' memory is reused

    def _merged(self, info: dict[str, Any], rows: np.ndarray) -> Info:
        for row in rows.nonzero()[0]:
            (self._facts[row],) = info[FACTS][row]
        kinds = {name: type(value) for facts in self._facts for name, value in facts.items() if name != "error"}
        # A row that was not stepped since its reset does not know the task's facts yet: they are False or 0.
        merged: Info = {n: torch.tensor([f.get(n, kind()) for f in self._facts]) for n, kind in kinds.items()}
        merged["error"] = [facts["error"] for facts in self._facts]
        return merged


@contextmanager
def _quiet_gymnasium() -> Iterator[None]:
    """Keep Gymnasium from logging a worker's traceback: the exception that it raises here says the same."""
    level = gymnasium.logger.min_level
    gymnasium.logger.min_level = gymnasium.logger.ERROR + 1
    try:
        yield
    finally:
        gymnasium.logger.min_level = level


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()  # of a traceback, the last line says what happened
    return lines[-1].strip() if lines else type(error).__name__
