"""To ManiSkill's h5 and json: what its replay_trajectory, its baselines and its data loaders read.

A store holds what a policy sees, ManiSkill's file what the simulator was in; so each episode is played
again from its seed, and one that is not solved again (it came from another backend, say, or its masses
were randomised, of which the plain environment knows nothing) is left out.
"""

from __future__ import annotations

import numpy as np

from manicm_ms.demos.convert.base import EXPORTERS, SIDECAR, Export, Tally
from manicm_ms.errors import ManicmError, StoreError
from manicm_ms.paths import write_json

TRAJECTORY = "trajectory"
"""Name of the h5 and the json file, as in ManiSkill's own data sets."""


@EXPORTERS.register("maniskill")
def export(job: Export) -> Tally:
    """Write trajectory.h5, trajectory.json, and env spec and provenance beside them.

    Raises StoreError where the episodes' seeds are not known, ConfigError for a task that does not run on
    ManiSkill, ManicmError where no episode is solved again.
    """
    from manicm_ms.envs.maniskill import gym_id  # SAPIEN: seconds to import
    from manicm_ms.envs.maniskill_record import ManiSkillRecorder

    env_id, provenance = job.store.spec.env_id, job.store.provenance
    if (job.store.seeds < 0).any():
        raise StoreError(
            f"{job.store.path} does not know its episodes' seeds: they cannot be played again in ManiSkill"
        )
    gym_id(env_id)  # refuses before anything is made
    tally, failed, gap = Tally(), [], 0.0
    about = f"manicm_ms, expert {provenance.get('expert')}, style {provenance.get('style')}"
    job.folder.mkdir()
    with ManiSkillRecorder(env_id, job.folder, TRAJECTORY, source_type="motionplanning", source_desc=about) as recorder:
        for episode in job.episodes():
            played = recorder.play(episode.seed, episode.action)
            if episode.success and not played.success:
                failed.append(episode.seed)
                continue
            gap = max(gap, float(np.abs(played.agent_pos - episode.agent_pos).max()))
            recorder.keep()
            tally.add(episode)
    if not tally.episodes:
        raise ManicmError(
            f"none of the {len(failed)} episodes of {job.store.path} is solved again by its actions: it was collected "
            f"with another version or backend ({provenance.get('backend')}) of {env_id}; collect it again with "
            "--backend cpu"
        )
    write_json(job.folder / SIDECAR, job.about())
    tally.notes.append(f"played again: agent_pos differs from the store's by at most {gap:.2g}")
    if (realism := provenance.get("realism", "clean")) != "clean":
        tally.notes.append(f"collected with realism {realism!r}: the states written are those of the plain simulator")
    if failed:
        tally.notes.append(f"{len(failed)} episodes were not solved again and are left out: seeds {failed}")
    return tally
