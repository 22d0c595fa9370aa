"""The equations of the paper as pure functions (``functional``) and as TorchRL losses."""

from . import functional
from .design import DesignValue
from .dynamics import EnsembleNLLLoss
from .sac import CoImSACLoss

__all__ = ["CoImSACLoss", "DesignValue", "EnsembleNLLLoss", "functional"]
