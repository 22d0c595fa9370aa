"""Networks: the design-conditioned policy and critics, the dynamics ensemble, and the stacked layers of both."""

from .ensemble import GaussianEnsemble
from .normaliser import RunningNormaliser
from .policy import Policy, PolicyNetwork, make_policy
from .qvalue import QValue, QValueNetwork, make_qvalue
from .scaling import InputScaling
from .sizes import NetworkSizes
from .stacked import StackedLinear, StackedMLP, select_run

__all__ = [
    "GaussianEnsemble",
    "InputScaling",
    "NetworkSizes",
    "Policy",
    "PolicyNetwork",
    "QValue",
    "QValueNetwork",
    "RunningNormaliser",
    "StackedLinear",
    "StackedMLP",
    "make_policy",
    "make_qvalue",
    "select_run",
]
