"""Exports the U-Net step of SVD_14 with weights that take no memory, in a process of its own; prints what came out.

Usage: full_size_export.py FOLDER
"""

import json
import math
import resource
import sys
from pathlib import Path

import onnx
import torch
from torch import nn

from gcd_model.config import SVD_14
from gcd_model.engines.onnx_export import graphs, write_graph
from gcd_model.networks import empty_networks

SMALL = 64
"""Numbers that make a tensor worth a place beside the graph: 256 bytes. Below are constants of shapes and shares."""


def fill(module: nn.Module) -> None:
    """One zero, seen from everywhere: weights of the right shapes without memory."""
    for name, parameter in list(module.named_parameters(recurse=False)):
        zeros = torch.zeros(1).expand(parameter.shape) if parameter.ndim else torch.zeros(())
        setattr(module, name, nn.Parameter(zeros, requires_grad=False))
    for child in module.children():
        fill(child)


def main(folder: Path) -> None:
    networks = empty_networks(SVD_14)
    fill(networks)
    graph = next(each for each in graphs(networks) if each.name == "step")
    files = write_graph(graph, folder)
    model = onnx.load(folder / "step.onnx", load_external_data=False)
    large = [each for each in model.graph.initializer if math.prod(each.dims) > SMALL]
    apart = [each for each in model.graph.initializer if each.data_location == onnx.TensorProto.EXTERNAL]
    found = {
        "inputs": {name: each.shape for name, each in graph.inputs.items()},
        "files": [file.name for file in files],
        "graph_mb": files[0].size / 1e6,
        "data_gb": sum(file.size for file in files[1:]) / 1e9,
        "weights": len(large),
        "apart": len(apart),
        "nodes": len(model.graph.node),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "cpu_s": sum(resource.getrusage(resource.RUSAGE_SELF)[:2]),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
