"""Batch normalisation with absent agents: with a selection of the present ones, without, and as kernels of a GPU."""

from __future__ import annotations

import pytest
import torch
from backends import HostMustNotWait

from epo_lightning.decoders import batch_norm
from epo_lightning.decoders.batch_norm import MaskedBatchNorm, NormalisePresent
from epo_lightning.decoders.fused_norm import THREADS, FusedNormalise, kernels
from epo_lightning.decoders.mlp import MLP

needs_warp = pytest.mark.skipif(
    not batch_norm.installed(), reason="NVIDIA Warp is not installed: pip install 'epo_lightning[gpu]'"
)


def trained(network, features, mask):
    """Results of a training step: outputs of the present rows, all gradients and the running statistics."""
    given = features.clone().requires_grad_()
    output = network(given, mask).where(mask[..., None], 0.0)
    output.square().sum().backward()
    gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    statistics = [value for name, value in network.state_dict().items() if "running" in name or "tracked" in name]
    return [output.detach(), given.grad.where(mask[..., None], 0.0), *gradients, *(each.clone() for each in statistics)]


@pytest.mark.parametrize("kind", ["operations", pytest.param("kernels", marks=needs_warp)])
@pytest.mark.parametrize("filling", [0.0, 1e6])
@pytest.mark.parametrize("present", [0.6, 1.0])
def test_statistics_of_present_rows_need_no_selection(kind, filling, present, monkeypatch):
    torch.manual_seed(0)
    mask = torch.rand(6, 4) < present
    network = MLP(5, 8, 3, norm="batch").double().train()
    state = {name: value.clone() for name, value in network.state_dict().items()}
    features = torch.where(mask[..., None], torch.randn(6, 4, 5, dtype=torch.float64), filling)
    expected = trained(network, features, mask)
    monkeypatch.setattr(batch_norm, "readable", lambda _: False)
    if kind == "kernels":
        monkeypatch.setattr(MaskedBatchNorm, "_without_waiting", MaskedBatchNorm._fused)
    network.load_state_dict(state)
    network.zero_grad()
    with HostMustNotWait():
        found = trained(network, features, mask)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-10)


def normalisation(kind, monkeypatch):
    """A module whose running mean is 5 and whose running variance is 3."""
    norm = MaskedBatchNorm(3).double().train()
    norm.running_mean.fill_(5.0)
    norm.running_var.fill_(3.0)
    monkeypatch.setattr(batch_norm, "readable", lambda _: kind == "selection")
    if kind == "kernels":
        monkeypatch.setattr(MaskedBatchNorm, "_without_waiting", MaskedBatchNorm._fused)
    return norm


@pytest.mark.parametrize("kind", ["selection", "operations", pytest.param("kernels", marks=needs_warp)])
def test_a_batch_without_a_present_row_leaves_the_statistics_as_they_are(kind, monkeypatch):
    norm = normalisation(kind, monkeypatch)
    norm(torch.randn(2, 4, 3, dtype=torch.float64), torch.zeros(2, 4, dtype=torch.bool))
    assert norm.running_mean.tolist() == 3 * [5.0]
    assert norm.running_var.tolist() == 3 * [3.0]
    assert norm.num_batches_tracked == 1, "as by nn.BatchNorm1d"


@pytest.mark.parametrize("kind", ["operations", pytest.param("kernels", marks=needs_warp)])
def test_one_present_row_has_a_variance_of_zero(kind, monkeypatch):
    norm = normalisation(kind, monkeypatch)
    norm(torch.full((1, 2, 3), 7.0, dtype=torch.float64), torch.tensor([[False, True]]))
    torch.testing.assert_close(norm.running_mean, torch.full((3,), 5.2, dtype=torch.float64))
    torch.testing.assert_close(norm.running_var, torch.full((3,), 2.7, dtype=torch.float64))


def given_rows(rows=5, features=3, dtype=torch.float64):
    """Rows, weight and bias that need gradients."""
    return [
        torch.randn(shape, dtype=dtype, requires_grad=True) for shape in ((rows, features), (features,), (features,))
    ]


def by_operations(rows, present, weight, bias):
    return NormalisePresent.apply(rows, present, weight, bias, 1e-5)[0]


def by_kernels(rows, present, weight, bias):
    running = torch.zeros_like(weight), torch.ones_like(weight), torch.tensor(0)
    return FusedNormalise.apply(rows, present, weight, bias, *(each.detach() for each in running), 1e-5, 0.1)


NORMALISATIONS = [by_operations, pytest.param(by_kernels, marks=needs_warp)]


@pytest.mark.parametrize("normalise", NORMALISATIONS)
def test_the_derivative_of_normalised_rows_is_that_of_finite_differences(normalise):
    """Also where nothing depends on the result, so that no gradient arrives."""
    given = given_rows()
    present = torch.tensor([True, False, True, True, False])
    assert torch.autograd.gradcheck(
        lambda rows, *others: normalise(rows, present, *others)[present], given, nondet_tol=0.0
    )
    gradients = torch.autograd.grad(
        _without_gradient(normalise(given[0], present, *given[1:])), given, allow_unused=True
    )
    assert gradients == (None, None, None)


@needs_warp
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rows", [0, 1, 2, 1000])
@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("many_threads", [False, True])
def test_kernels_compute_what_operations_do(rows, share, dtype, many_threads, monkeypatch):
    """Also without any row that is present, for gradients that are one number, and for rows that are not contiguous."""
    monkeypatch.setattr("warp.config.enable_cpu_blocks", many_threads)  # a block has one thread on a CPU otherwise
    torch.manual_seed(0)
    given, tolerance = given_rows(rows, 70, dtype), 1e-4 if dtype == torch.float32 else 1e-10
    present = torch.rand(rows, 2)[:, 1] < share
    found = []
    for normalise in (by_operations, by_kernels):
        for cotangent in (
            torch.ones(1, 1, dtype=dtype).expand(rows, 70),
            torch.linspace(0, 1, 70, dtype=dtype).expand(rows, 70),
        ):
            result = normalise(given[0].t().contiguous().t(), present, *given[1:])
            found.append([result.detach(), *torch.autograd.grad(result, given, cotangent)])
    for one, other in zip(found[:2], found[2:], strict=True):
        for a, b in zip(one, other, strict=True):
            torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance * max(rows, 1) ** 0.5)


@needs_warp
@pytest.mark.parametrize("architecture", [80, 90])
def test_kernels_fit_into_the_registers_of_gpus(architecture, tmp_path):
    from epo_lightning.solvers.gauss_newton.fused_kernel.ahead_of_time import resources
    from epo_lightning.warp_kernels import warp

    for kernel in vars(kernels(torch.float32)).values():
        module = kernel.module
        module.options["block_dim"] = THREADS
        (path,) = warp().compile_aot_module(module, arch=architecture, use_ptx=False, module_dir=tmp_path)
        found = resources(path.read_bytes())
        assert found.stack == 0, found
        assert found.registers <= 64, found


@needs_warp
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_kernels_on_a_gpu_compute_what_operations_do():
    """A module on a GPU takes the kernels; its results are those of the selection on the CPU."""
    torch.manual_seed(0)
    network = MLP(5, 70, 3, norm="batch").double().train()
    mask = torch.rand(300, 4) < 0.6
    features = torch.randn(300, 4, 5, dtype=torch.float64)
    state = {name: value.clone() for name, value in network.state_dict().items()}
    expected = trained(network, features, mask)
    other = MLP(5, 70, 3, norm="batch").double().cuda().train()
    other.load_state_dict(state)
    for one, there in zip(trained(other, features.cuda(), mask.cuda()), expected, strict=True):
        torch.testing.assert_close(one.cpu(), there, rtol=0, atol=1e-9)


def _without_gradient(tensor):
    """A sum of the tensor whose derivative is undefined instead of zero, as a solver's of parameters that it ignores."""

    class Undefined(torch.autograd.Function):
        @staticmethod
        def forward(ctx, tensor):
            return tensor.sum()

        @staticmethod
        def backward(ctx, gradient):
            return None

    return Undefined.apply(tensor)
