"""The deterministic policy as a plain network, and the formats that it is written in.

Shapes: B batch, S observation, D design, A action.

References:
    ONNX, https://onnx.ai; safetensors, https://huggingface.co/docs/safetensors; torch.export,
    https://docs.pytorch.org/docs/stable/export.html.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from coim.models import Policy

INPUTS, OUTPUT = ("observation", "design"), "action"
OPSET, IR_VERSION = 17, 8  # ONNX of 2022, which every runtime since then reads
Acting = Callable[[Tensor, Tensor], Tensor]


class Actor(nn.Module):
    """The mode of a policy as a network, ``(observation [B, S], design [B, D]) -> action [B, A]`` in [-1, 1].

    Its state holds the constants that scale the inputs besides the weights: it is all that there is to a policy.

    Args:
        state: as :meth:`of` reads it from a policy, or a file has it: ``scale [S]``, ``centre [D]``, ``reach [D]``, and
            ``weight.i [F, O]`` and ``bias.i [O]`` of each layer, the first being 0.

    Raises:
        ValueError: if the state is none of a policy.
    """

    scale: Tensor
    centre: Tensor
    reach: Tensor

    def __init__(self, state: Mapping[str, Tensor]) -> None:
        super().__init__()
        depth = (len(state) - 3) // 2
        layers = [name for i in range(depth) for name in (f"weight.{i}", f"bias.{i}")]
        if depth < 1 or {*state} != {"scale", "centre", "reach", *layers}:
            raise ValueError(f"{sorted(state)} are not the tensors of a policy; coim export writes such a file")
        for name in ("scale", "centre", "reach"):
            self.register_buffer(name, state[name].detach().clone())
        self.weight = nn.ParameterList(state[f"weight.{i}"].detach().clone() for i in range(depth))
        self.bias = nn.ParameterList(state[f"bias.{i}"].detach().clone() for i in range(depth))

    @classmethod
    def of(cls, policy: Policy) -> Actor:
        """Copy a policy without a run axis.

        Raises:
            ValueError: if it has one, or is not as `coim.make_policy` makes it.
        """
        network = policy.network
        if policy.num_runs is not None or not policy.is_unaltered() or network.scaling is None:
            raise ValueError("this policy is not one of coim.make_policy for one run; take one of K by select_run")
        scaling = network.scaling
        state = {"scale": scaling.observation_scale, "centre": scaling.design_centre, "reach": scaling.design_reach}
        parameters = [parameter.detach() for parameter in network.mlp.parameters()]  # weight, bias, weight, bias, ...
        actions = parameters[-1].shape[-1] // 2  # the rest of the output is the spread, which the mode does not need
        parameters[-2:] = [parameter[..., :actions] for parameter in parameters[-2:]]
        state |= {f"weight.{i}": weight for i, weight in enumerate(parameters[0::2])}
        return cls(state | {f"bias.{i}": bias for i, bias in enumerate(parameters[1::2])}).cpu().eval()

    def forward(self, observation: Tensor, design: Tensor) -> Tensor:
        """Act: ``[B, S], [B, D] -> [B, A]``."""
        x = torch.cat([observation / self.scale, (design - self.centre) / self.reach], -1)
        last = len(self.weight) - 1
        for i, (weight, bias) in enumerate(zip(self.weight, self.bias)):
            x = x @ weight + bias
            if i < last:
                x = torch.relu(x)
        return torch.tanh(x)

    def example(self, rows: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Random observations of typical spread and designs within their bounds, ``[rows, S], [rows, D]``."""
        generator = torch.Generator().manual_seed(seed)
        observation = torch.randn(rows, len(self.scale), generator=generator) * self.scale
        share = 2 * torch.rand(rows, len(self.centre), generator=generator) - 1
        return observation, self.centre + share * self.reach


def write_onnx(actor: Actor, path: Path) -> None:
    """Write an ONNX graph with inputs ``observation`` and ``design`` and output ``action``, for any batch size.

    The graph is put together here: torch's own exporter needs two more packages and seconds for these few nodes.
    """
    onnx = needed("onnx")
    node = onnx.helper.make_node
    nodes = [
        node("Div", ["observation", "scale"], ["scaled"]),
        node("Sub", ["design", "centre"], ["moved"]),
        node("Div", ["moved", "reach"], ["shares"]),
        node("Concat", ["scaled", "shares"], ["input.0"], axis=-1),
    ]
    last = len(actor.weight) - 1
    for i in range(last + 1):
        nodes.append(node("Gemm", [f"input.{i}", f"weight.{i}", f"bias.{i}"], [f"layer.{i}"]))
        nodes.append(node("Tanh" if i == last else "Relu", [f"layer.{i}"], [OUTPUT if i == last else f"input.{i + 1}"]))

    def port(name: str, size: int) -> Any:
        return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", size])

    tensors = [onnx.numpy_helper.from_array(value.numpy(), name) for name, value in actor.state_dict().items()]
    ports = [port(name, len(constant)) for name, constant in zip(INPUTS, (actor.scale, actor.centre))]
    graph = onnx.helper.make_graph(nodes, "policy", ports, [port(OUTPUT, len(actor.bias[last]))], tensors)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def read_onnx(path: Path) -> Acting:
    """A function that acts by the ONNX runtime, on one core."""
    runtime = needed("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def act(observation: Tensor, design: Tensor) -> Tensor:
        (action,) = session.run([OUTPUT], dict(zip(INPUTS, (observation.numpy(), design.numpy()))))
        return torch.from_numpy(action)

    return act


def write_pt2(actor: Actor, path: Path) -> None:
    """Write a program of torch.export for any batch size; ``torch.export.load(path).module()`` reads it."""
    batch = torch.export.Dim("batch")
    program = torch.export.export(actor, actor.example(2), dynamic_shapes={name: {0: batch} for name in INPUTS})
    torch.export.save(program, path)


def read_pt2(path: Path) -> Acting:
    """A function that acts by the program in a file."""
    module: Acting = torch.export.load(path).module()
    return module


def write_safetensors(actor: Actor, path: Path) -> None:
    """Write the tensors of an actor, which name their layers."""
    tensors = {name: value.detach().contiguous() for name, value in actor.state_dict().items()}
    path.write_bytes(needed("safetensors.torch").save(tensors))  # save_file makes a file that its owner alone can read


def read_safetensors(path: Path) -> Acting:
    """The actor in a file."""
    return Actor(needed("safetensors.torch").load_file(path))


FORMATS: dict[str, tuple[Callable[[Actor, Path], None], Callable[[Path], Acting]]] = {
    ".onnx": (write_onnx, read_onnx),
    ".safetensors": (write_safetensors, read_safetensors),
    ".pt2": (write_pt2, read_pt2),
}


def needed(*names: str, otherwise: str = ", or take a file .pt2, which torch alone writes and reads") -> Any:
    """Import what a format needs; the last of the modules.

    Args:
        names: of the modules.
        otherwise: the way to do without them, for the message.

    Raises:
        ValueError: if one is not installed; the message says how to install it.
    """
    for name in names:
        try:
            module = import_module(name)
        except ModuleNotFoundError as error:
            raise ValueError(
                f"{name.split('.')[0]} is not installed ({error}): pip install 'coim[export]'{otherwise}"
            ) from None
    return module


def read_policy(path: Path) -> Acting:
    """A function of an observation ``[B, S]`` and a design ``[B, D]`` that returns the action of a file, ``[B, A]``.

    Raises:
        ValueError: if the file does not exist, is in none of the formats, or a package for it is not installed.
    """
    if path.suffix not in FORMATS:
        raise ValueError(f"{path} is none of {', '.join(FORMATS)}: name a folder of a run, or a file of coim export")
    if not path.is_file():
        raise ValueError(f"{path} does not exist; coim export writes it")
    return FORMATS[path.suffix][1](path)
