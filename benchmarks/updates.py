"""Rows: the update of policy and critics, and the same by stock TorchRL."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from statistics import median

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from benchmarks.effort import SMALL, Effort
from benchmarks.floors import alone
from benchmarks.measure import Figure, Target, interleaved, over, threads
from benchmarks.parts import body_sizes, replay, sac_learner, update_products
from coim import HalfCheetahMorph, TransitionBuffer, sample_batches
from coim.experiments.run.machine import available_cores
from coim.learners.flat_weights import Precision
from coim.products import chosen, kind_of_processor

FLOOR = "floor"
COMPILED, EAGER = "compiled", "not compiled"
PRODUCTS_BY = "{:.2f} x the same products by coim.products"


def update(effort: Effort) -> list[Figure]:
    """Sampling, gradients, Adam and target update of policy and critics."""
    found = []
    for count in effort.threads:
        for runs in effort.runs:
            if count > available_cores():
                row = f"update, {plural(count)}, K = {runs}"
                found.append(Figure(row=row, against=FLOOR, note=too_few_cores(count)))
                continue
            with threads(count):
                found += _update(effort, count, runs)
    return found


def _update(effort: Effort, count: int, runs: int) -> list[Figure]:
    updates = max(1, effort.updates // runs)
    buffer, listed = replay(runs), update_products(effort)
    candidates = {
        "float32": our_updates(buffer, effort, updates, num_runs=runs),
        "float32, not compiled": our_updates(buffer, effort, updates, num_runs=runs, compile=False),
        "bfloat16": our_updates(buffer, effort, updates, num_runs=runs, precision="bfloat16"),
    }
    floor, ours = alone(listed, times=updates * runs), alone(listed, times=updates * runs, by=chosen())
    times = interleaved({"floor": floor, "products": ours, **candidates}, effort.repeats)
    narrow = kind_of_processor() == "AVX2"
    targets = {"float32": Target((1.45 if narrow else 1.25) if count == 1 else 1.4)}
    if count == 1 and not narrow:
        targets["bfloat16"] = Target(0.85)
    return [
        Figure(
            row=f"update, {plural(count)}, K = {runs}, {name}",
            against=FLOOR if runs == 1 else f"{runs} floors",
            ratios=over(times[name], times["floor"]),
            amounts=tuple(1e3 * seconds / (updates * runs) for seconds in times[name]),
            unit="ms per run",
            target=targets.get(name),
            note=PRODUCTS_BY.format(median(over(times[name], times["products"]))) if name == "float32" else "",
        )
        for name in candidates
    ]


def together(effort: Effort) -> list[Figure]:
    """Small networks: several runs that one learner updates, against one run at a time."""
    found = []
    for count in effort.threads:
        if count > available_cores():
            row = f"update of {small_networks()}, {plural(count)}, K = {effort.together}"
            found.append(Figure(row=row, against="runs, one at a time", note=too_few_cores(count)))
            continue
        with threads(count):
            found += _together(dataclasses.replace(effort, num_cells=SMALL), count)
    return found


def _together(effort: Effort, count: int) -> list[Figure]:
    together = effort.together
    buffers = {runs: replay(runs) for runs in (1, together)}
    times = interleaved(
        {"floor": alone(update_products(effort), times=effort.updates)}
        | {
            f"{runs}, {way}": our_updates(buffer, effort, effort.updates, num_runs=runs, compile=way == COMPILED)
            for runs, buffer in buffers.items()
            for way in (COMPILED, EAGER)
        },
        effort.repeats,
    )
    alone_ms = {way: median(times[f"1, {way}"]) / effort.updates * 1e3 for way in (COMPILED, EAGER)}
    floor = median(over(times[f"1, {COMPILED}"], times["floor"]))
    return [
        Figure(
            row=f"update of {small_networks()}, {plural(count)}, K = {together}, float32{suffix}",
            against=f"{together} runs, one at a time",
            ratios=tuple(ratio / together for ratio in over(times[f"{together}, {way}"], times[f"1, {way}"])),
            amounts=tuple(1e3 * seconds / (effort.updates * together) for seconds in times[f"{together}, {way}"]),
            unit="ms per run",
            target=Target(0.4) if way == COMPILED else None,
            note=f"one alone takes {alone_ms[way]:.2f} ms" + (f", {floor:.2f} x floor" if way == COMPILED else ""),
        )
        for way, suffix in ((COMPILED, ""), (EAGER, ", not compiled"))
    ]


def small_networks() -> str:
    """How rows call them."""
    return f"{len(SMALL)} x {SMALL[0]} units"


def our_updates(
    buffer: TransitionBuffer,
    effort: Effort,
    updates: int,
    *,
    num_runs: int = 1,
    precision: Precision = "float32",
    compile: bool = True,
    device: torch.device | str = "cpu",
) -> Callable[[], None]:
    """So many updates as Algorithm 1 does them: all batches in one draw, then `SACLearner.update`."""
    learner = sac_learner(effort, num_runs=num_runs, precision=precision, compile=compile, device=device)

    def run() -> None:
        batches = sample_batches(buffer, batch_size=effort.batch_size, num_batches=updates)
        learner.update(batches[:, :, 0] if num_runs == 1 else batches)

    return run


def torchrl(effort: Effort) -> list[Figure]:
    """TorchRL's own SACLoss, fused Adam and SoftUpdate, eager, on its own networks and the same rows."""
    found = []
    for count in effort.threads:
        row = f"update, {plural(count)}, K = 1, float32"
        if count > available_cores():
            found.append(Figure(row=row, against="TorchRL", note=too_few_cores(count)))
            continue
        with threads(count):
            buffer, updates = replay(1), max(1, effort.updates // 2)
            times = interleaved(
                {
                    "floor": alone(update_products(effort), times=updates),
                    "ours": our_updates(buffer, effort, updates),
                    "theirs": _torchrl_updates(buffer, effort, updates),
                },
                effort.repeats,
            )
        found.append(
            Figure(
                row=row,
                against="TorchRL",
                ratios=over(times["ours"], times["theirs"]),
                amounts=tuple(1e3 * seconds / updates for seconds in times["ours"]),
                unit="ms",
                note=f"TorchRL is at {median(over(times['theirs'], times['floor'])):.2f} x floor",
            )
        )
    return found


def _torchrl_updates(buffer: TransitionBuffer, effort: Effort, updates: int) -> Callable[[], None]:
    sizes = body_sizes(HalfCheetahMorph(seed=0))
    states = sizes["observations"] + sizes["designs"]

    def network(inputs: int, outputs: int) -> MLP:
        return MLP(in_features=inputs, out_features=outputs, num_cells=effort.num_cells, activation_class=nn.ReLU)

    actor = ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(network(states, 2 * sizes["actions"]), ["observation", "design"], ["parameters"]),
            TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"]),
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(network(states + sizes["actions"], 1), in_keys=["observation", "action", "design"])
    action_spec = HalfCheetahMorph(seed=0).action_spec_unbatched
    loss = SACLoss(
        actor,
        critic,
        num_qvalue_nets=2,
        loss_function="l2",
        alpha_init=0.01,
        min_alpha=None,
        fixed_alpha=True,
        action_spec=action_spec,
    )
    loss.make_value_estimator(gamma=0.99)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4, fused=True)
    targets = SoftUpdate(loss, tau=0.005)

    def step(batch: TensorDictBase) -> None:
        found = loss(batch)
        optimiser.zero_grad()
        (found["loss_actor"] + found["loss_qvalue"]).backward()
        optimiser.step()
        targets.step()

    def run() -> None:
        for batch in sample_batches(buffer, batch_size=effort.batch_size, num_batches=updates)[:, :, 0].unbind(0):
            step(batch)

    return run


def plural(count: int) -> str:
    """``1 thread``, ``2 threads``."""
    return f"{count} thread" + "s" * (count > 1)


def too_few_cores(count: int) -> str:
    """Why a row is empty."""
    return f"needs {count} cores, this process may use {available_cores()}"
