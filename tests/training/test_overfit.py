"""Every method of the table learns one real demonstration by heart, at the size `smoke`, and is the same when loaded.

A row that is added to the table is tested here without further ado.
"""

import io
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from manicm_ms.bench.overfit import extras_of, learns_from_teacher, teacher_of
from manicm_ms.demos.collect import collect
from manicm_ms.demos.layout import OPTIONAL_FIELDS
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.policies.encoders.encoder import ENCODERS
from manicm_ms.policies.encoders.transform import TRANSFORMS
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.demonstrations import read_demos
from manicm_ms.training.distill import distill
from manicm_ms.training.presets import STUDENT_PRESETS, preset_for
from manicm_ms.training.train import train

ENV = "metaworld/button-press"
STEPS = {"bc_gmm_3d": 200, "meanflow": 150, "uca_flow": 150}
"""The means of a mixture move slowly while its deviations are wide, and an average velocity follows its own derivative;
all others take `MOST_STEPS`."""
MOST_STEPS, STUDENT_STEPS = 60, 20
BOUND = 0.5
"""Mean error of the executed actions, as a share of that of the best constant action."""
BOUNDS = {"meanflow": 0.8, "uca_flow": 0.8, "dp": 0.8, "image_manicm": 0.8}
"""The same where so few steps leave noise in the actions, and where pictures are cropped anew in each step."""
CHANGES = {"meanflow": {"backbone": "mixer"}, "dp": {"head": {"prediction_type": "sample"}}}
"""What would take too long here: a U-Net of the size smoke learns no average velocity in seconds, one of the size quick
does in half a minute; and a network that predicts the noise takes hundreds of steps."""
STORED = {"point_cloud", "agent_pos", *OPTIONAL_FIELDS}
QUIET = {"device": "cpu", "precision": "32-true", "console": Console(file=io.StringIO())}


def reads(method):
    """Observations that a method reads."""
    config = METHODS.get(method).configuration("smoke")
    transforms = {key for name in config["inputs"] for key in TRANSFORMS.get(name).reads}
    return {*ENCODERS.get(config["encoder"]["name"]).keys, *transforms}


def few_points(method):
    """Changes that make a method read 16 points, where it chooses points."""
    return {"inputs": {"points": {"max_points": 16}}} if "points" in METHODS.get(method).inputs else {}


@pytest.fixture(scope="session")
def store_for(tmp_path_factory):
    """Return the store, of one demonstration, that holds what a method reads; made once for methods that read alike."""
    folder, made = tmp_path_factory.mktemp("button_press"), {}

    def store(method):
        extras = extras_of(method)
        if extras not in made:
            made[extras] = collect(
                ENV, 1, folder / f"{'-'.join(extras) or 'plain'}.zarr", extras=extras, console=QUIET["console"]
            ).path
        return made[extras]

    return store


@pytest.fixture(scope="session")
def trained(tmp_path_factory, store_for):
    """Return the checkpoint of a method, and the actions that it chose before it was saved."""
    folder, made = tmp_path_factory.mktemp("overfit"), {}

    def run(method):
        if method not in made:
            made[method] = make(method)
        return made[method]

    def make(method):
        store, chosen = store_for(method), []
        keep = {"on_trained": lambda policy: chosen.append(act(policy.eval(), windows(policy, store)))} | QUIET
        if learns_from_teacher(method):
            teacher, _ = run(teacher_of(method, "smoke"))
            student = replace(
                STUDENT_PRESETS.get("smoke"), steps=STUDENT_STEPS, warmup_steps=2, nfe=METHODS.get(method).nfe
            )
            return distill(teacher, store, folder / method, student, **keep), chosen[0]
        preset = replace(
            preset_for(method, "smoke"), steps=STEPS.get(method, MOST_STEPS), learning_rate=5e-3, batch_size=8,
            save_every=1000, changes=few_points(method) | CHANGES.get(method, {}),
        )  # fmt: skip
        return train(method, store, folder / method, preset, **keep), chosen[0]

    return run


def windows(policy, store):
    """Every window of the store, as the policy reads it."""
    dataset = read_demos(store, policy.chunk, policy.keys).dataset
    return dataset.batch(torch.arange(len(dataset)))


def act(policy, batch):
    return policy.act({key: batch[key] for key in policy.keys}, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("method", METHODS.names())
def test_it_learns_a_demonstration_by_heart_and_is_the_same_when_loaded(method, trained, store_for):
    if missing := reads(method) - STORED:
        pytest.skip(f"{method} reads {', '.join(sorted(missing))}, which no store holds")
    checkpoint, before = trained(method)
    policy = load_checkpoint(checkpoint)
    batch = windows(policy, store_for(method))
    actions, wanted = act(policy, batch), batch["action"][:, policy.chunk.executed]
    assert torch.equal(actions, before)
    constant = (wanted - wanted.flatten(0, 1).median(0).values).abs().mean()  # the median errs least
    assert (actions - wanted).abs().mean() < BOUNDS.get(method, BOUND) * constant
    assert constant > 0.1, "or there is nothing to learn"
