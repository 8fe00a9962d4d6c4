"""Pickles shaped as the published DAPG policies, written by the libraries themselves."""

import io
import itertools
import pickle

import numpy as np
import torch

SCALINGS = ("in_shift", "in_scale", "out_shift", "out_scale")


class Network(torch.nn.Module):
    """Shaped as the network of the published policies: a list of layers, and scalings that are no parameters."""

    def __init__(self, sizes):
        super().__init__()
        shift = np.random.default_rng(0).normal(size=sizes[0])
        self.transformations = {"in_shift": shift, "in_scale": None}
        self.in_shift, self.in_scale = torch.from_numpy(np.float32(shift)), torch.rand(sizes[0]) + 0.5
        self.out_shift, self.out_scale = torch.randn(sizes[-1]), torch.rand(sizes[-1]) + 0.5
        self.fc_layers = torch.nn.ModuleList(torch.nn.Linear(*pair) for pair in itertools.pairwise(sizes))
        self.nonlinearity = torch.tanh


class OldPolicy:
    """Holds the network as one attribute among others; no module itself."""

    def __init__(self, sizes=(5, 4, 3, 2)):
        torch.manual_seed(1)
        self.model, self.old_model = Network(sizes), Network(sizes)
        self.log_std = torch.zeros(sizes[-1], requires_grad=True)
        self.log_std_val = np.zeros(sizes[-1])
        self.trainable_params = [*self.model.parameters(), self.log_std]
        self.param_sizes = [np.int64(p.numel()) for p in self.trainable_params]
        # Parts of one storage, as flat parameters leave them.
        flat = torch.randn(sum(p.numel() for p in self.model.parameters()))
        torch.nn.utils.vector_to_parameters(flat, self.model.parameters())


class ListStoragePickler(pickle.Pickler):
    """Writes storages as PyTorch before 1.0 did: type(self), (self.tolist(),)."""

    def reducer_override(self, value):
        if isinstance(value, torch.storage.TypedStorage):
            return getattr(torch, value.pickle_storage_type()), (value.tolist(),)
        return NotImplemented


def list_pickle(value, protocol):
    stream = io.BytesIO()
    ListStoragePickler(stream, protocol).dump(value)
    return stream.getvalue()
