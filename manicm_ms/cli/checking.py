"""`manicm-ms list`, `check` and `doctor`: what there is, and whether it works."""

from __future__ import annotations

from typing import Literal

import tyro

from manicm_ms.cli.options import Backend, at_least_one
from manicm_ms.errors import ConfigError


def list_command(kind: tyro.conf.Positional[Literal["envs", "policies", "presets"]], tag: str | None = None) -> None:
    """List what is registered: environments, policies or training presets.

    Args:
        kind: what to list.
        tag: only the environments that carry this tag.
    """
    from manicm_ms.cli import listing

    if tag is not None and kind != "envs":
        raise ConfigError(f"--tag selects environments, {kind} have no tags: use 'list envs --tag {tag}' or drop --tag")
    tables = {"envs": lambda: listing.envs(tag), "policies": listing.policies, "presets": listing.presets}
    where = listing.console()
    for table in tables[kind]():
        listing.show(table, where)


def check_command(env_ids: tyro.conf.Positional[tuple[str, ...]], backend: Backend = "auto") -> int:
    """Run the conformance checks of the vector interface on environments; exit status 1 where one fails.

    Args:
        env_ids: environment ids.
        backend: where to simulate.
    """
    from manicm_ms.envs.conformance import Property, check_vec_env

    def show(result: Property) -> None:
        print(f"  {'ok  ' if result.passed else 'FAIL'} {result.name}{result.detail and ': ' + result.detail}")

    broken = 0
    for env_id in at_least_one(env_ids, "environment id"):
        print(env_id, flush=True)
        broken += sum(not result.passed for result in check_vec_env(env_id, backend, on_result=show))
    return 1 if broken else 0


def doctor_command() -> int:
    """Say what this machine offers and lacks, each trouble with its remedy; exit status 1 where one is fatal."""
    from manicm_ms.machine.doctor import doctor

    return doctor()
