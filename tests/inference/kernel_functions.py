"""Matrices of one GPyTorch kernel as `LatentKernels` evaluates them."""

from gpytorch.kernels import Kernel
from torch import Tensor

from forcegp.inference.dense_kernels import taken_apart


def kernel_matrix(kernel: Kernel, z: Tensor) -> Tensor:
    return taken_apart(kernel).cross(z, z)


def kernel_cross(kernel: Kernel, z: Tensor, other: Tensor) -> Tensor:
    return taken_apart(kernel).cross(z, other)


def kernel_diagonal(kernel: Kernel, z: Tensor) -> Tensor:
    return taken_apart(kernel).diagonal(z)
