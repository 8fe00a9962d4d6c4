"""How many weights each part of a policy has."""

from __future__ import annotations

from torch import nn

from manicm_ms.policies.action_policy import ActionPolicy

TOTAL = "total"


def parameters_by_part(policy: ActionPolicy) -> dict[str, int]:
    """Return part -> number of parameters: inputs (the transforms), encoder, backbone, head (what is left), total.

    A part without any is left out; weights that two parts share count where they come first.
    """
    backbone = policy.head.backbone
    parts: dict[str, nn.Module | None] = {
        "inputs": policy.transforms,
        "encoder": policy.encoder,
        "backbone": backbone,
        "head": policy.head,
    }
    seen: set[int] = set()
    counts = {}
    for name, part in parts.items():
        own = [] if part is None else [p for p in part.parameters() if id(p) not in seen]
        seen |= {id(p) for p in own}
        if own:
            counts[name] = sum(p.numel() for p in own)
    return {**counts, TOTAL: sum(p.numel() for p in policy.parameters())}
