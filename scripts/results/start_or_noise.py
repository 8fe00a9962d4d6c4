"""Does the start or the noise settle which side a policy takes? `python scripts/results/start_or_noise.py CHECKPOINT`.

Paired evaluations give all policies of a seed the same noise, so their agreement cannot tell. Here one policy plays the
same seeds twice, with independent noise, and the sides are compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
import tyro
from sides_table import approach
from torch import Tensor

from manicm_ms.envs.vec_env import make_vec
from manicm_ms.evaluation.rollout import rollout
from manicm_ms.machine.devices import torch_threads
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.policies.policy import Policy


class OwnNoise(Policy):
    """Plays another policy with noise of its own in place of the episode's."""

    registered = False

    def __init__(self, policy: Policy, seed: int) -> None:
        super().__init__()
        self.policy, self.name, self.spec, self.chunk = policy, policy.name, policy.spec, policy.chunk
        self._generator = torch.Generator().manual_seed(seed)

    @property
    def nfe(self) -> int:
        """That of the policy."""
        return self.policy.nfe

    def act(
        self, obs: Mapping[str, Tensor], *, generator: torch.Generator | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Choose the next actions with own noise."""
        del generator, noise
        return self.policy.act(obs, generator=self._generator)


def main(checkpoint: tyro.conf.Positional[Path], episodes: int = 100, seed: int = 100_000) -> None:
    """Print in how many episodes both runs take the same side, for the checkpoint and, of a teacher, in one step.

    Args:
        checkpoint: folder of the policy.
        episodes: seeds, each played twice.
        seed: the first of them.
    """
    policy = load_checkpoint(checkpoint)
    control = policy.one_step()
    players = [policy] if control is None else [policy, control]
    env = make_vec("ur3e/slide-block", 2, "cpu", chunk=policy.chunk)
    try:
        with torch_threads(1):
            for player in players:
                sides = []
                for noise_seed in (1, 2):
                    played = rollout(env, OwnNoise(player, noise_seed), range(seed, seed + episodes))
                    sides.append(np.sign([approach(episode) for episode in played]))
                same = int((sides[0] == sides[1]).sum())
                print(f"{checkpoint} ({player.name}): same side in {same} of {episodes}", flush=True)
    finally:
        env.close()


if __name__ == "__main__":
    tyro.cli(main)
