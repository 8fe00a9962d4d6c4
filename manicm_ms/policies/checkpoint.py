"""Checkpoint folders: weights, configuration, model card and a manifest by which damage is noticed.

::

    runs/teacher/
      config.json          policy, its configuration, the environment's spec, To, Tp, Ta
      model.safetensors    weights and normalizer
      MODEL_CARD.md        what it is, what it was trained on, licence
      manifest.json        format, SHA-256 of the other files, versions, provenance

Nothing is ever unpickled.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from manicm_ms.errors import CheckpointError, ConfigError, ManicmError, NoSpaceError, OutputExistsError
from manicm_ms.paths import is_disk_full, replaced_folder, require_free_space, set_aside, sha256, write_json, write_text
from manicm_ms.policies.action_policy import ActionPolicy, build_policy
from manicm_ms.policies.heads.head import HEADS
from manicm_ms.policies.migration import present_config, present_tensors
from manicm_ms.policies.model_card import model_card
from manicm_ms.provenance import package_versions
from manicm_ms.spec import ChunkSpec, EnvSpec

FORMAT = "manicm_ms.checkpoint"
FORMAT_VERSION = 2
READABLE_VERSIONS = (1, 2)
WEIGHTS_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

_CONFIG, _MODEL, _CARD, _MANIFEST = "config.json", "model.safetensors", "MODEL_CARD.md", "manifest.json"
_FILES = (_CONFIG, _MODEL, _CARD)
_COMPILED = "_orig_mod"  # name under which `torch.compile` holds the module that it wraps


def save_checkpoint(
    policy: ActionPolicy, folder: Path, provenance: Mapping[str, Any], *, dtype: str = "float32"
) -> None:
    """Write `policy` to `folder`, in place of the checkpoint there, if any; a kill leaves the old or the new one.

    Args:
        policy: teacher or student; what `torch.compile` wrapped, it or modules of it, is saved without the wrapping.
        folder: of the checkpoint.
        provenance: where it comes from, JSON values: data, preset, steps, seed, command, ...
        dtype: of the stored weights, a name in `WEIGHTS_DTYPES`; they are float32 again when loaded. float16
            halves the file and keeps 11 significant bits. Only floating parameters are cast: buffers, such as the
            normalizer's, keep their values.

    Raises:
        CheckpointError: the policy is a wrapper that no checkpoint can hold, or its weights are not finite.
        ConfigError: unknown dtype, or provenance that JSON cannot hold.
        OutputExistsError: the folder holds something other than a checkpoint.
        NoSpaceError: the disk is full; the old checkpoint stays.
    """
    folder, policy = Path(folder), _unwrapped(policy)
    if HEADS.name_of(type(_unwrapped_part(policy.head))) is None:
        raise CheckpointError(f"{policy.name} shares the weights of another policy: save that one")
    if dtype not in WEIGHTS_DTYPES:
        raise ConfigError(f"unknown checkpoint dtype {dtype!r}: use {', '.join(WEIGHTS_DTYPES)}")
    if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not _is_checkpoint(folder))):
        raise OutputExistsError(f"{folder} holds something other than a checkpoint: choose another folder")
    tensors = _stored(policy, WEIGHTS_DTYPES[dtype])
    require_free_space(folder, sum(t.nbytes for t in tensors.values()) + (1 << 20))
    with _disk_errors(folder), replaced_folder(folder) as fresh:
        save_file(tensors, fresh / _MODEL)
        (fresh / _MODEL).chmod(0o644)
        write_json(fresh / _CONFIG, description_of(policy))
        write_text(fresh / _CARD, model_card(policy, _plain(provenance), dtype))
        write_json(fresh / _MANIFEST, _manifest(fresh, policy.name, dtype, _plain(provenance)))


def description_of(policy: ActionPolicy) -> dict[str, Any]:
    """Return what config.json says of a policy, JSON values: everything but its weights."""
    return {
        "policy": policy.name,
        "config": policy.config_dict(),
        "env_spec": policy.spec.to_dict(),
        "chunk": asdict(policy.chunk),
    }


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a checkpoint without reading its weights.

    Returns:
        `format`, `version`, `policy` (its name), `weights_dtype`, `files` (name -> `sha256`, `bytes`),
        `packages` (name -> version), `provenance`.

    Raises:
        CheckpointError: there is no checkpoint, or one of another program or of a newer format.
    """
    folder = Path(folder)
    path = folder / _MANIFEST
    if not folder.is_dir():
        old = set_aside(folder)
        if old.is_dir():
            raise CheckpointError(
                f"saving {folder} was cut off and left the checkpoint before it: rename {old} to {folder}"
            )
        raise CheckpointError(f"there is no checkpoint folder {folder}: train one, or check the path")
    if not path.is_file():
        raise CheckpointError(f"{folder} is no checkpoint of this package: it has no {_MANIFEST}")
    manifest = _read_json(path)
    if manifest.get("format") != FORMAT:
        raise CheckpointError(f"{path} is of format {manifest.get('format')!r}, not {FORMAT!r}: it is foreign")
    version = manifest.get("version")
    if version not in READABLE_VERSIONS:
        raise CheckpointError(
            f"{path} has format version {version!r} and this package reads "
            f"{' and '.join(map(str, READABLE_VERSIONS))}: "
            "install the version of manicm_ms that wrote it"
        )
    if not isinstance(manifest.get("files"), dict) or set(manifest["files"]) != set(_FILES):
        raise CheckpointError(f"{path} does not list {', '.join(_FILES)}: copy or train the checkpoint again")
    return manifest


def verify_checkpoint(folder: Path) -> dict[str, Any]:
    """Return the manifest; raise CheckpointError naming the first file that is missing, truncated or altered."""
    folder = Path(folder)
    manifest = read_manifest(folder)
    remedy = "copy the checkpoint again or train it anew"
    for name in _FILES:
        path, entry = folder / name, manifest["files"][name]
        if not path.is_file():
            raise CheckpointError(f"{path} is missing: {remedy}")
        if path.stat().st_size != entry.get("bytes"):
            raise CheckpointError(
                f"{path} has {path.stat().st_size} bytes where the manifest says {entry.get('bytes')}: {remedy}"
            )
        if sha256(path) != entry.get("sha256"):
            raise CheckpointError(f"{path} was altered after it was written (its SHA-256 differs): {remedy}")
    return manifest


def load_checkpoint(folder: Path, device: torch.device | str = "cpu") -> ActionPolicy:
    """Return the policy of a checkpoint, float32, ready to act on `device`.

    Raises:
        CheckpointError: the checkpoint is missing, incomplete, altered or foreign; the message names the file.
    """
    folder = Path(folder)
    version = verify_checkpoint(folder)["version"]
    policy = _build(folder / _CONFIG, version)
    path = folder / _MODEL
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}): copy or train the checkpoint again") from error
    if version == 1:
        tensors = present_tensors(tensors)
    expected = policy.state_dict()
    wrong = sorted(expected.keys() ^ tensors.keys())
    wrong += sorted(k for k in expected.keys() & tensors.keys() if expected[k].shape != tensors[k].shape)
    if wrong:
        raise CheckpointError(
            f"{path} does not fit the {policy.name} that {_CONFIG} describes ({len(wrong)} tensors differ, "
            f"first {wrong[0]}): the files come from different checkpoints"
        )
    policy.load_state_dict(tensors)  # each value takes the type of its place
    return policy.to(device).eval()


def _unwrapped(policy: nn.Module) -> ActionPolicy:
    """Return the policy that `torch.compile` wrapped, or the policy itself."""
    policy = getattr(policy, "_modules", {}).get(_COMPILED, policy)
    if not isinstance(policy, ActionPolicy):
        raise CheckpointError(f"a {type(policy).__name__} is no policy of this package: save the policy that it wraps")
    return policy


def _unwrapped_part(part: nn.Module) -> Any:
    return getattr(part, _COMPILED, part)


def _stored(policy: ActionPolicy, dtype: torch.dtype) -> dict[str, Tensor]:
    """Return name -> tensor on the CPU, under the names of the policy as `build_policy` makes it."""
    parameters = {key for key, _ in policy.named_parameters(remove_duplicate=False)}
    tensors = {}
    for key, value in policy.state_dict().items():
        if not torch.isfinite(value).all():
            raise CheckpointError(f"{key} of {policy.name} holds NaN or infinity: the training diverged, nothing saved")
        stored = value.detach().to("cpu", _stored_dtype(value, key in parameters, dtype), copy=True).contiguous()
        if not torch.isfinite(stored).all():
            raise CheckpointError(f"{key} of {policy.name} overflows {dtype}: save with dtype 'float32' or 'bfloat16'")
        tensors[".".join(part for part in key.split(".") if part != _COMPILED)] = stored
    return tensors


def _stored_dtype(value: Tensor, is_parameter: bool, asked: torch.dtype) -> torch.dtype:
    if not value.is_floating_point():
        return value.dtype
    return asked if is_parameter else torch.promote_types(value.dtype, torch.float32)


def _manifest(folder: Path, policy: str, dtype: str, provenance: Mapping[str, Any]) -> dict[str, Any]:
    files = {n: {"sha256": sha256(folder / n), "bytes": (folder / n).stat().st_size} for n in _FILES}
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "policy": policy,
        "weights_dtype": dtype,
        "files": files,
        "packages": package_versions(),
        "provenance": provenance,
    }


def _build(path: Path, version: int) -> ActionPolicy:
    description = _read_json(path)
    try:
        spec, config = EnvSpec.from_dict(description["env_spec"]), description["config"]
        if not isinstance(description["policy"], str):
            raise TypeError(f"policy is {description['policy']!r}")
        if version == 1:
            config = present_config(config)
        return build_policy(description["policy"], config, spec, ChunkSpec(**description["chunk"]))
    except ManicmError as error:
        raise CheckpointError(f"{path} describes no policy that this version can build: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path} is not a checkpoint's configuration ({error!r}): train it anew") from error


def _is_checkpoint(folder: Path) -> bool:
    try:
        return _read_json(folder / _MANIFEST).get("format") == FORMAT
    except (CheckpointError, OSError):
        return False


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CheckpointError(f"{path} is not JSON ({error}): copy or train the checkpoint again") from error
    if not isinstance(value, dict):
        raise CheckpointError(f"{path} holds no JSON object: copy or train the checkpoint again")
    return value


def _plain(provenance: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return json.loads(json.dumps(provenance, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"provenance must be JSON values: {error}") from error


@contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, SafetensorError) as error:
        if not is_disk_full(error):
            raise
        raise NoSpaceError(
            f"no space left for the checkpoint {folder}; nothing was changed: free some space and save again"
        ) from error
