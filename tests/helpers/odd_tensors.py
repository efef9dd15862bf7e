"""Tensors that torch can make, and that nothing can be computed from as from any other."""

import warnings

import torch
from torch import Tensor


def odd_tensors(tensor: Tensor) -> dict[str, Tensor]:
    """What a tensor of floating-point numbers is in other layouts, on no device, and in dtypes for storage alone."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some of them are prototypes, or deprecated
        return {
            "meta": tensor.to("meta"),
            "sparse": tensor.to_sparse(),
            "compressed": tensor.flatten(1).to_sparse_csr(),
            "mkldnn": tensor.to_mkldnn(),
            "nested": torch.nested.nested_tensor(list(tensor)),
            "jagged": torch.nested.nested_tensor([row.flatten() for row in tensor], layout=torch.jagged),
            "quantised": torch.quantize_per_tensor(tensor, 0.1, 0, torch.qint8),
            "float8": tensor.to(torch.float8_e4m3fn),
            "bits": tensor.to(torch.uint8).view(torch.bits8),
            "complex": tensor.to(torch.complex64),
        }
