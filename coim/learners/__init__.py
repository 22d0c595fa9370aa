"""Learners: soft actor-critic and the dynamics ensemble, which train the networks of K runs at once."""

from .dynamics import DynamicsLearner
from .flat_weights import FlatLearner, Precision
from .sac import SACLearner

__all__ = ["DynamicsLearner", "FlatLearner", "Precision", "SACLearner"]
